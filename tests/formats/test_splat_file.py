import numpy as np
import pytest
import torch

from kfgs.formats import SplatFile
from kfgs.gaussians import Gaussians


def _cloud(n: int = 4) -> Gaussians:
    return Gaussians(
        means=torch.arange(3.0 * n).view(n, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.ones(n, 3),
        opacities=torch.full((n,), 0.5),
        labels=torch.arange(n) - 1,
    )


def test_columns_follow_a_selection():
    splats = SplatFile(_cloud(), {"id": np.array([7, 8, 9, 10], np.uint16)}, ("a", "b", "c"), {"format": "ply"})
    by_mask = splats.select(torch.tensor([True, False, False, True]))
    by_index = splats.select(torch.tensor([3, 0]))
    assert by_mask.extra["id"].tolist() == [7, 10]
    assert by_index.extra["id"].tolist() == [10, 7]
    assert by_index.gaussians.labels.tolist() == [2, -1]
    assert by_index.extra["id"].dtype == np.uint16
    assert by_mask.extra["id"].flags.c_contiguous
    assert (by_mask.classes, by_mask.info) == (splats.classes, splats.info)
    assert splats.extra["id"].tolist() == [7, 8, 9, 10]


def test_columns_have_one_value_a_gaussian():
    for values in (np.zeros(3), np.zeros((4, 2)), np.float32(1)):
        with pytest.raises(ValueError, match=r"extra\['id'\]: expected \[N\] with N = 4 \(from gaussians\), got \("):
            SplatFile(_cloud(), {"id": values})


def test_a_copy_leaves_the_original():
    splats = SplatFile(_cloud(), {}, ("a",))
    other = splats.replace(classes=("b", "c"))
    assert (splats.classes, other.classes) == (("a",), ("b", "c"))
    assert other.gaussians is splats.gaussians


def test_it_says_what_it_holds():
    splats = SplatFile(_cloud(), {"score": np.zeros(4)}, ("a", "b"), {"format": "spz"})
    assert len(splats) == 4
    assert repr(splats).startswith("SplatFile(spz: Gaussians(4 Gaussians, labelled")
    assert repr(splats).endswith(", 2 classes, extra score)")
    assert repr(SplatFile(_cloud())).startswith("SplatFile(new: ")
