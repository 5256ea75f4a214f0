"""Checkpoints of gsplat and nerfstudio, written here with torch.save as those programs do."""

import collections
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import refused, tells
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from kfgs.cli import main
from kfgs.formats import find_format, read_splats, write_splats
from kfgs.formats.checkpoint import FRAME
from kfgs.splat.sh import evaluate_sh

N = 7
# x' = 0.5 (R x + t) with a quarter turn about z, and t
R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
SHIFT = np.array([0.5, -1.0, 2.0])
SCALE = 0.5


def raw_values(count: int = N, higher: int = 15) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(3)
    return {
        "means": torch.randn(count, 3, generator=g),
        "scales": torch.randn(count, 3, generator=g) - 3,
        "quats": torch.randn(count, 4, generator=g),
        "opacities": torch.randn(count, generator=g),
        "dc": torch.randn(count, 1, 3, generator=g),
        "rest": torch.randn(count, higher, 3, generator=g) / 4,
    }


def write_gsplat(path: Path, raw: dict[str, Tensor]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    names = {"dc": "sh0", "rest": "shN"}
    splats = nn.ParameterDict({names.get(name, name): nn.Parameter(value) for name, value in raw.items()})
    torch.save({"step": 29999, "splats": splats.state_dict()}, path)
    return path


@pytest.mark.parametrize(
    ("write", "name", "settings", "antialiased", "words"),
    [
        ("nerfstudio", "config.yml", "      rasterize_mode: antialiased\n", True, None),
        ("nerfstudio", "config.yml", "      rasterize_mode: classic\n", False, None),
        ("gsplat", "cfg.yml", "antialiased: true\napp_opt: false\n", True, None),
        ("gsplat", "cfg.yml", "antialiased: false\nmodel_type: 2dgs\n", False, "2-D Gaussians"),
        (
            "gsplat",
            "cfg.yml",
            "antialiased: false\nwith_ut: true\n",
            False,
            "'with_ut: true', which kfgs does not know",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:.*dataparser_transforms")
def test_the_settings_of_the_training_say_how_it_is_drawn(tmp_path, notes, write, name, settings, antialiased, words):
    write = {"gsplat": write_gsplat, "nerfstudio": write_nerfstudio}[write]
    path = write(tmp_path / "run" / "ckpts" / "step-000029999.ckpt", raw_values())
    (tmp_path / "run" / name).write_text("method: splatfacto\n" + settings)
    splats = read_splats(path)
    assert splats.antialiased is antialiased
    assert [note for note in notes if words and words in note] == notes
    assert bool(notes) is bool(words)


def write_nerfstudio(path: Path, raw: dict[str, Tensor], *, prefix: str = "_model.gauss_params.") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    values = {
        **raw,
        "opacities": raw["opacities"][:, None],
        "features_dc": raw["dc"][:, 0],
        "features_rest": raw["rest"],
    }
    state = {prefix + name: value for name, value in values.items() if name not in ("dc", "rest")}
    state["_model.camera_optimizer.pose_adjustment"] = torch.zeros(3, 6)
    moments = {"state": {0: {"exp_avg": torch.zeros(N, 3)}}, "param_groups": [collections.OrderedDict(lr=1e-3)]}
    torch.save({"step": 29999, "pipeline": state, "optimizers": {"means": moments}, "scalers": {}}, path)
    return path


def write_frame(run: Path) -> None:
    transform = np.concatenate([R, SHIFT[:, None]], 1).tolist()
    (run / FRAME).write_text(json.dumps({"transform": transform, "scale": SCALE}))


def test_gsplat_values_are_activated(tmp_path: Path) -> None:
    raw = raw_values()
    cloud = read_splats(write_gsplat(tmp_path / "ckpt_29999_rank0.pt", raw))
    assert torch.equal(cloud.means, raw["means"])
    for row in range(N):
        for axis in range(3):
            assert float(cloud.scales[row, axis]) == pytest.approx(math.exp(float(raw["scales"][row, axis])), rel=1e-5)
        assert float(cloud.opacities[row]) == pytest.approx(1 / (1 + math.exp(-float(raw["opacities"][row]))), rel=1e-5)
    torch.testing.assert_close(cloud.quats / cloud.quats.norm(dim=1, keepdim=True),
                               raw["quats"] / raw["quats"].norm(dim=1, keepdim=True))  # fmt: skip
    assert torch.equal(cloud.sh, torch.cat([raw["dc"], raw["rest"]], 1))
    write_splats(cloud, tmp_path / "same.ply")
    torch.testing.assert_close(read_splats(tmp_path / "same.ply").scales, cloud.scales)


def test_all_ranks_are_joined(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = [raw_values(count) for count in (3, 5)]
    for rank, raw in enumerate(parts):
        write_gsplat(tmp_path / f"ckpts/ckpt_6999_rank{rank}.pt", raw)
    write_gsplat(tmp_path / "ckpts/ckpt_999_rank0.pt", raw_values(2))
    found = read_splats(tmp_path)  # the newest step of the folder
    assert torch.equal(found.means, torch.cat([raw["means"] for raw in parts]))
    assert main(["convert", str(tmp_path)]) == 0
    assert "format: checkpoint" in capsys.readouterr().out
    (tmp_path / "ckpts/ckpt_6999_rank0.pt").unlink()
    refused(lambda: read_splats(tmp_path / "ckpts/ckpt_6999_rank1.pt"), "ranks 0 to 1", "[1]", "copy them all")


def test_nerfstudio_lies_in_the_frame_of_the_data(tmp_path: Path) -> None:
    raw = raw_values()
    path = write_nerfstudio(tmp_path / "nerfstudio_models/step-000029999.ckpt", raw)
    write_frame(tmp_path)
    cloud = read_splats(tmp_path)
    forward = SCALE * (cloud.means.double().numpy() @ R.T + SHIFT)  # what nerfstudio does to the data
    np.testing.assert_allclose(forward, raw["means"].numpy(), atol=1e-5)
    torch.testing.assert_close(cloud.scales * SCALE, raw["scales"].exp())
    # covariances turn with the frame
    for row in range(N):
        np.testing.assert_allclose(SCALE**2 * R @ _covariance(cloud.quats[row], cloud.scales[row]) @ R.T,
                                   _covariance(raw["quats"][row], raw["scales"][row].exp()), atol=1e-5)  # fmt: skip
    directions = torch.nn.functional.normalize(torch.randn(N, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    turned = (directions.double() @ torch.from_numpy(R).T).float()
    before = evaluate_sh(torch.cat([raw["dc"], raw["rest"]], 1), turned)
    torch.testing.assert_close(evaluate_sh(cloud.sh, directions), before, atol=1e-4, rtol=1e-4)
    older = write_nerfstudio(tmp_path / "older.ckpt", raw, prefix="module._model.")
    write_frame(tmp_path)
    torch.testing.assert_close(read_splats(older).means, read_splats(path).means)


def _covariance(quat: Tensor, scales: Tensor) -> np.ndarray:
    turn = Rotation.from_quat(quat[[1, 2, 3, 0]].numpy()).as_matrix()
    return turn @ np.diag(scales.double().numpy() ** 2) @ turn.T


def test_without_the_file_of_the_frame_it_is_said(tmp_path: Path) -> None:
    path = write_nerfstudio(tmp_path / "run/nerfstudio_models/step-000029999.ckpt", raw_values())
    with pytest.warns(UserWarning, match=tells(FRAME, "nerfstudio's own frame")):
        assert torch.equal(read_splats(path).means, raw_values()["means"])
    flat, twice = np.eye(4)[:3].tolist(), (2 * np.eye(4)[:3]).tolist()
    frames = [{"scale": 1}, [], {"transform": [[1, 0], [0, 1]], "scale": 1}]
    for content in (*frames, {"transform": flat, "scale": 0}, {"transform": twice, "scale": 1}):
        (tmp_path / "run" / FRAME).write_text(json.dumps(content))
        refused(lambda: read_splats(path), FRAME, "transform", "copy it again")


def test_colours_without_harmonics_are_logits_of_nerfstudio(tmp_path: Path) -> None:
    raw = raw_values(higher=0)
    write_frame(tmp_path)
    cloud = read_splats(write_nerfstudio(tmp_path / "a.ckpt", raw))
    rgb = 0.5 + 0.28209479177387814 * cloud.sh[:, 0]
    torch.testing.assert_close(rgb, 1 / (1 + torch.exp(-raw["dc"][:, 0])))


def test_what_cannot_be_read_is_said(tmp_path: Path) -> None:
    path, raw = tmp_path / "a.pt", raw_values()
    colours = {"means": raw["means"], "features": raw["means"], "colors": raw["means"]}
    for content, words in (
        ({"weights": torch.ones(2)}, ("gsplat", "splatfacto", "one with weights")),
        ({"splats": colours}, ("app_opt", "--save_ply")),
        ({"pipeline": {"_model.field.weight": torch.ones(2)}}, ("gauss_params.means", "another method")),
        (raw | {"opacities": raw["opacities"][:3]}, ("7 Gaussians", "opacities [3]")),
        (raw | {"scales": raw["scales"] + 200}, ("7 of 7", "infinity", "scales")),
    ):
        write_gsplat(path, content) if "means" in content else torch.save(content, path)
        refused(lambda: read_splats(path), "a.pt", *words)
    path.write_bytes(write_gsplat(tmp_path / "b.pt", raw).read_bytes()[:-200])
    refused(lambda: read_splats(path), "a.pt", "cannot be read")
    assert find_format(tmp_path / "b.pt").NAME == "checkpoint"
