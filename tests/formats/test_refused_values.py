"""What a splat cannot hold: refused before it is written or fused, or told as lost."""

import numpy as np
import pytest
import torch
from messages import refused, tells

from kfgs import Gaussians
from kfgs.cameras import Camera
from kfgs.fields import uplift_maps
from kfgs.formats import read_splats, write_splats


def cloud(n=5, **changes):
    values = {"means": torch.rand(n, 3), "quats": torch.ones(n, 4), "scales": torch.full((n, 3), 0.1)}
    return Gaussians(**values | {"opacities": torch.full((n,), 0.5), "sh": torch.zeros(n, 4, 3)} | changes)


WRONG = {
    "opacities of 2": ({"opacities": torch.tensor([0.5, 2, 0.5, 0.5, 0.5])}, ("opacities", "from 0 to 1", "leave")),
    "negative scales": (
        {"scales": torch.tensor([[0.1], [-1], [0.1], [0.1], [0.1]]).expand(5, 3)},
        ("scales", "above 0"),
    ),
    "a NaN mean": ({"means": torch.full((5, 3), torch.nan)}, ("means", "finite")),
    "infinite harmonics": ({"sh": torch.full((5, 1, 3), torch.inf)}, ("sh", "finite")),
    "a NaN opacity": ({"opacities": torch.full((5,), torch.nan)}, ("opacities", "leave")),
    "a rotation of length 0": (
        {"quats": torch.ones(5, 4) * torch.tensor([[1.0], [1], [0], [1], [1]])},
        ("quats", "not all 0"),
    ),
    "logarithms": ({"scales": torch.full((5, 3), -4.0)}, ("scales", "logarithms", "scales.exp()")),
    "logits": ({"opacities": torch.tensor([-4.0, 3, 0.5, 5, -1])}, ("opacities", "logits", "opacities.sigmoid()")),
}


@pytest.mark.parametrize("name", WRONG)
def test_writers_and_fusing_refuse_the_same_values(name, tmp_path):
    changes, parts = WRONG[name]
    refused(lambda: write_splats(cloud(**changes), tmp_path / "a.ply"), *parts)
    assert not list(tmp_path.iterdir())
    if "sh" in changes:  # features need no colours
        return
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=32, height=24)
    refused(lambda: uplift_maps(cloud(**changes), [camera], [torch.rand(6, 8, 4)]), *parts)


def test_maps_without_features_are_named_not_the_frame():
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=32, height=24)
    with pytest.raises(ValueError, match=tells("maps", "nonzero features", "check the teacher")):
        uplift_maps(cloud(), [camera], [torch.full((6, 8, 4), 1e-30)])


@pytest.mark.parametrize(("ending", "limit"), [(".splat", 0.5 / 0.28209479177387814), (".spz", 0.5 / 0.15)])
def test_colours_that_are_cut_off_are_told(ending, limit, tmp_path):
    inside = cloud(sh=torch.full((5, 1, 3), 0.999 * limit))
    assert write_splats(inside, tmp_path / f"a{ending}").lost == ()
    sh = torch.zeros(5, 1, 3)
    sh[3, 0, 1], sh[1, 0, 0] = -50, 2 * limit
    told = write_splats(cloud(sh=sh), tmp_path / f"b{ending}").lost
    assert told == (f"colours of 2 of 5 Gaussians beyond what {ending} holds: cut off",)
    assert (read_splats(tmp_path / f"b{ending}").sh[3, 0, 1] + limit).abs() < 0.1  # what the note is about


def test_higher_harmonics_that_are_cut_off_are_told(tmp_path):
    sh = torch.zeros(5, 4, 3)
    sh[2, 3, 0] = 1.5
    assert write_splats(cloud(sh=sh), tmp_path / "a.spz").lost == (
        "higher harmonics of 1 of 5 Gaussians beyond what .spz holds: cut off",
    )


@pytest.mark.parametrize("ending", [".glb", ".ply", ".spz"])
def test_a_column_that_would_take_the_labels_place_is_refused(ending, tmp_path):
    labelled = cloud(labels=torch.arange(5))
    splats = labelled.replace(extra={"class_id": np.linspace(0, 1, 5)}, names=tuple("abcde"))
    refused(lambda: write_splats(splats, tmp_path / f"a{ending}"), "extra['class_id']", "leave the column out")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", [".glb", ".ply"])
def test_columns_of_text_are_refused(ending, tmp_path):
    splats = cloud().replace(extra={"name": np.array(list("abcde"))})
    refused(lambda: write_splats(splats, tmp_path / f"a{ending}"), "extra['name']", "numbers", "leave the column out")


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    refused(lambda: read_splats("/proc/self/mem"), "/proc/self/mem: expected a splat file, but it cannot be read")
