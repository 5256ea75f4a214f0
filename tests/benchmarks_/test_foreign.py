"""Fields of other programs. No samples could be had: the files are written here in the layouts of those programs."""

from pathlib import Path

import numpy as np
import pytest
import torch
from cases_foreign import (
    VIEW,
    K,
    N,
    check_method,
    columns_of,
    cosines_of,
    decoder_of,
    random_rows,
    raw_values,
    rendered,
    save_capture,
    save_legaussians,
    save_ply,
)
from messages import refused
from published.foreign import (
    load_feature3dgs,
    load_foreign,
    load_langsplat,
    load_langsplat_v2,
    load_legaussians_field,
    load_splat_features,
)
from torch import nn

from kfgs.evaluation import Method
from kfgs.formats.ply import read_ply, write_ply


def test_feature_3dgs(tmp_path: Path) -> None:
    values, text = random_rows(N, 140), random_rows(K, 140, seed=5)  # more channels than are splatted at once
    values[3] = 0
    save_ply(tmp_path / "point_cloud/iteration_7000/point_cloud.ply", columns_of(values[:, :2]))
    ply = save_ply(tmp_path / "point_cloud/iteration_30000/point_cloud.ply", columns_of(values))
    method = load_feature3dgs(tmp_path)
    assert isinstance(method, Method)
    assert (method.name, method.levels, len(method.gaussians)) == ("Feature 3DGS 140", 1, N)
    features, seen = rendered(values)
    check_method(method, text, 0, features, seen, values.numpy())
    assert torch.isnan(method.gaussian_cosines(text)[0, 3]).all()
    assert load_foreign(tmp_path).name == load_foreign(ply).name.replace("point_cloud", method.name) == method.name
    assert load_feature3dgs(tmp_path, 7000).dim == 2
    assert load_feature3dgs(ply).dim == 140


def test_feature_3dgs_with_its_convolution(tmp_path: Path) -> None:
    values, text = random_rows(N, 8), random_rows(K, 20, seed=5)
    save_ply(tmp_path / "point_cloud/iteration_30000/point_cloud.ply", columns_of(values))
    convolution = nn.Conv2d(8, 20, 1)
    torch.save(
        {f"conv.{name}": value for name, value in convolution.state_dict().items()},
        tmp_path / "decoder_chkpnt30000.pth",
    )
    method = load_feature3dgs(tmp_path)
    assert (method.name, method.dim) == ("Feature 3DGS 8", 20)
    weight, bias = (v.detach().double().numpy() for v in (convolution.weight[:, :, 0, 0], convolution.bias))
    features, seen = rendered(values)
    check_method(method, text, 0, features @ weight.T + bias, seen, values.double().numpy() @ weight.T + bias)


def test_df_3dgs_with_its_autoencoder(tmp_path: Path) -> None:
    values, text = random_rows(N, 9), random_rows(K, 20, seed=5)
    save_ply(tmp_path / "point_cloud/iteration_30000/point_cloud.ply", columns_of(values))
    network = decoder_of((9, 16, 32, 20))
    file = tmp_path / "latest_AE_ckpt.pth"
    torch.save(network.state_dict(), file)
    method = load_foreign(tmp_path, file)
    assert (method.name, method.dim) == ("DF-3DGS 9", 20)

    def decoded(rows: torch.Tensor) -> np.ndarray:
        with torch.no_grad():
            for layer in network["decoder"]:
                rows = layer(rows)
        return rows.double().numpy()

    features, seen = rendered(values)
    check_method(method, text, 0, decoded(torch.as_tensor(features).float()), seen, decoded(values))
    torch.save(decoder_of((8, 20)).state_dict(), file)
    refused(lambda: load_feature3dgs(tmp_path, decoder=file), "latest_AE_ckpt.pth", "9 inputs", "another run")


def test_langsplat(tmp_path: Path) -> None:
    network = decoder_of((3, 6, 5, 9))
    torch.save(network.state_dict(), tmp_path / "best_ckpt.pth")
    latents = [random_rows(N, 3, seed=level) for level in range(3)]
    latents[1][4] = 0
    for level, values in enumerate(latents, 1):
        save_capture(tmp_path / f"output/figurines_{level}/chkpnt30000.pth", [values])
    text = random_rows(K, 9, seed=5)
    method = load_langsplat(tmp_path / "output/figurines", tmp_path / "best_ckpt.pth")
    assert (method.name, method.levels) == ("LangSplat", 3)
    for level, values in enumerate(latents):
        unit = values / (values.norm(dim=1, keepdim=True) + 1e-9)  # before it is splatted, and not after

        def decode(rows: np.ndarray) -> np.ndarray:
            for i, name in enumerate(("0", "2", "4")):
                layer = network["decoder"][int(name)]
                rows = np.maximum(rows, 0) if i else rows
                rows = rows @ layer.weight.detach().double().numpy().T + layer.bias.detach().double().numpy()
            return rows

        features, seen = rendered(unit)
        own = np.where((values == 0).all(1)[:, None], 0, decode(unit.double().numpy()))  # untrained: unknown
        seen = seen & (features != 0).any(-1)  # what is seen has learnt something
        check_method(method, text, level, decode(features), seen, own)
    found = load_foreign(tmp_path / "output/figurines", tmp_path / "best_ckpt.pth")
    assert (found.name, found.levels) == ("LangSplat", 3)
    refused(lambda: load_foreign(tmp_path / "output/figurines"), "best_ckpt.pth", "with_file")
    save_ply(tmp_path / "output/figurines/point_cloud/iteration_30000/point_cloud.ply", {})  # the run of the colours
    found = load_foreign(tmp_path / "output/figurines", tmp_path / "best_ckpt.pth")
    assert torch.equal(found.gaussian_cosines(text).nan_to_num(), method.gaussian_cosines(text).nan_to_num())
    one = load_langsplat([tmp_path / "output/figurines_2"], tmp_path / "best_ckpt.pth", 30000)
    assert one.levels == 1
    torch.testing.assert_close(one.cosines(VIEW, text)[0], method.cosines(VIEW, text)[1], equal_nan=True)


def test_langsplat_v2(tmp_path: Path) -> None:
    logits, book, text = random_rows(N, 16), random_rows(1, 16, 9), random_rows(K, 9, seed=5)
    path = save_capture(tmp_path / "ramen_1/chkpnt10000.pth", [logits, book])
    method = load_langsplat_v2([path.parent])
    assert load_foreign(tmp_path / "ramen_1").name == load_foreign(path).name == "LangSplatV2"
    weights = np.zeros((N, 16))
    for i, row in enumerate(logits.double().numpy()):
        share = np.exp(row) / np.exp(row).sum()
        best = np.argsort(-share)[:4]
        weights[i, best] = share[best] / (share[best].sum() + 1e-10)
    codes = book[0].double().numpy()
    features, seen = rendered(torch.from_numpy(weights).float())
    check_method(method, text, 0, features @ codes, seen, weights @ codes)
    assert load_langsplat_v2([path], top=2).parts[0].values.count_nonzero(1).tolist() == [2] * N
    two = save_capture(tmp_path / "two/chkpnt10000.pth", [logits, torch.cat([book, book])])
    refused(lambda: load_langsplat_v2(two), "chkpnt10000.pth", "one codebook [1, 16, D]", "[2, 16, 9]", "vq_layer_num")


@pytest.mark.parametrize("kind", ["checkpoint", "ply"])
def test_legaussians(tmp_path: Path, kind: str) -> None:
    values, text = random_rows(N, 8), random_rows(K, 10, seed=5)
    network, codes = save_legaussians(tmp_path)
    if kind == "ply":
        columns = columns_of(values, "clip_f_indices_") | {"uncertainty": torch.zeros(N)}
        save_ply(tmp_path / "point_cloud/iteration_30000/point_cloud.ply", columns)
    else:  # their order has the semantic numbers in the fifth place and the uncertainty after the opacity
        raw = raw_values()
        torch.save(
            ((1, raw["xyz"], raw["dc"], raw["rest"], nn.Parameter(values), raw["scales"], raw["quats"], raw["opacity"],
              torch.zeros(N, 1), torch.zeros(N), torch.zeros(N, 1), torch.zeros(N, 1), {}, 5.0), 30000),
            tmp_path / "chkpnt30000.pth",
        )  # fmt: skip
    method = load_legaussians_field(tmp_path, tmp_path / "codebook.pt", channels=10)
    refused(lambda: load_foreign(tmp_path), "with_file", "codebook", error=FileNotFoundError)
    torch.save({"embedding.weight": random_rows(5, 600)}, tmp_path / "wide.pt")
    assert load_foreign(tmp_path, tmp_path / "wide.pt").name == "LEGaussians"

    def decode(rows: np.ndarray, hard: bool = False) -> np.ndarray:
        rows = rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-8)
        for i in (1, 2, 3):
            layer = network[f"conv{i}"]
            rows = np.maximum(rows, 0) if i > 1 else rows
            rows = rows @ layer.weight[:, :, 0, 0].detach().double().numpy().T + layer.bias.detach().double().numpy()
        share = np.exp(rows) / np.exp(rows).sum(-1, keepdims=True)
        share = (share == share.max(-1, keepdims=True)) if hard else share
        return share @ codes[:, :10].double().numpy()

    shown, seen = rendered(values)
    check_method(method, text, 0, decode(shown), seen, decode(values.double().numpy()))
    hard = load_legaussians_field(tmp_path, tmp_path / "codebook.pt", channels=10, hard=True)
    check_method(hard, text, 0, decode(shown, True), seen, decode(values.double().numpy(), True))


def test_splats_with_features(tmp_path: Path) -> None:
    values, text = random_rows(N, 6), random_rows(K, 6, seed=5)
    shown, seen = rendered(values)
    own = save_ply(tmp_path / "own.ply", columns_of(values, "lang_"))
    bare = save_ply(tmp_path / "bare.ply", {})
    np.save(tmp_path / "lang.npy", values.numpy().astype(np.float16))
    torch.save(values, tmp_path / "lang.pth")
    for method in (load_splat_features(own, column="lang_"), load_splat_features(bare, tmp_path / "lang.pth")):
        check_method(method, text, 0, shown, seen, values.numpy())
    assert load_foreign(bare, tmp_path / "lang.npy").dim == 6
    refused(lambda: load_foreign(bare), "bare.ply", "semantic_0", "with_file")
    near = load_splat_features(bare, tmp_path / "lang.npy", name="SceneSplat")
    assert (near.name, near.dim) == ("SceneSplat", 6)
    np.testing.assert_allclose(near.gaussian_cosines(text), method.gaussian_cosines(text), atol=2e-3)  # half precision
    np.save(tmp_path / "lang.npy", values[1:].numpy())
    refused(lambda: load_splat_features(bare, tmp_path / "lang.npy"), "lang.npy", f"[{N}, D]", f"[{N - 1}, 6]")
    refused(lambda: load_splat_features(own), "own.ply", "semantic_0", "lang_0", "column=")
    refused(lambda: near.cosines(VIEW, random_rows(K, 9)), "text", "[K, 6]", "(3, 9)", "encoder")


def test_features_keep_step_with_the_gaussians_that_are_left_of_a_real_splat(tmp_path: Path, shared_data: Path) -> None:
    columns = read_ply(shared_data / "splats/inria_9080.ply")
    columns["y"][[7, 8, 4000]] = np.nan
    write_ply(tmp_path / "a.ply", columns)
    values, text = random_rows(len(columns["y"]), 6), random_rows(K, 6, seed=5)
    np.save(tmp_path / "lang.npy", values.numpy())
    found = load_splat_features(tmp_path / "a.ply", tmp_path / "lang.npy").gaussian_cosines(text)[0]
    expected = cosines_of(np.delete(values.numpy(), [7, 8, 4000], axis=0), text.double().numpy())
    np.testing.assert_allclose(found.numpy(), expected, atol=2e-5)
    refused(lambda: load_feature3dgs(tmp_path / "a.ply"), "a.ply", "semantic_0", "trained with features")
