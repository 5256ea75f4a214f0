from types import SimpleNamespace

import numpy as np
import pytest
import torch
from messages import tells

from kfgs._check import as_tensor
from kfgs.cameras import Camera
from kfgs.formats import read_splats, write_splats
from kfgs.gaussians import Gaussians
from kfgs.splat import rasterize


def cloud(count=4, features=2, degree=None, labelled=True, seed=0):
    generator = torch.Generator().manual_seed(seed)

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
    names = ("means", "quats", "scales", "opacities", "features", "sh", "labels")
    return all(
        (getattr(a, n) is None and getattr(b, n) is None) or torch.equal(getattr(a, n), getattr(b, n)) for n in names
    )


def test_length_and_description():
    assert len(cloud(4)) == 4
    assert len(cloud(0)) == 0
    assert repr(cloud(4)) == "Gaussians(4 Gaussians, 2 features, labelled, torch.float32, cpu)"
    assert repr(cloud(3, features=None, degree=2, labelled=False)) == (
        "Gaussians(3 Gaussians, SH degree 2, torch.float32, cpu)"
    )


def test_select_by_mask_and_by_index_agree():
    gaussians = cloud(5, degree=1)
    mask = torch.tensor([True, False, True, False, True])
    by_mask, by_index = gaussians.select(mask), gaussians.select(torch.tensor([0, 2, 4]))
    assert same(by_mask, by_index)
    assert torch.equal(by_mask.means[1], gaussians.means[2])
    assert by_mask.labels.tolist() == [-1, 1, 3]


def test_select_keeps_the_order_of_the_index():
    gaussians = cloud(3)
    assert gaussians.select(torch.tensor([2, 0])).labels.tolist() == [1, -1]


def test_select_nothing():
    assert len(cloud(3).select(torch.zeros(3, dtype=torch.bool))) == 0


def test_cat_undoes_a_split():
    gaussians = cloud(6, degree=0)
    parts = [gaussians.select(torch.arange(6) < 2), gaussians.select(torch.arange(6) >= 2)]
    assert same(Gaussians.cat(parts), gaussians)


def test_replace_returns_a_new_object():
    gaussians = cloud(3)
    before = gaussians.means.clone()
    moved = gaussians.replace(means=gaussians.means + 1)
    assert torch.equal(moved.means, before + 1)
    assert torch.equal(gaussians.means, before)
    assert moved.quats is gaussians.quats
    with pytest.raises(AttributeError):
        gaussians.means = before


def test_to_leaves_labels_integer():
    converted = cloud(3).to(torch.float64)
    assert converted.means.dtype == converted.features.dtype == torch.float64
    assert converted.labels.dtype == torch.int64


def test_detach():
    gaussians = cloud(3)
    attached = gaussians.replace(means=gaussians.means.clone().requires_grad_())
    assert attached.select(torch.tensor([0])).means.requires_grad
    assert not attached.detach().means.requires_grad
    assert same(attached.detach(), gaussians)


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("means", torch.zeros(4, 2), ("means:", "[N, 3]", "got (4, 2)")),
        ("quats", torch.zeros(4, 3), ("quats:", "[N, 4]", "N = 4", "got (4, 3)")),
        ("scales", torch.zeros(3, 3), ("scales:", "[N, 3]", "N = 4", "got (3, 3)")),
        ("opacities", torch.zeros(4, 1), ("opacities:", "[N]", "N = 4", "got (4, 1)")),
        ("features", torch.zeros(4), ("features:", "[N, D]", "N = 4", "got (4,)")),
        ("sh", torch.zeros(4, 4, 1), ("sh:", "[N, K, 3]", "N = 4", "got (4, 4, 1)")),
        ("sh", torch.zeros(4, 5, 3), ("sh:", "expected 1, 4, 9 or 16", "degree 0 to 3", "got 5")),
        ("labels", torch.zeros(5, dtype=torch.int64), ("labels:", "[N]", "N = 4", "got (5,)")),
    ],
)
def test_refuses_shapes(name, value, match):
    with pytest.raises(ValueError, match=tells(*match)):
        cloud(4).replace(**{name: value})


def test_select_refuses_a_mask_of_another_size():
    with pytest.raises(ValueError, match=tells("which:", "[N]", "N = 4", "got (3,)")):
        cloud(4).select(torch.ones(3, dtype=torch.bool))


def test_cat_refuses_nothing_and_mixtures():
    with pytest.raises(ValueError, match=tells("parts:", "got none")):
        Gaussians.cat([])
    with pytest.raises(ValueError, match=tells("parts[1]:", "'labels'", "parts[0]")):
        Gaussians.cat([cloud(2), cloud(2, labelled=False)])


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
    assert same(gaussians[which], gaussians.select(torch.tensor([1, 3])))


def test_brackets_take_one_index_and_slices_like_a_list():
    gaussians = cloud(4)
    assert same(gaussians[-1], gaussians.select(torch.tensor([3])))
    assert gaussians[::-1].labels.tolist() == [2, 1, 0, -1]
    assert len(gaussians[3:1]) == len(gaussians[[]]) == 0
    assert [len(one) for one in gaussians] == [1, 1, 1, 1]
    with pytest.raises(IndexError, match=tells("which", 4, "got 9")):
        gaussians[torch.tensor([0, 9])]
    with pytest.raises(IndexError, match=tells("which", 4, "got 4")):
        gaussians[4]
    with pytest.raises(TypeError, match=tells("which", "float32", "mask")):
        gaussians[torch.rand(4)]


def test_arrays_are_accepted_and_given():
    gaussians = cloud(3, degree=1)
    arrays = gaussians.to_numpy()
    assert set(arrays) == {"means", "quats", "scales", "opacities", "features", "sh", "labels"}
    assert all(isinstance(array, np.ndarray) for array in arrays.values())
    assert same(Gaussians(**arrays), gaussians)


def test_values_that_cannot_be_gaussians():
    values = cloud(3, labelled=False).to_numpy()
    with pytest.raises(TypeError, match=tells("means", "int64", ".float()")):
        Gaussians(**values | {"means": np.zeros((3, 3), dtype=np.int64)})
    with pytest.raises(TypeError, match=tells("labels", "float32", ".long()")):
        Gaussians(**values, labels=torch.zeros(3))
    with pytest.raises(TypeError, match=tells("quats", "str", "'wxyz'")):
        Gaussians(**values | {"quats": "wxyz"})


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64])
def test_labels_of_any_whole_type_become_int64(dtype, tmp_path):

    labelled = cloud(degree=0).replace(labels=torch.tensor([0, 3, 1, 2], dtype=dtype))
    assert labelled.labels.dtype == torch.int64
    for name in ("a.ply", "a.spz", "a.splat"):
        write_splats(labelled, tmp_path / name)
        assert read_splats(tmp_path / name).labels.tolist() == [0, 3, 1, 2]
    assert cloud().replace(labels=np.array([0, 1, 2, 3], dtype=np.uint16)).labels.dtype == torch.int64


@pytest.mark.parametrize("labels", [torch.rand(4), np.array([0.5, 1, 2, 3]), torch.tensor([True, False, True, True])])
def test_labels_that_are_no_whole_numbers_are_refused(labels):
    with pytest.raises(TypeError, match=tells("labels:", "whole numbers", "got", ".long()")):
        cloud().replace(labels=labels)


def test_mixed_types_are_named_where_they_meet():
    camera = Camera(torch.eye(4), torch.tensor([[9.0, 0, 8], [0, 9, 8], [0, 0, 1]]), 16, 16)
    mixed = cloud().replace(features=torch.zeros(4, 2, dtype=torch.float64))
    with pytest.raises(
        ValueError, match=tells("features", "float32", "from gaussians.means", "got torch.float64", ".to(")
    ):
        rasterize(mixed, camera)


def test_a_cloud_is_no_index_and_no_array():
    """Each of them would walk into g[0][0][0]... for ever; one ended Python."""
    g = cloud(4)
    for wrong in (g, "ab", {"a": 1}, None):
        with pytest.raises(TypeError, match=tells("which: expected a mask or whole numbers", "Selection")):
            g.select(wrong)
    with pytest.raises(TypeError, match=tells("which", "list")):
        g[[g]]
    for made in (g, [g], [[g]]):
        with pytest.raises(TypeError, match=tells("to_numpy")):
            np.asarray(made)
        with pytest.raises(TypeError, match=tells("means: expected", type(made).__name__)):
            as_tensor("means", made)


def test_labels_scores_names_and_columns_stay_with_their_gaussians():
    g = cloud(4).replace(scores=torch.rand(4), names=("wall", "chair"), extra={"id": np.arange(4, dtype=np.uint16)})
    few = g[torch.tensor([True, False, True, False])]
    assert few.extra["id"].tolist() == [0, 2]
    assert few.extra["id"].dtype == np.uint16
    assert few.scores.equal(g.scores[[0, 2]])
    assert few.names == g.to(torch.float64).names == ("wall", "chair")
    assert g.to(torch.float64).scores.dtype == torch.float64
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
        with pytest.raises(ValueError, match=tells(*message)):
            Gaussians.cat([g, wrong])
    with pytest.raises(ValueError, match=tells("extra['id']:", "N = 4", "got (3,)")):
        g.replace(extra={"id": np.arange(3)})
    with pytest.raises(ValueError, match=tells("labels", "got none")):
        g.replace(labels=None).by_class()
