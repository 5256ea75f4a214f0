from types import SimpleNamespace

import numpy as np
import pytest
import torch
from messages import refused, tells

from kfgs._check import as_tensor
from kfgs.formats import read_splats, write_splats
from kfgs.gaussians import Gaussians


def cloud(count=4, features=2, degree=None, labelled=True):
    generator = torch.Generator().manual_seed(0)

    def rand(*shape):
        return torch.rand(*shape, generator=generator)

    return Gaussians(
        means=rand(count, 3),
        quats=rand(count, 4),
        scales=rand(count, 3) + 0.1,
        opacities=rand(count),
        features=None if features is None else rand(count, features),
        sh=None if degree is None else rand(count, (degree + 1) ** 2, 3),
        labels=torch.arange(count) - 1 if labelled else None,
    )


def same(a, b):
    left, right = a.to_numpy(), b.to_numpy()
    return left.keys() == right.keys() and all(np.array_equal(left[name], right[name]) for name in left)


def test_length_and_description():
    assert (len(cloud(4)), len(cloud(0))) == (4, 0)
    assert repr(cloud(4)) == "Gaussians(4 Gaussians, 2 features, labelled, torch.float32, cpu)"
    assert repr(cloud(3, None, 2, False)) == "Gaussians(3 Gaussians, SH degree 2, torch.float32, cpu)"


@pytest.mark.parametrize(
    "which",
    [
        torch.tensor([False, True, False, True]),
        np.array([False, True, False, True]),
        [1, 3],
        np.array([1, -1]),
        slice(1, None, 2),
        SimpleNamespace(mask=torch.tensor([False, True, False, True])),
    ],
)
def test_brackets_take_masks_indices_slices_and_selections(which):
    gaussians = cloud(4, degree=1)
    few = gaussians[which]
    assert same(few, gaussians.select(torch.tensor([1, 3])))
    assert torch.equal(few.means, gaussians.means[[1, 3]])
    assert few.labels.tolist() == [0, 2]


def test_brackets_take_one_index_and_slices_like_a_list():
    gaussians = cloud(4)
    assert same(gaussians[-1], gaussians.select(torch.tensor([3])))
    assert gaussians[::-1].labels.tolist() == gaussians.select(torch.arange(3, -1, -1)).labels.tolist() == [2, 1, 0, -1]
    assert len(gaussians[3:1]) == len(gaussians[[]]) == len(gaussians[torch.zeros(4, dtype=torch.bool)]) == 0
    assert [len(part) for part in gaussians] == [1, 1, 1, 1]
    for which in (torch.tensor([0, 9]), 4):
        refused(lambda which=which: gaussians[which], "which", 4, "got", error=IndexError)
    refused(lambda: gaussians[torch.rand(4)], "which", "float32", "mask", error=TypeError)
    refused(lambda: gaussians[torch.ones(3, dtype=torch.bool)], "which:", "[N]", "N = 4", "got (3,)")


def test_cat_undoes_a_split():
    gaussians = cloud(6, degree=0)
    assert same(Gaussians.cat([gaussians[:2], gaussians[2:]]), gaussians)
    refused(lambda: Gaussians.cat([]), "parts:", "got none")


def test_copies_change_nothing():
    gaussians = cloud(3)
    before = gaussians.means.clone()
    moved = gaussians.replace(means=gaussians.means + 1)
    assert torch.equal(moved.means, before + 1)
    assert torch.equal(gaussians.means, before)
    assert moved.quats is gaussians.quats
    with pytest.raises(AttributeError):
        gaussians.means = before
    converted = gaussians.to(torch.float64)
    assert (converted.means.dtype, converted.labels.dtype) == (torch.float64, torch.int64)
    attached = gaussians.replace(means=gaussians.means.clone().requires_grad_())
    assert attached.select(torch.tensor([0])).means.requires_grad
    assert not attached.detach().means.requires_grad


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("means", torch.zeros(4, 2), ("[N, 3]", "got (4, 2)")),
        ("scales", torch.zeros(3, 3), ("[N, 3]", "N = 4", "got (3, 3)")),
        ("opacities", torch.zeros(4, 1), ("[N]", "N = 4", "got (4, 1)")),
        ("features", torch.zeros(4), ("[N, D]", "N = 4", "got (4,)")),
        ("sh", torch.zeros(4, 4, 1), ("[N, K, 3]", "N = 4", "got (4, 4, 1)")),
        ("sh", torch.zeros(4, 5, 3), ("expected 1, 4, 9 or 16", "degree 0 to 3", "got 5")),
        ("labels", torch.zeros(5, dtype=torch.int64), ("[N]", "N = 4", "got (5,)")),
    ],
)
def test_refuses_shapes(name, value, match):
    refused(lambda: cloud(4).replace(**{name: value}), f"{name}:", *match)


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("means", np.zeros((4, 3), dtype=np.int64), ("int64", ".float()")),
        ("labels", torch.zeros(4), ("whole numbers", "float32", ".long()")),
        ("labels", torch.tensor([True, False, True, True]), ("whole numbers", "bool", ".long()")),
        ("quats", "wxyz", ("str", "'wxyz'")),
    ],
)
def test_refuses_other_types(name, value, match):
    refused(lambda: cloud(4).replace(**{name: value}), f"{name}:", *match, error=TypeError)


def test_arrays_are_accepted_and_given():
    gaussians = cloud(3, degree=1)
    arrays = gaussians.to_numpy()
    assert set(arrays) == {"means", "quats", "scales", "opacities", "features", "sh", "labels"}
    assert all(isinstance(array, np.ndarray) for array in arrays.values())
    assert same(Gaussians(**arrays), gaussians)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16])
def test_labels_of_any_whole_type_become_int64(dtype, tmp_path):
    labelled = cloud(degree=0).replace(labels=torch.tensor([0, 3, 1, 2], dtype=dtype))
    assert labelled.labels.dtype == torch.int64
    for name in ("a.ply", "a.spz", "a.splat"):
        write_splats(labelled, tmp_path / name)
        assert read_splats(tmp_path / name).labels.tolist() == [0, 3, 1, 2]


def test_a_cloud_is_not_an_index_and_not_an_array():
    """Each of them would walk into g[0][0][0]... without end; one ended Python."""
    g = cloud(4)
    for wrong in (g, "ab", {"a": 1}, None):
        with pytest.raises(TypeError, match=tells("which: expected a mask or whole numbers", "Selection")):
            g.select(wrong)
    for made in (g, [[g]]):
        refused(lambda made=made: np.asarray(made), "to_numpy", error=TypeError)
        refused(lambda made=made: as_tensor("means", made), "means: expected", type(made).__name__, error=TypeError)


def test_labels_scores_names_and_columns_stay_with_their_gaussians():
    g = cloud(4).replace(scores=torch.rand(4), names=("wall", "chair"), extra={"id": np.arange(4, dtype=np.uint16)})
    few = g[torch.tensor([True, False, True, False])]
    assert (few.extra["id"].tolist(), few.extra["id"].dtype) == ([0, 2], np.uint16)
    assert few.scores.equal(g.scores[[0, 2]])
    assert few.names == g.to(torch.float64).names == ("wall", "chair")
    both = Gaussians.cat([few, g])
    assert both.extra["id"].tolist() == [0, 2, 0, 1, 2, 3]
    assert "2 classes" in repr(both)
    assert "id" in repr(both)
    parts = g.replace(labels=torch.tensor([1, -1, 1, 0])).by_class()
    assert {label: part.extra["id"].tolist() for label, part in parts.items()} == {-1: [1], 0: [3], 1: [0, 2]}
    for wrong, message in (
        (few.replace(names=()), ("parts[1]", "class names", "replace()")),
        (few.replace(extra={}), ("parts[1]", "columns", "['id']", "replace()")),
        (few.replace(scores=None), ("parts[1]", "tensors", "replace()")),
    ):
        refused(lambda wrong=wrong: Gaussians.cat([g, wrong]), *message)
    refused(lambda: g.replace(extra={"id": np.arange(3)}), "extra['id']:", "N = 4", "got (3,)")
    refused(lambda: g.replace(labels=None).by_class(), "labels", "got none")
