from dataclasses import replace
from functools import partial
from importlib.util import find_spec

import numpy as np
import pytest
import pyvista as pv
import torch
from cases_viz import data, some_camera, some_gaussians, some_plotter
from messages import refused, tells

from kfgs.cameras.camera import Distortion
from kfgs.splat import rasterize
from kfgs.splat.covariance import covariance_3d
from kfgs.viz import FeatureColors, add_cloud, look_through, make_plotter, palette, show_cloud, to_pyvista
from kfgs.viz.clouds import recolor_cloud
from kfgs.viz.colors import cloud_colors

C0 = 0.28209479177387814

STYLES = ("points", "gaussians", "ellipsoids")


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


def test_what_cannot_be_drawn_is_named(plotter, monkeypatch):
    gaussians = some_gaussians()
    for field, color_by in (("labels", "label"), ("sh", "rgb"), ("features", "feature")):
        for draw in (partial(add_cloud, plotter), show_cloud):
            with pytest.raises(ValueError, match=tells(f"gaussians.{field}:", "got None")):
                draw(gaussians.replace(**{field: None}), color_by=color_by)
    faint, nan = gaussians.replace(opacities=torch.full((60,), 0.4)), torch.full((60,), torch.nan)
    scores = torch.zeros(60)
    draw = partial(add_cloud, plotter, gaussians)
    refused(lambda: add_cloud(plotter, gaussians[:0]), "gaussians:", "got none")
    refused(lambda: draw(style="spheres"), "style:", "'points', 'gaussians'", "got 'spheres'")
    refused(lambda: draw(color_by="colour"), "color_by:", "'rgb'", "'class 4'", "got 'colour'")
    refused(lambda: draw(color_by=torch.zeros(59)), "color_by:", "[N]", "N = 60", "got (59,)")
    assert data(draw(color_by=gaussians.labels == 2))["score"].tolist() == (gaussians.labels == 2).double().tolist()
    refused(lambda: draw(color_by=scores, clim=(1.0, 1.0)), "clim[1]:", "got 1.0")
    refused(lambda: draw(color_by="view"), "color_by:", "'rgb'", "'points'", "got 'view'")
    refused(lambda: add_cloud(plotter, faint, style="ellipsoids"), "gaussians:", "above 0.5", "got 0")
    monkeypatch.setattr("kfgs.viz.clouds.MOST", 10)
    refused(lambda: draw(style="ellipsoids"), "gaussians:", "10", "got 29")
    bent = replace(some_camera(), distortion=Distortion("brown_conrady", (0.1, 0, 0, 0)))
    refused(lambda: look_through(plotter, bent), "camera:", "pinhole", "brown_conrady")
    assert (data(draw(color_by=nan))["rgb"] == 128).all()


def test_scores_and_arrays_become_colours(plotter):
    gaussians = some_gaussians(5)
    scores = torch.tensor([0.0, 0.5, 1.0, 7.0, float("nan")])
    cloud = data(add_cloud(plotter, gaussians, color_by=scores, clim=(0, 1)))
    dark, middle, bright, above, nan = cloud["rgb"].astype(int)
    assert (dark.tolist(), bright.tolist(), nan.tolist()) == ([0, 34, 77], [253, 231, 55], [128, 128, 128])  # cividis
    assert dark.sum() < middle.sum() < bright.sum()
    np.testing.assert_array_equal(above, bright)
    np.testing.assert_array_equal(cloud["score"], scores)
    labels = np.array([3, -1, 0, 2, 2])
    cloud = data(add_cloud(plotter, gaussians, color_by=labels))
    np.testing.assert_array_equal(cloud["rgb"], palette(labels))
    np.testing.assert_array_equal(cloud["label"], labels)  # those shown
    colors = np.arange(15, dtype=np.uint8).reshape(5, 3)
    np.testing.assert_array_equal(data(add_cloud(plotter, gaussians, color_by=colors))["rgb"], colors)


def test_range_of_scores_leaves_the_outermost_out():
    gaussians = some_gaussians(1000)
    scores = torch.linspace(0, 1, 1000)
    scores[0], scores[-1] = -50, 50
    np.testing.assert_allclose(cloud_colors(gaussians, scores).clim, [0.01, 0.99], atol=2e-3)
    rare = torch.zeros(1000)
    rare[3] = 2
    assert cloud_colors(gaussians, rare).clim == (-0.5, 2.5)
    assert cloud_colors(gaussians, torch.ones(1000)).clim == (0.5, 1.5)


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


def test_what_there_is_decides_the_colours_when_nothing_is_asked_for():
    cloud = some_gaussians(30)
    labelled = cloud.replace(labels=torch.arange(30) % 3)
    plain = cloud.replace(sh=None, labels=None, features=None)
    with_features = plain.replace(features=torch.rand(30, 5))
    assert np.array_equal(to_pyvista(labelled)["rgb"], palette(labelled.labels))
    colored = labelled.replace(labels=None)
    assert np.array_equal(to_pyvista(colored)["rgb"], to_pyvista(colored, "rgb")["rgb"])
    fitted = FeatureColors.fit(with_features.features)
    expected = to_pyvista(with_features, fitted(with_features.features))["rgb"]
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
    np.testing.assert_allclose(points["opacity"], cloud.opacities[5:])
    np.testing.assert_array_equal(points["index"], np.arange(25))
    assert {"rgb", "score"} <= set(points.point_data)
    refused(lambda: to_pyvista("cloud.ply"), "gaussians", "str", error=TypeError)


def test_pyvistas_own_words_pass_through(plotter):
    gaussians = some_gaussians()
    for style in STYLES:
        actor = add_cloud(plotter, gaussians, style=style, name="cloud", opacity=0.25, point_size=9)
        assert [*plotter.actors.values()] == [actor]  # that of the same name was replaced
        assert (actor.prop.opacity, actor.prop.point_size) == (0.25, 9)
    look_through(plotter, some_camera())
    before = plotter.screenshot(return_img=True)
    shown = add_cloud(plotter, gaussians, color_by="opacity", cmap="plasma", show_scalar_bar=True, name="cloud")
    assert (plotter.screenshot(return_img=True) != before).any()  # replaced and drawn
    assert [*plotter.scalar_bars.keys()] == ["opacity"]
    np.testing.assert_array_equal(
        data(shown)["rgb"], to_pyvista(gaussians, cloud_colors(gaussians, "opacity", cmap="plasma").rgb)["rgb"]
    )


@pytest.mark.skipif(find_spec("trame_pyvista") is None, reason="needs pyvista[jupyter]")
@pytest.mark.parametrize("style", STYLES)
def test_a_page_that_pyvista_exports_has_the_cloud(style, tmp_path):
    plotter, sizes = pv.Plotter(off_screen=True), []
    for name in ("empty", "full"):
        plotter.trame.export_vtksz(tmp_path / f"{name}.zip")
        sizes.append((tmp_path / f"{name}.zip").stat().st_size)
        add_cloud(plotter, some_gaussians(500), style=style)
    plotter.close()
    assert sizes[1] > sizes[0] + 500 * 12  # at least the positions


def test_a_pick_is_the_gaussian_that_shows_most_there():
    cloud, camera, picked = some_gaussians(), some_camera(), []
    weights, alpha, _ = rasterize(cloud.replace(features=torch.eye(60)), camera)
    most = torch.where(alpha > 0.05, weights.argmax(-1), -1).flip(0)  # rows from below
    with some_plotter():
        plotter = make_plotter(camera.height, 2 * camera.width, shape=(1, 2), off_screen=True)
    plotter.subplot(0, 1)
    add_cloud(plotter, cloud, style="gaussians", on_pick=picked.append)
    look_through(plotter, camera)
    plotter.screenshot()
    for x, y in np.ndindex(16, 12):
        plotter.iren.picker.Pick(camera.width + 10 * x, 10 * y, 0, plotter.renderer)
    assert picked == most[::10, ::10].T.flatten().tolist()
    assert len(set(picked)) > 8
    plotter.close()


def test_a_faint_cloud_of_gaussians_is_faint(plotter):
    look_through(plotter, some_camera())
    seen = []
    for opacity in (1.0, 0.2):
        add_cloud(plotter, some_gaussians(), style="gaussians", name="cloud", opacity=opacity)
        seen.append(plotter.screenshot(return_img=True).astype(int).sum())
    assert seen[1] < 0.5 * seen[0]


def with_floaters(count=3):
    """400 Gaussians in [-1, 1]^3, some of them 1000 away, and opaque."""
    gaussians = some_gaussians(400)
    means, opacities = gaussians.means.clone(), gaussians.opacities.clone()
    means[:count], opacities[:count] = torch.tensor([-1000.0, -400, -700]), 0.9
    return gaussians.replace(means=means, opacities=opacities)


def test_the_middle_box_leaves_one_in_a_hundred_out_on_each_side(plotter):
    points = np.random.default_rng(0).permuted(np.tile(np.arange(200.0), (3, 1)), axis=1).T
    points[points == 199] = 1e6
    cloud = some_gaussians(200).replace(means=torch.from_numpy(points).float())
    box = data(add_cloud(plotter, cloud)).field_data["box"]
    np.testing.assert_allclose(box, [0, 197 + 0.05 * 195] * 3)  # 2 to 197, but no less than 0


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
