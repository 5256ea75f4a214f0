"""Fields of other programs. No samples could be had: the files are written here in the layouts of those programs."""

import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import tells
from pickled import Call
from torch import nn

from kfgs.cameras import Camera
from kfgs.evaluation import Method, View
from kfgs.evaluation.foreign import (
    load_feature3dgs,
    load_foreign,
    load_langsplat,
    load_langsplat_v2,
    load_legaussians_field,
    load_occam,
    load_splat_features,
)
from kfgs.formats import read_splats
from kfgs.formats.ply import write_ply
from kfgs.gaussians import Gaussians
from kfgs.splat import rasterize

N, H, W, K = 12, 9, 11, 3
VIEW = View("a", Camera(torch.eye(4), torch.tensor([[10.0, 0, 5.5], [0, 10, 4.5], [0, 0, 1]]), W, H, "a.png"))


def _random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed + 17 * len(shape) + shape[-1]))


def _raw() -> dict[str, torch.Tensor]:
    return {
        "xyz": torch.cat([_random(N, 2) * 0.5, 2 + _random(N, 1).abs()], 1),
        "dc": _random(N, 1, 3),
        "rest": _random(N, 3, 3),
        "scales": -2 + 0.3 * _random(N, 3),
        "quats": _random(N, 4),
        "opacity": _random(N, 1),
    }


def _splats(values: torch.Tensor, raw: dict[str, torch.Tensor] | None = None) -> Gaussians:
    """The Gaussians of `_raw`, activated here by the definitions."""
    raw = raw or _raw()
    return Gaussians(
        raw["xyz"], raw["quats"], raw["scales"].exp(), 1 / (1 + torch.exp(-raw["opacity"][:, 0])), features=values
    )


def _capture(path: Path, features: list[torch.Tensor], *, place: int = 6, raw: dict | None = None) -> Path:
    """A tuple in the order of the training scripts: SH degree, parameters, features, statistics, optimiser, extent."""
    raw = raw or _raw()
    optimizer = torch.optim.Adam([nn.Parameter(torch.zeros(3))])
    values = [1, *(nn.Parameter(value) for value in raw.values())]
    values[place + 1 : place + 1] = [nn.Parameter(value) for value in features]
    values += [torch.zeros(N), torch.zeros(N, 1), torch.zeros(N, 1), optimizer.state_dict(), 5.0]
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save((tuple(values), 30000), path)
    return path


def _cosine(features: np.ndarray, text: np.ndarray) -> np.ndarray:
    """Cosines by the definition, one by one; NaN for zeros."""
    flat, found = features.reshape(-1, features.shape[-1]).astype(np.float64), []
    for row in flat:
        length = np.sqrt(np.sum(row * row))
        found.append([np.nan if length == 0 else np.sum(row * t) / length / np.sqrt(np.sum(t * t)) for t in text])
    return np.array(found).reshape(*features.shape[:-1], len(text))


def _map(values: torch.Tensor, raw: dict[str, torch.Tensor] | None = None) -> tuple[np.ndarray, np.ndarray]:
    rendering = rasterize(_splats(values, raw), VIEW.camera, engine="reference")
    return rendering.map.double().numpy(), rendering.alpha.numpy() > 0


def _check(
    method: Method, text: torch.Tensor, level: int, features: np.ndarray, seen: np.ndarray, own: np.ndarray
) -> None:
    """Against features [H, W, D] of pixels and `own` [N, D] of Gaussians."""
    expected = np.where(seen[..., None], _cosine(features, text.double().numpy()), np.nan)
    np.testing.assert_allclose(method.cosines(VIEW, text)[level].numpy(), expected, atol=2e-5)
    expected = _cosine(own, text.double().numpy())
    np.testing.assert_allclose(method.gaussian_cosines(text)[level].numpy(), expected, atol=2e-5)


def _ply(path: Path, columns: dict[str, torch.Tensor], raw: dict[str, torch.Tensor] | None = None) -> Path:
    raw = raw or _raw()
    table = {name: raw["xyz"][:, i] for i, name in enumerate("xyz")}
    table |= {name: torch.zeros(N) for name in ("nx", "ny", "nz")}
    table |= {f"f_dc_{i}": raw["dc"][:, 0, i] for i in range(3)}
    table |= {f"f_rest_{i}": raw["rest"].transpose(1, 2).flatten(1)[:, i] for i in range(9)}
    table |= {"opacity": raw["opacity"][:, 0]}
    table |= {f"scale_{i}": raw["scales"][:, i] for i in range(3)} | {f"rot_{i}": raw["quats"][:, i] for i in range(4)}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ply(path, {name: values.contiguous().numpy() for name, values in (table | columns).items()})
    return path


def _semantic(values: torch.Tensor, column: str = "semantic_") -> dict[str, torch.Tensor]:
    return {f"{column}{i}": values[:, i] for i in range(values.shape[1])}


def test_feature_3dgs(tmp_path: Path) -> None:
    values, text = _random(N, 140), _random(K, 140, seed=5)  # more channels than are splatted at once
    values[3] = 0
    _ply(tmp_path / "point_cloud/iteration_7000/point_cloud.ply", _semantic(values[:, :2]))
    ply = _ply(tmp_path / "point_cloud/iteration_30000/point_cloud.ply", _semantic(values))
    method = load_feature3dgs(tmp_path)
    assert isinstance(method, Method)
    assert (method.name, method.levels, len(method.gaussians)) == ("Feature 3DGS 140", 1, N)
    features, seen = _map(values)
    _check(method, text, 0, features, seen, values.numpy())
    assert torch.isnan(method.gaussian_cosines(text)[0, 3]).all()
    assert load_foreign(tmp_path).name == load_foreign(ply).name.replace("point_cloud", method.name) == method.name
    assert load_feature3dgs(tmp_path, 7000).dim == 2
    assert load_feature3dgs(ply).dim == 140


def test_feature_3dgs_with_its_convolution(tmp_path: Path) -> None:
    values, text = _random(N, 8), _random(K, 20, seed=5)
    _ply(tmp_path / "point_cloud/iteration_30000/point_cloud.ply", _semantic(values))
    convolution = nn.Conv2d(8, 20, 1)
    torch.save(
        {f"conv.{name}": value for name, value in convolution.state_dict().items()},
        tmp_path / "decoder_chkpnt30000.pth",
    )
    method = load_feature3dgs(tmp_path)
    assert (method.name, method.dim) == ("Feature 3DGS 8", 20)
    weight, bias = (v.detach().double().numpy() for v in (convolution.weight[:, :, 0, 0], convolution.bias))
    features, seen = _map(values)
    _check(method, text, 0, features @ weight.T + bias, seen, values.double().numpy() @ weight.T + bias)


def _decoder(sizes: tuple[int, ...]) -> nn.Module:
    torch.manual_seed(1)
    layers: list[nn.Module] = []
    for i, (a, b) in enumerate(pairwise(sizes)):
        layers += [nn.ReLU()] * (i > 0) + [nn.Linear(a, b)]
    return nn.ModuleDict(
        {"encoder": nn.ModuleList([nn.Linear(9, 5), nn.BatchNorm1d(5)]), "decoder": nn.ModuleList(layers)}
    )


def test_langsplat(tmp_path: Path) -> None:
    network = _decoder((3, 6, 5, 9))
    torch.save(network.state_dict(), tmp_path / "best_ckpt.pth")
    latents = [_random(N, 3, seed=level) for level in range(3)]
    latents[1][4] = 0
    for level, values in enumerate(latents, 1):
        _capture(tmp_path / f"output/figurines_{level}/chkpnt30000.pth", [values])
    text = _random(K, 9, seed=5)
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

        features, seen = _map(unit)
        own = np.where((values == 0).all(1)[:, None], 0, decode(unit.double().numpy()))  # untrained: unknown
        seen = seen & (features != 0).any(-1)  # what is seen has learnt something
        _check(method, text, level, decode(features), seen, own)
    found = load_foreign(tmp_path / "output/figurines", tmp_path / "best_ckpt.pth")
    assert (found.name, found.levels) == ("LangSplat", 3)
    with pytest.raises(ValueError, match=tells("best_ckpt.pth", "with_file")):
        load_foreign(tmp_path / "output/figurines")
    one = load_langsplat([tmp_path / "output/figurines_2"], tmp_path / "best_ckpt.pth", 30000)
    assert one.levels == 1
    torch.testing.assert_close(one.cosines(VIEW, text)[0], method.cosines(VIEW, text)[1], equal_nan=True)


def test_langsplat_v2(tmp_path: Path) -> None:
    logits, book, text = _random(N, 16), _random(1, 16, 9), _random(K, 9, seed=5)
    path = _capture(tmp_path / "ramen_1/chkpnt10000.pth", [logits, book])
    method = load_langsplat_v2([path.parent])
    assert load_foreign(tmp_path / "ramen_1").name == load_foreign(path).name == "LangSplatV2"
    weights = np.zeros((N, 16))
    for i, row in enumerate(logits.double().numpy()):
        share = np.exp(row) / np.exp(row).sum()
        best = np.argsort(-share)[:4]
        weights[i, best] = share[best] / (share[best].sum() + 1e-10)
    codes = book[0].double().numpy()
    features, seen = _map(torch.from_numpy(weights).float())
    _check(method, text, 0, features @ codes, seen, weights @ codes)
    assert load_langsplat_v2([path], top=2).parts[0].values.count_nonzero(1).tolist() == [2] * N
    two = _capture(tmp_path / "two/chkpnt10000.pth", [logits, torch.cat([book, book])])
    with pytest.raises(
        ValueError, match=tells("chkpnt10000.pth", "one codebook [1, 16, D]", "[2, 16, 9]", "vq_layer_num")
    ):
        load_langsplat_v2(two)


def test_occam_whose_levels_lost_other_gaussians(tmp_path: Path) -> None:
    features, text, kept = _random(N, 10), _random(K, 10, seed=5), [[0, 1, 2, 5, 7], [1, 3, 5, 11]]
    for level, rows in enumerate(kept, 1):
        raw = {name: value[rows] for name, value in _raw().items()}
        _capture(tmp_path / f"chkpnt30000_langfeat_{level}.pth", [features[rows]], raw=raw)
    method = load_occam(tmp_path)
    assert (method.name, method.levels, len(method.gaussians)) == ("Occam's LGS", 2, 7)
    assert torch.equal(method.gaussians.means, _raw()["xyz"][[0, 1, 2, 5, 7, 3, 11]])
    own = method.gaussian_cosines(text)
    for level, rows in enumerate(kept):
        raw = {name: value[rows] for name, value in _raw().items()}
        rendered, seen = _map(features[rows], raw)
        expected = np.where(seen[..., None], _cosine(rendered, text.double().numpy()), np.nan)
        np.testing.assert_allclose(method.cosines(VIEW, text)[level].numpy(), expected, atol=2e-5)
        exact = _cosine(features.numpy(), text.double().numpy())
        expected = np.array([exact[i] if i in rows else [np.nan] * K for i in (0, 1, 2, 5, 7, 3, 11)])
        np.testing.assert_allclose(own[level].numpy(), expected, atol=2e-5)
    assert load_occam(tmp_path / "chkpnt30000_langfeat_2.pth").levels == 1
    assert load_foreign(tmp_path).levels == 2
    assert load_foreign(tmp_path / "chkpnt30000_langfeat_2.pth").levels == 1
    with pytest.raises(ValueError, match=tells("with_file", "none with Occam")):
        load_foreign(tmp_path, tmp_path / "x.pth")


def _legaussians(folder: Path) -> tuple[nn.ModuleDict, torch.Tensor]:
    torch.manual_seed(2)
    network = nn.ModuleDict({"conv1": nn.Conv2d(8, 6, 1), "conv2": nn.Conv2d(6, 7, 1), "conv3": nn.Conv2d(7, 5, 1)})
    codes = _random(5, 14)
    folder.mkdir(parents=True, exist_ok=True)
    torch.save(network.state_dict(), folder / "index_decoder_chkpnt30000.pth")
    torch.save({"embedding.weight": codes}, folder / "codebook.pt")
    return network, codes


@pytest.mark.parametrize("kind", ["checkpoint", "ply"])
def test_legaussians(tmp_path: Path, kind: str) -> None:
    values, text = _random(N, 8), _random(K, 10, seed=5)
    network, codes = _legaussians(tmp_path)
    if kind == "ply":
        columns = _semantic(values, "clip_f_indices_") | {"uncertainty": torch.zeros(N)}
        _ply(tmp_path / "point_cloud/iteration_30000/point_cloud.ply", columns)
    else:  # their order has the semantic numbers in the fifth place and the uncertainty after the opacity
        raw = _raw()
        torch.save(
            ((1, raw["xyz"], raw["dc"], raw["rest"], nn.Parameter(values), raw["scales"], raw["quats"], raw["opacity"],
              torch.zeros(N, 1), torch.zeros(N), torch.zeros(N, 1), torch.zeros(N, 1), {}, 5.0), 30000),
            tmp_path / "chkpnt30000.pth",
        )  # fmt: skip
    method = load_legaussians_field(tmp_path, tmp_path / "codebook.pt", channels=10)
    with pytest.raises(FileNotFoundError, match=tells("with_file", "codebook")):
        load_foreign(tmp_path)
    torch.save({"embedding.weight": _random(5, 600)}, tmp_path / "wide.pt")
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

    rendered, seen = _map(values)
    _check(method, text, 0, decode(rendered), seen, decode(values.double().numpy()))
    hard = load_legaussians_field(tmp_path, tmp_path / "codebook.pt", channels=10, hard=True)
    _check(hard, text, 0, decode(rendered, True), seen, decode(values.double().numpy(), True))


def test_splats_with_features(tmp_path: Path) -> None:
    values, text = _random(N, 6), _random(K, 6, seed=5)
    rendered, seen = _map(values)
    own = _ply(tmp_path / "own.ply", _semantic(values, "lang_"))
    bare = _ply(tmp_path / "bare.ply", {})
    np.save(tmp_path / "lang.npy", values.numpy().astype(np.float16))
    torch.save(values, tmp_path / "lang.pth")
    for method in (load_splat_features(own, column="lang_"), load_splat_features(bare, tmp_path / "lang.pth")):
        _check(method, text, 0, rendered, seen, values.numpy())
    assert load_foreign(bare, tmp_path / "lang.npy").dim == 6
    with pytest.raises(ValueError, match=tells("bare.ply", "semantic_0", "with_file")):
        load_foreign(bare)
    near = load_splat_features(bare, tmp_path / "lang.npy", name="SceneSplat")
    assert (near.name, near.dim) == ("SceneSplat", 6)
    np.testing.assert_allclose(near.gaussian_cosines(text), method.gaussian_cosines(text), atol=2e-3)  # half precision
    np.save(tmp_path / "lang.npy", values[1:].numpy())
    with pytest.raises(ValueError, match=tells("lang.npy", f"[{N}, D]", f"[{N - 1}, 6]", "bare.ply")):
        load_splat_features(bare, tmp_path / "lang.npy")
    with pytest.raises(ValueError, match=tells("own.ply", "semantic_0", "lang_0", "column=")):
        load_splat_features(own)
    with pytest.raises(ValueError, match=tells("text", "[K, 6]", "(3, 9)", "encoder")):
        near.cosines(VIEW, _random(K, 9))


def test_files_that_are_missing_or_of_another_program(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=tells("iteration_<step>", "Feature 3DGS", "none")):
        load_feature3dgs(tmp_path)
    _ply(tmp_path / "point_cloud/iteration_30000/point_cloud.ply", {})
    with pytest.raises(FileNotFoundError, match=tells("iteration_7", "steps [30000]")):
        load_feature3dgs(tmp_path, 7)
    with pytest.raises(ValueError, match=tells("point_cloud.ply", "semantic_0", "trained with features")):
        load_feature3dgs(tmp_path)
    with pytest.raises(ValueError, match=tells("point_cloud.ply", "semantic_0")):
        load_foreign(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=tells("empty", "known program", "Feature 3DGS", "LangSplat")):
        load_foreign(tmp_path / "empty")
    with pytest.raises(FileNotFoundError, match=tells("nothing", "no such file")):
        load_foreign(tmp_path / "nothing")
    network = _decoder((3, 9))
    torch.save(network.state_dict(), tmp_path / "ae.pth")
    with pytest.raises(FileNotFoundError, match=tells("room_1", "chkpnt<step>.pth", "LangSplat")):
        load_langsplat(tmp_path / "room", tmp_path / "ae.pth")
    path = _capture(tmp_path / "run/chkpnt30000.pth", [])
    with pytest.raises(
        ValueError, match=tells("chkpnt30000.pth", "language features", "colours alone", "trained the features")
    ):
        load_langsplat(path, tmp_path / "ae.pth")
    _capture(path, [_random(N, 4)])
    with pytest.raises(ValueError, match=tells("ae.pth", "decoder.0.weight", "4 inputs", "[9, 3]", "another run")):
        load_langsplat(path, tmp_path / "ae.pth")
    _capture(path, [_random(N - 1, 3)])
    with pytest.raises(ValueError, match=tells("chkpnt30000.pth", f"[{N}, d]", f"[{N - 1}, 3]")):
        load_langsplat(path, tmp_path / "ae.pth")
    _capture(path, [torch.full((N, 3), torch.nan)])
    with pytest.raises(ValueError, match=tells("chkpnt30000.pth", "finite", "language features")):
        load_langsplat(path, tmp_path / "ae.pth")
    torch.save({"a": 1}, tmp_path / "ae.pth")
    torch.save({"a": 1}, path)
    with pytest.raises(ValueError, match=tells("chkpnt30000.pth", "1 values")):
        load_occam(path)
    network, _ = _legaussians(tmp_path / "leg")
    with pytest.raises(FileNotFoundError, match=tells("chkpnt30000.pth", "point_cloud.ply")):
        load_legaussians_field(tmp_path / "leg", tmp_path / "leg/codebook.pt")
    _ply(tmp_path / "leg/point_cloud/iteration_30000/point_cloud.ply", _semantic(_random(N, 8), "clip_f_indices_"))
    with pytest.raises(ValueError, match=tells("codebook.pt", "[5, 512 or more]", "[5, 14]")):
        load_legaussians_field(tmp_path / "leg", tmp_path / "leg/codebook.pt")


def test_a_real_splat_without_and_with_features(tmp_path: Path, shared_data: Path) -> None:
    ply = shared_data / "splats/inria_9080.ply"
    with pytest.raises(ValueError, match=tells("inria_9080.ply", "semantic_0", "trained with features")):
        load_feature3dgs(ply)
    count = len(read_splats(ply).gaussians)
    values = _random(count, 6)
    np.save(tmp_path / "lang.npy", values.numpy())
    method = load_splat_features(ply, tmp_path / "lang.npy")
    text = _random(K, 6, seed=5)
    expected = _cosine(values.numpy(), text.double().numpy())
    np.testing.assert_allclose(method.gaussian_cosines(text)[0].numpy(), expected, atol=2e-5)


def test_nothing_in_a_checkpoint_is_run(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    torch.save((Call(os.system, f"touch {mark}"), 30000), tmp_path / "chkpnt30000_langfeat_1.pth")
    with pytest.raises(ValueError, match=tells("chkpnt30000_langfeat_1.pth", "nothing was run", "do not trust")):
        load_occam(tmp_path)
    assert not mark.exists()
