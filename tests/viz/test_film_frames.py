import numpy as np
import pytest
import torch
from kfgs.viz.film_frames import as_shows, draw_frame, legend_under, show_cloud
from messages import tells

from kfgs.cameras import Camera
from kfgs.gaussians import Gaussians
from kfgs.splat import rasterize
from kfgs.viz import FeatureColors, palette
from kfgs.viz.pictures import GAP

C0 = 0.28209479177387814


def some_camera(height=12, width=20):
    K = torch.tensor([[30.0, 0, width / 2], [0, 30, height / 2], [0, 0, 1]])
    return Camera(torch.eye(4), K, width, height)


def wall(label=3, z=2.0):
    """One nearly opaque Gaussian, far larger than the picture: alpha is 0.99, the clamp, all over it."""
    return Gaussians(
        means=torch.tensor([[0.0, 0, z]]),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        scales=torch.full((1, 3), 40.0),
        opacities=torch.tensor([0.9999]),
        features=torch.tensor([[1.0, 2, 3, 4]]),
        sh=torch.tensor([[[0.5, -0.5, 0.2]]]),
        labels=torch.tensor([label]),
    )


def test_a_cloud_is_shown_in_its_label_colours_over_the_background():
    for background, paper in (("white", (255, 255, 255)), ((0.0, 0.5, 1.0), (0, 127.5, 255))):
        seen = show_cloud(wall(), background=background)(some_camera())
        assert (seen.shape, seen.dtype) == ((12, 20, 3), np.uint8)
        expected = 0.99 * palette(np.array(3)).astype(float) + 0.01 * np.array(paper)
        assert np.abs(seen - expected).max() <= 1


def test_rgb_is_what_the_rasteriser_draws():
    seen = show_cloud(wall(), color_by="rgb", background="black")(some_camera())
    drawn = rasterize(wall().replace(features=None), some_camera()).map.clamp(0, 1).numpy() * 255
    assert np.abs(seen - drawn).max() <= 0.51
    expected = 0.99 * 255 * (0.5 + C0 * np.array([0.5, -0.5, 0.2]))
    assert np.abs(seen - expected).max() <= 1


def test_features_are_shown_through_the_scenes_colours():
    colors = FeatureColors.fit(torch.randn(50, 4, generator=torch.Generator().manual_seed(0)))
    seen = show_cloud(wall(), color_by="feature", feature_colors=colors, background="black")(some_camera())
    assert np.abs(seen - 0.99 * colors(wall().features).astype(float)).max() <= 1


def test_without_labels_a_cloud_is_shown_in_rgb_and_a_camera_of_any_precision_will_do():
    double = Camera(torch.eye(4).double(), some_camera().K.double(), 20, 12)
    plain = wall().replace(labels=None)
    np.testing.assert_array_equal(show_cloud(plain)(double), show_cloud(wall(), color_by="rgb")(some_camera()))


def test_what_is_missing_is_named():
    for field, color_by in (("labels", "label"), ("sh", "rgb"), ("features", "feature")):
        with pytest.raises(ValueError, match=tells(f"gaussians.{field}:", "got None")):
            show_cloud(wall().replace(**{field: None}), color_by=color_by)
    with pytest.raises(ValueError, match=tells("feature_colors:", "got None")):
        show_cloud(wall(), color_by="feature")
    with pytest.raises(ValueError, match=tells("color_by:", "'label', 'rgb', 'feature'", "got 'score'")):
        show_cloud(wall(), color_by="score")
    with pytest.raises(ValueError, match=tells("background:", "got 'paper'")):
        show_cloud(wall(), background="paper")
    with pytest.raises(ValueError, match=tells("gaussians:", "got none")):
        show_cloud(wall().select(torch.zeros(1, dtype=torch.bool)))


def test_pictures_lie_side_by_side_over_the_legend():
    camera = some_camera(40, 60)
    shows = as_shows({"labels": wall(3), "mine": lambda camera: torch.zeros(camera.height, camera.width, 3)})
    strip = np.full((7, 300, 3), 9, np.uint8)
    frame = draw_frame(shows, camera, strip)
    assert frame.shape[1] == 3 * GAP + 2 * 60
    assert np.abs(frame[-30, GAP + 30] - (0.99 * palette(np.array(3)).astype(float) + 2.55)).max() <= 1
    assert frame[-30, 2 * GAP + 90].tolist() == [0, 0, 0]
    assert (frame[-7:] == 9).all()
    np.testing.assert_array_equal(draw_frame(as_shows(wall()), camera), show_cloud(wall())(camera))


def test_a_picture_of_another_size_is_refused():
    with pytest.raises(ValueError, match=tells("shows['x']:", "[12, 20, 3]", "got (5, 5, 3)")):
        draw_frame(as_shows({"x": lambda camera: np.zeros((5, 5, 3))}), some_camera())


def test_what_cannot_be_shown_is_refused():
    with pytest.raises(TypeError, match=tells("shows['a']:", "got str")):
        as_shows({"a": "cloud.ply"})
    with pytest.raises(ValueError, match=tells("shows:", "got none")):
        as_shows({})


def test_the_legend_lists_every_class_of_the_clouds():
    names = [f"class {i}" for i in range(6)]
    strip = legend_under({"a": wall(3), "b": wall(5)}, names, 200)
    assert strip.shape[1] == 200
    for label, there in ((3, True), (5, True), (1, False)):
        assert ((strip == palette(np.array(label), names)).all(-1).sum() > 20) == there
    with pytest.raises(ValueError, match=tells("names:", "got none")):
        legend_under(wall().replace(labels=None), names, 200)
