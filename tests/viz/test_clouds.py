import numpy as np
import pytest
import torch
from cases_viz import data, some_camera, some_gaussians, some_plotter
from messages import tells

from kfgs.cameras import Camera, project_points
from kfgs.cameras.camera import Distortion
from kfgs.splat.covariance import covariance_3d
from kfgs.viz import (
    FeatureColors,
    add_cloud,
    look_through,
    palette,
    to_pyvista,
)
from kfgs.viz.clouds import middle_box, recolor_cloud

C0 = 0.28209479177387814


@pytest.fixture
def plotter():
    with some_plotter() as plotter:
        yield plotter


def test_points_carry_their_data(plotter):
    gaussians = some_gaussians()
    cloud = data(add_cloud(plotter, gaussians))
    np.testing.assert_allclose(cloud.points, gaussians.means, rtol=1e-6)
    np.testing.assert_array_equal(cloud["label"], gaussians.labels)
    np.testing.assert_array_equal(cloud["rgb"], palette(gaussians.labels))
    np.testing.assert_array_equal(cloud["index"], np.arange(60))
    np.testing.assert_allclose(cloud["opacity"], gaussians.opacities)


def test_colours_by_rgb_opacity_and_feature(plotter):
    gaussians = some_gaussians()
    rgb = data(add_cloud(plotter, gaussians, color_by="rgb"))["rgb"]
    expected = ((gaussians.sh[:, 0] * C0 + 0.5).clamp(0, 1) * 255).round().byte()
    np.testing.assert_array_equal(rgb, expected)
    by_opacity = data(add_cloud(plotter, gaussians, color_by="opacity"))["rgb"].astype(int).sum(axis=1)
    order = np.argsort(gaussians.opacities.numpy())
    assert (np.diff(by_opacity[order]) >= -6).all()  # cividis grows brighter, but for rounding
    assert by_opacity[order[-1]] > by_opacity[order[0]] + 100
    colors = FeatureColors.fit(gaussians.features)
    by_feature = data(add_cloud(plotter, gaussians, color_by="feature", feature_colors=colors))["rgb"]
    np.testing.assert_array_equal(by_feature, colors(gaussians.features))


def test_what_is_missing_is_named(plotter):
    gaussians = some_gaussians()
    for field, color_by in (("labels", "label"), ("sh", "rgb"), ("features", "feature")):
        with pytest.raises(ValueError, match=tells(f"gaussians.{field}:", "got None")):
            add_cloud(plotter, gaussians.replace(**{field: None}), color_by=color_by)
    with pytest.raises(ValueError, match=tells("gaussians:", "got none")):
        add_cloud(plotter, gaussians.select(torch.zeros(60, dtype=torch.bool)))
    with pytest.raises(ValueError, match=tells("style:", "'points', 'gaussians'", "got 'spheres'")):
        add_cloud(plotter, gaussians, style="spheres")
    with pytest.raises(ValueError, match=tells("color_by:", "got 'colour'")):
        add_cloud(plotter, gaussians, color_by="colour")


def test_scores_and_arrays_become_colours(plotter):
    gaussians = some_gaussians(5)
    scores = torch.tensor([0.0, 0.5, 1.0, 7.0, float("nan")])
    cloud = data(add_cloud(plotter, gaussians, color_by=scores, clim=(0, 1)))
    dark, middle, bright, above, nan = cloud["rgb"].astype(int)
    assert (dark.tolist(), bright.tolist(), nan.tolist()) == ([0, 34, 77], [253, 231, 55], [128, 128, 128])  # cividis
    assert dark.sum() < middle.sum() < bright.sum()
    np.testing.assert_array_equal(above, bright)
    np.testing.assert_array_equal(cloud["score"], scores)
    assert cloud.field_data["clim"].tolist() == [0, 1]
    labels = np.array([3, -1, 0, 2, 2])
    cloud = data(add_cloud(plotter, gaussians, color_by=labels))
    np.testing.assert_array_equal(cloud["rgb"], palette(labels))
    np.testing.assert_array_equal(cloud["label"], labels)  # those shown
    colors = np.arange(15, dtype=np.uint8).reshape(5, 3)
    np.testing.assert_array_equal(data(add_cloud(plotter, gaussians, color_by=colors))["rgb"], colors)


def test_range_of_scores_leaves_the_outermost_out(plotter):
    gaussians = some_gaussians(1000)
    scores = torch.linspace(0, 1, 1000)
    scores[0], scores[-1] = -50, 50
    clim = data(add_cloud(plotter, gaussians, color_by=scores)).field_data["clim"]
    np.testing.assert_allclose(clim, [0.01, 0.99], atol=2e-3)
    rare = torch.zeros(1000)
    rare[3] = 2
    assert data(add_cloud(plotter, gaussians, color_by=rare)).field_data["clim"].tolist() == [-0.5, 2.5]
    assert data(add_cloud(plotter, gaussians, color_by=torch.ones(1000))).field_data["clim"].tolist() == [0.5, 1.5]
    nothing = data(add_cloud(plotter, gaussians, color_by=torch.full((1000,), float("nan"))))
    assert (nothing["rgb"] == 128).all()


def test_wrong_values_to_colour_by_are_named(plotter):
    gaussians = some_gaussians()
    with pytest.raises(ValueError, match=tells("color_by:", "[N]", "N = 60", "got (59,)")):
        add_cloud(plotter, gaussians, color_by=torch.zeros(59))
    with pytest.raises(TypeError, match=tells("color_by:", "got bool")):
        add_cloud(plotter, gaussians, color_by=torch.zeros(60, dtype=torch.bool))
    with pytest.raises(ValueError, match=tells("clim[1]:", "got 1.0")):
        add_cloud(plotter, gaussians, color_by=torch.zeros(60), clim=(1.0, 1.0))
    with pytest.raises(ValueError, match=tells("color_by:", "'rgb'", "'points'", "got 'view'")):
        add_cloud(plotter, gaussians, color_by="view")
    with pytest.raises(ValueError, match=tells("point_size:", "got -1")):
        add_cloud(plotter, gaussians, point_size=-1)


def test_ellipsoids_are_the_gaussians_surfaces(plotter):
    gaussians = some_gaussians()
    actor = add_cloud(plotter, gaussians, style="ellipsoids")
    mesh = data(actor)
    opaque = np.flatnonzero(gaussians.opacities.numpy() > 0.5)
    np.testing.assert_array_equal(np.unique(mesh["index"]), opaque)
    inverse = torch.linalg.inv(covariance_3d(gaussians.quats, gaussians.scales).double()).numpy()
    offset = mesh.points - gaussians.means.numpy()[mesh["index"]]
    pull = np.einsum("nij,nj->ni", inverse[mesh["index"]], offset)
    np.testing.assert_allclose((pull * offset).sum(axis=1), 1, rtol=1e-3)  # one standard deviation everywhere
    normals = pull / np.linalg.norm(pull, axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.point_data.active_normals, normals, atol=1e-3)
    np.testing.assert_array_equal(mesh["rgb"], palette(gaussians.labels)[mesh["index"]])
    look_through(plotter, some_camera())
    assert (plotter.screenshot(return_img=True).reshape(-1, 3).any(axis=1)).mean() > 0.05
    recolor_cloud(actor, np.full((60, 3), 7, np.uint8))
    assert (mesh["rgb"] == 7).all()


def test_too_many_or_too_faint_ellipsoids_are_refused(plotter, monkeypatch):
    faint = some_gaussians().replace(opacities=torch.full((60,), 0.4))
    with pytest.raises(ValueError, match=tells("gaussians:", "above 0.5", "got 0")):
        add_cloud(plotter, faint, style="ellipsoids")
    monkeypatch.setattr("kfgs.viz.clouds.MOST", 10)
    with pytest.raises(ValueError, match=tells("gaussians:", "10", "got 29")):
        add_cloud(plotter, some_gaussians(), style="ellipsoids")


def test_gaussians_are_sorted_back_to_front_with_their_data(plotter):
    gaussians, camera = some_gaussians(), some_camera()
    cloud = data(add_cloud(plotter, gaussians, style="gaussians"))
    look_through(plotter, camera)
    plotter.screenshot(return_img=True)
    _, depth, _ = project_points(camera, gaussians.means.double())
    order = cloud["index"]
    assert sorted(order) == list(range(60))
    assert (np.diff(depth.numpy()[order]) <= 1e-6).all()
    np.testing.assert_allclose(cloud.points, gaussians.means[order])
    np.testing.assert_array_equal(cloud["label"], gaussians.labels[order])
    np.testing.assert_allclose(np.linalg.norm(cloud["quat"], axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(cloud["scale"], gaussians.scales[order])


def test_look_through_puts_points_on_their_pixels(plotter):
    camera = some_camera()
    one = some_gaussians(n=1)
    for seed in range(4):
        mean = torch.rand(1, 3, generator=torch.Generator().manual_seed(seed)) * 1.2 - 0.6
        xy, _, visible = project_points(camera, mean.double())
        assert visible.all()
        actor = add_cloud(plotter, one.replace(means=mean, labels=torch.tensor([3])), point_size=5)
        look_through(plotter, camera)
        rows, columns = np.nonzero(plotter.screenshot(return_img=True).any(axis=-1))
        np.testing.assert_allclose([columns.mean() + 0.5, rows.mean() + 0.5], xy[0], atol=0.75)  # a raster step
        plotter.remove_actor(actor)


def test_look_through_refuses_a_distorting_lens(plotter):
    camera = some_camera()
    bent = Camera(camera.viewmat, camera.K, 160, 120, distortion=Distortion("brown_conrady", (0.1, 0, 0, 0)))
    with pytest.raises(ValueError, match=tells("camera:", "pinhole", "brown_conrady")):
        look_through(plotter, bent)


def test_what_there_is_decides_the_colours_when_nothing_is_asked_for():
    cloud = some_gaussians(30)
    labelled = cloud.replace(labels=torch.arange(30) % 3)
    plain = cloud.replace(sh=None, labels=None, features=None)
    with_features = plain.replace(features=torch.rand(30, 5))
    assert np.array_equal(to_pyvista(labelled)["rgb"], palette(labelled.labels))
    colored = labelled.replace(labels=None)
    assert np.array_equal(to_pyvista(colored)["rgb"], to_pyvista(colored, "rgb")["rgb"])
    fitted = FeatureColors.fit(with_features.features)
    expected = to_pyvista(with_features, "feature", feature_colors=fitted)["rgb"]
    assert np.array_equal(to_pyvista(with_features)["rgb"], expected)
    assert np.array_equal(to_pyvista(plain)["rgb"], to_pyvista(plain, "opacity")["rgb"])


def test_a_point_cloud_holds_what_the_gaussians_hold():
    cloud = some_gaussians(30).replace(labels=torch.arange(30) - 1)
    points = to_pyvista(cloud[5:], torch.rand(25))
    assert points.n_points == 25
    np.testing.assert_array_equal(points.points, cloud.means[5:].numpy())
    np.testing.assert_array_equal(points["label"], cloud.labels[5:])
    np.testing.assert_allclose(points["scale"], cloud.scales[5:])
    np.testing.assert_allclose(np.linalg.norm(points["quat"], axis=1), 1, rtol=1e-6)
    assert {"index", "rgb", "opacity", "score"} <= set(points.point_data)
    with pytest.raises(TypeError, match=tells("gaussians", "str")):
        to_pyvista("cloud.ply")


STYLES = ("points", "gaussians", "ellipsoids")


def with_floaters(count=3):
    """400 Gaussians in [-1, 1]^3, some of them 1000 away, and opaque."""
    gaussians = some_gaussians(400)
    means, opacities = gaussians.means.clone(), gaussians.opacities.clone()
    means[:count], opacities[:count] = torch.tensor([-1000.0, -400, -700]), 0.9
    return gaussians.replace(means=means, opacities=opacities)


def test_the_box_leaves_one_in_a_hundred_out_on_each_side():
    points = np.random.default_rng(0).permutation(np.arange(1000.0))[:, None] * [1.0, -2.0, 0.0]
    low, high = 10 - 0.05 * 979, 989 + 0.05 * 979
    np.testing.assert_allclose(middle_box(points), [max(low, 0), min(high, 999), -1998, 0, 0, 0])
    points[:5], points[5:10] = 1e6, -1e6
    assert np.abs(middle_box(points)).max() < 2100
    few = np.array([[0.0, 0, 0], [1, 2, 3]])
    assert middle_box(few).tolist() == [0, 1, 0, 2, 0, 3]


@pytest.mark.parametrize("style", STYLES)
def test_a_floater_does_not_set_the_camera(style):
    with some_plotter() as plotter:
        add_cloud(plotter, with_floaters(1), style=style)
        for reset in (lambda: None, plotter.reset_camera, plotter.view_xy):
            reset()
            picture = plotter.screenshot(return_img=True)
            assert np.linalg.norm(plotter.camera.focal_point) < 0.5
            assert plotter.camera.distance < 10
            assert picture.any(axis=2).mean() > 0.05
            assert plotter.camera.clipping_range[1] > 700  # the floater is small, but not cut off
