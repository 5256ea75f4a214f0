"""Clouds as point clouds of trimesh and Open3D: the same points, colours and classes, and a clear error without them."""

import sys

import numpy as np
import pytest
import torch
from cases_viz import some_gaussians
from messages import tells

from kfgs.labels import Selection
from kfgs.viz import palette, to_open3d, to_pyvista, to_trimesh


def some_splat():
    cloud = some_gaussians()
    names = tuple(f"class {i}" for i in range(int(cloud.labels.max()) + 1))
    return cloud.replace(scores=np.linspace(0, 1, len(cloud)), names=names)


def test_a_point_cloud_of_trimesh_has_colours_and_classes(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    splat = some_splat()
    points = to_trimesh(splat)
    assert isinstance(points, trimesh.PointCloud)
    np.testing.assert_allclose(points.vertices, splat.gaussians.means, rtol=1e-6)
    np.testing.assert_array_equal(points.colors[:, :3], palette(splat.gaussians.labels))
    assert points.metadata["classes"] == list(splat.names)
    np.testing.assert_array_equal(points.metadata["label"], splat.gaussians.labels)
    np.testing.assert_allclose(points.metadata["score"], splat.scores, rtol=1e-6)
    np.testing.assert_allclose(points.metadata["scale"], splat.gaussians.scales, rtol=1e-6)
    points.export(tmp_path / "a.ply")
    assert len(trimesh.load(tmp_path / "a.ply").vertices) == len(splat)


def test_some_gaussians_in_other_colours():
    pytest.importorskip("trimesh")
    cloud = some_gaussians()
    chosen = cloud[Selection.of(cloud.labels == 1)]
    points = to_trimesh(chosen, "opacity")
    assert len(points.vertices) == int((cloud.labels == 1).sum())
    np.testing.assert_array_equal(points.colors[:, :3], to_pyvista(chosen, "opacity")["rgb"])
    assert points.metadata["classes"] == []
    assert "score" not in points.metadata


def test_a_point_cloud_of_open3d_has_the_same_arrays(tmp_path):
    open3d = pytest.importorskip("open3d")
    splat = some_splat()
    points = to_open3d(splat)
    assert isinstance(points, open3d.t.geometry.PointCloud)
    np.testing.assert_allclose(points.point.positions.numpy(), splat.gaussians.means, rtol=1e-6)
    np.testing.assert_array_equal(points.point.colors.numpy(), palette(splat.gaussians.labels))
    np.testing.assert_array_equal(points.point["label"].numpy()[:, 0], splat.gaussians.labels)
    assert points.point["scale"].shape == (len(splat), 3)
    one = points.select_by_mask(open3d.core.Tensor((splat.gaussians.labels == 1).numpy()))
    assert set(one.point["label"].numpy()[:, 0]) == {1}
    legacy = points.to_legacy()
    np.testing.assert_allclose(np.asarray(legacy.colors) * 255, palette(splat.gaussians.labels), atol=1e-3)
    open3d.t.io.write_point_cloud(str(tmp_path / "a.ply"), points)
    back = open3d.t.io.read_point_cloud(str(tmp_path / "a.ply"))
    np.testing.assert_array_equal(back.point["label"].numpy()[:, 0], splat.gaussians.labels)


@pytest.mark.parametrize(("convert", "name"), [(to_trimesh, "trimesh"), (to_open3d, "open3d")])
def test_a_missing_library_is_named_with_the_line_that_installs_it(convert, name, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=tells(f"{convert.__name__}:", f"pip install {name}")):
        convert(some_gaussians())


@pytest.mark.parametrize(("convert", "name"), [(to_trimesh, "trimesh"), (to_open3d, "open3d")])
def test_what_is_no_cloud_is_named(convert, name):
    pytest.importorskip(name)
    with pytest.raises(TypeError, match=tells("cloud:", "got Tensor")):
        convert(torch.zeros(3, 3))
