import math

import numpy as np
import pytest
import torch

from kfgs.cameras import Camera, project_points
from kfgs.cameras.camera import Distortion
from kfgs.gaussians import Gaussians
from kfgs.labels import transfer_labels
from kfgs.splat.rasterize import rasterize
from kfgs.viz import (
    FeatureColors,
    add_cameras,
    add_cloud,
    add_legend,
    add_transfer,
    available,
    headless,
    legend_column,
    look_through,
    make_plotter,
    palette,
)
from kfgs.viz.clouds import CloudOptions

C0 = 0.28209479177387814


def some_gaussians(n=60, seed=0):
    generator = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    return Gaussians(
        means=rand(n, 3) * 2 - 1,
        quats=torch.randn(n, 4, generator=generator) * 3,
        scales=rand(n, 3) * 0.2 + 0.03,
        opacities=rand(n) * 0.8 + 0.1,
        features=rand(n, 4),
        sh=(rand(n, 1, 3) - 0.5) / C0,
        labels=torch.arange(n) % 6 - 1,
    )


def some_camera(height=120, width=160):
    """Off-centre, with two focal lengths, turned about all axes."""
    viewmat = torch.eye(4, dtype=torch.float64)
    spin = torch.tensor([[0, -0.3, 0.2], [0.3, 0, -0.1], [-0.2, 0.1, 0]], dtype=torch.float64)
    viewmat[:3, :3] = torch.linalg.matrix_exp(spin)
    viewmat[2, 3] = 4
    K = torch.tensor([[150, 0, 85], [0, 165, 55], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat, K, width, height)


@pytest.fixture
def plotter():
    if not available():
        pytest.skip(headless.probe().reason)
    plotter = make_plotter(120, 160, background="black", off_screen=True)
    yield plotter
    plotter.close()


def data(actor):
    return actor.mapper.dataset


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
        with pytest.raises(ValueError, match=rf"gaussians\.{field}: expected .*got None"):
            add_cloud(plotter, gaussians.replace(**{field: None}), color_by=color_by)
    with pytest.raises(ValueError, match="feature_colors: expected it"):
        add_cloud(plotter, gaussians, color_by="feature")
    with pytest.raises(ValueError, match="expected at least one Gaussian to draw"):
        add_cloud(plotter, gaussians.select(torch.zeros(60, dtype=torch.bool)))
    with pytest.raises(ValueError, match="style: expected one of 'points', 'gaussians'"):
        add_cloud(plotter, gaussians, style="spheres")
    with pytest.raises(ValueError, match="color_by: expected one of"):
        add_cloud(plotter, gaussians, color_by="colour")


def test_viewer_agrees_with_the_rasteriser(plotter):
    gaussians, camera = some_gaussians(), some_camera()
    add_cloud(plotter, gaussians, color_by="rgb", style="gaussians")
    look_through(plotter, camera)
    seen = plotter.screenshot(return_img=True) / 255
    expected = rasterize(gaussians.replace(features=None), camera.to(torch.float32)).map.clamp(0, 1).numpy()
    assert expected.max() > 0.3
    assert -10 * math.log10(((seen - expected) ** 2).mean()) > 45  # measured: 52 dB


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
        actor = add_cloud(
            plotter, one.replace(means=mean, labels=torch.tensor([3])), options=CloudOptions(point_size=5)
        )
        look_through(plotter, camera)
        rows, columns = np.nonzero(plotter.screenshot(return_img=True).any(axis=-1))
        np.testing.assert_allclose([columns.mean() + 0.5, rows.mean() + 0.5], xy[0], atol=0.75)  # a raster step
        plotter.remove_actor(actor)


def test_look_through_refuses_a_distorting_lens(plotter):
    camera = some_camera()
    bent = Camera(camera.viewmat, camera.K, 160, 120, distortion=Distortion("brown_conrady", (0.1, 0, 0, 0)))
    with pytest.raises(ValueError, match="camera: expected a pinhole camera"):
        look_through(plotter, bent)


def test_transfer_lines_join_destination_and_source(plotter):
    src, dst = some_gaussians(80, 1), some_gaussians(50, 2)
    transfer = transfer_labels(src.means, src.labels, dst.means, 0.3)
    assert 10 < transfer.labelled < 50
    lines = data(add_transfer(plotter, src, dst, transfer))
    assert lines.n_cells == transfer.labelled
    ends = lines.points.reshape(-1, 2, 3)
    np.testing.assert_allclose(ends[:, 0], dst.means[lines["destination"]])
    np.testing.assert_allclose(ends[:, 1], src.means[lines["source"]])
    np.testing.assert_allclose(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1), lines["distance"], atol=1e-6)
    np.testing.assert_array_equal(lines["label"], src.labels[lines["source"]])
    np.testing.assert_array_equal(lines["rgb"], palette(lines["label"]))
    few = data(add_transfer(plotter, src, dst, transfer, sample=7))
    assert few.n_cells == 7
    assert len(set(few["destination"])) == 7


def test_wrong_transfers_are_named(plotter):
    src, dst = some_gaussians(80, 1), some_gaussians(50, 2)
    transfer = transfer_labels(src.means, src.labels, dst.means, 0.3)
    with pytest.raises(ValueError, match=r"transfer.labels: expected \[N\] with N = 80"):
        add_transfer(plotter, src, src, transfer)
    with pytest.raises(ValueError, match="transfer: expected sources below 2"):
        add_transfer(plotter, src.select(torch.arange(2)), dst, transfer)
    with pytest.raises(ValueError, match="got none within 1e-09; raise the distance"):
        add_transfer(plotter, src, dst, transfer_labels(src.means, src.labels, dst.means, 1e-9))


def test_legend_is_drawn_as_it_is_in_the_lower_left_corner(plotter):
    labels, names = torch.tensor([2, -1, 0, 2]), ["wall", "floor", "rug"]
    add_legend(plotter, labels, names)
    expected = legend_column(labels, names)
    height, width, _ = expected.shape
    picture = plotter.screenshot(return_img=True)
    np.testing.assert_array_equal(picture[120 - 10 - height : 120 - 10, 10 : 10 + width], expected)
    assert not picture[: 120 - 10 - height].any()
    with pytest.raises(ValueError, match="names: expected a name for every label up to 5"):
        add_legend(plotter, np.array([5]), ["wall"])


def test_frusta_open_like_their_cameras(plotter):
    camera = some_camera()
    mesh = data(add_cameras(plotter, [camera, camera], size=0.5))
    assert mesh["camera"].tolist() == [0] * 10 + [1] * 10
    ends = torch.from_numpy(np.array(mesh.points)).double().reshape(20, 2, 3)
    np.testing.assert_allclose(ends[:4, 0], camera.center.expand(4, 3), atol=1e-6)
    in_camera = ends[:4, 1] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    np.testing.assert_allclose(in_camera[:, 2], 0.5, atol=1e-6)
    pixels = in_camera @ camera.K.T / in_camera[:, 2:]
    np.testing.assert_allclose(pixels[:, :2], [(0, 0), (160, 0), (160, 120), (0, 120)], atol=1e-4)
    ridge = ends[8, 1] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    assert (ridge @ camera.K.T / ridge[2])[1] < 0  # the roof is above the picture


def test_size_of_frusta_follows_the_cameras(plotter):
    camera = some_camera()
    moved = camera.viewmat.clone()
    moved[:3, 3] += 10 * moved[:3, 0]
    far = Camera(moved, camera.K, 160, 120)
    extent = (far.center - camera.center).abs().max()
    mesh = data(add_cameras(plotter, [camera, far]))
    ends = np.array(mesh.points).reshape(20, 2, 3)
    forward = camera.viewmat[2, :3].numpy()
    np.testing.assert_allclose((ends[0, 1] - ends[0, 0]) @ forward, 0.05 * extent, rtol=1e-5)
    with pytest.raises(ValueError, match="cameras: expected at least one camera"):
        add_cameras(plotter, [])
    with pytest.raises(ValueError, match=r"size: expected a number in \(0"):
        add_cameras(plotter, [camera], size=0.0)


def test_scene_of_everything_is_not_blank(plotter):
    src, dst = some_gaussians(80, 1), some_gaussians(50, 2)
    transfer = transfer_labels(src.means, src.labels, dst.means)
    background = plotter.screenshot(return_img=True).reshape(-1, 3)
    add_cloud(plotter, src)
    add_cloud(plotter, dst, color_by="rgb")
    add_transfer(plotter, src, dst, transfer)
    add_cameras(plotter, [some_camera()], color="white")
    add_legend(plotter, src.labels, [f"class {i}" for i in range(5)])
    plotter.reset_camera()
    picture = plotter.screenshot(return_img=True).reshape(-1, 3)
    assert len(np.unique(background, axis=0)) == 1
    assert len(np.unique(picture, axis=0)) > 10
    assert (picture != background).any(axis=1).mean() > 0.05
