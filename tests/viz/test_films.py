import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from messages import tells
from PIL import Image

from kfgs.cameras import Camera
from kfgs.gaussians import Gaussians
from kfgs.splat import rasterize
from kfgs.viz import palette, save_animation, show_cloud
from kfgs.viz.films import OUTLINE, show_selection

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


def test_without_labels_a_cloud_is_shown_in_rgb_and_a_camera_of_any_precision_will_do():
    double = Camera(torch.eye(4).double(), some_camera().K.double(), 20, 12)
    plain = wall().replace(labels=None)
    np.testing.assert_array_equal(show_cloud(plain)(double), show_cloud(wall(), color_by="rgb")(some_camera()))


CAMERA = Camera(torch.eye(4), torch.tensor([[20.0, 0, 20], [0, 20, 10], [0, 0, 1]]), 40, 20)


def two(labels=(1, 2)):
    """Two opaque balls, left and right."""
    means = torch.tensor([[-1.0, 0, 2], [1, 0, 2]])
    quats, scales = torch.tensor([[1.0, 0, 0, 0]] * 2), torch.full((2, 3), 0.3)
    return Gaussians(means, quats, scales, torch.full((2,), 0.99), labels=torch.tensor(labels))


def gray(camera):
    return np.full((camera.height, camera.width, 3), 100, np.uint8)


def test_a_selection_keeps_its_colours_and_the_rest_fades():
    picture = show_selection(two(), torch.tensor([True, False]), gray)(CAMERA)
    assert picture[10, 10].tolist() == [100] * 3
    assert (picture[10, 30] > 180).all()
    assert (picture == OUTLINE).all(-1).sum() > 8
    alone = show_selection(two(), torch.tensor([True, False]))(CAMERA)
    assert alone[10, 10].max() < 100
    assert (alone[10, 30] == 255).all()
    with pytest.raises(ValueError, match=tells("mask", "(3,)")):
        show_selection(two(), torch.ones(3, dtype=torch.bool))


def cameras(count=3, height=8, width=12):
    K = torch.tensor([[10.0, 0, width / 2], [0, 10, height / 2], [0, 0, 1]])
    return [Camera(torch.eye(4), K, width, height, name=str(i)) for i in range(count)]


def shade(camera):
    """A picture that tells which camera it is from."""
    return np.full((camera.height, camera.width, 3), 40 * int(camera.name), np.uint8)


def frames_of(path):
    with Image.open(path) as film:
        frames = []
        for number in range(film.n_frames):
            film.seek(number)
            frames.append(np.asarray(film.convert("RGB")))
        return frames, film.info


def test_a_gif_holds_the_frames_their_time_and_repeats(tmp_path):
    done = []
    path = save_animation(
        tmp_path / "new" / "a.gif", shade, cameras(4), fps=12, progress=lambda *counts: done.append(counts)
    )
    frames, info = frames_of(path)
    assert [int(frame[0, 0, 0]) for frame in frames] == [0, 40, 80, 120]
    assert all((frame == frame[0, 0]).all() and frame.shape == (8, 12, 3) for frame in frames)
    assert info["loop"] == 0
    assert info["duration"] == 80  # 1/12 s in whole hundredths of a second
    assert done == [(1, 4), (2, 4), (3, 4), (4, 4)]


NAMES = ["a", "b", "c", "chair"]


def test_a_legend_reaches_the_file(tmp_path):
    cloud = Gaussians(
        torch.tensor([[0.0, 0, 2]]), torch.eye(4)[:1], torch.ones(1, 3), torch.ones(1) / 2, labels=torch.tensor([3])
    )
    path = save_animation(tmp_path / "a.gif", {"field": cloud}, cameras(2, 30, 100), names=NAMES, listed=cloud.labels)
    frames, _ = frames_of(path)
    assert all((frame[-20:] == palette(np.array(3), NAMES)).all(-1).sum() > 20 for frame in frames)


def test_a_failure_leaves_what_was_there(tmp_path):
    path = save_animation(tmp_path / "a.gif", shade, cameras())
    before = path.read_bytes()

    def broken(camera):
        if camera.name == "1":
            raise RuntimeError("no more light")
        return shade(camera)

    with pytest.raises(RuntimeError, match="no more light"):
        save_animation(path, broken, cameras())
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.gif"]


def film_writer(monkeypatch):
    """In the place of imageio-ffmpeg: keeps what it is given."""
    kept = SimpleNamespace(frames=[], size=None, options={}, closed=False)

    def write_frames(path, size, **options):
        kept.size, kept.options = size, options
        Path(path).touch()
        try:
            while True:
                frame = yield
                if frame is not None:
                    kept.frames.append(frame.copy())
        finally:
            kept.closed = True

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", SimpleNamespace(write_frames=write_frames))
    return kept


def test_a_video_of_odd_size_gains_a_white_edge(tmp_path, monkeypatch):
    kept = film_writer(monkeypatch)
    save_animation(tmp_path / "a.mp4", shade, cameras(3, 7, 11), fps=24)
    assert kept.size == (12, 8)
    assert kept.options["fps"] == 24
    assert kept.closed
    assert [int(frame[0, 0, 0]) for frame in kept.frames] == [0, 40, 80]
    for frame in kept.frames:
        assert frame.shape == (8, 12, 3)
        assert (frame[7] == 255).all()
        assert (frame[:, 11] == 255).all()


@pytest.mark.skipif(importlib.util.find_spec("imageio_ffmpeg") is None, reason="needs imageio-ffmpeg")
def test_a_real_video_has_its_frames_and_time(tmp_path):
    import imageio_ffmpeg

    path = save_animation(tmp_path / "a.mp4", shade, cameras(6, 32, 48), fps=10)
    assert imageio_ffmpeg.count_frames_and_secs(str(path)) == (6, pytest.approx(0.6, abs=0.01))


def test_video_without_ffmpeg_says_what_to_install_before_anything_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)

    def never(camera):
        raise AssertionError

    with pytest.raises(ImportError, match=tells("expected imageio-ffmpeg", "pip install imageio-ffmpeg")):
        save_animation(tmp_path / "a.mp4", never, cameras())


@pytest.mark.parametrize(
    ("name", "fps", "message"),
    [("a.avi", 10, ("path:", ".gif", ".mp4", "got 'a.avi'")), ("a.gif", 60, ("fps:", "[0.01, 50]", "got 60")),
     ("a.gif", 0, ("fps:", "got 0"))],
)  # fmt: skip
def test_what_makes_no_film_is_refused(tmp_path, name, fps, message):
    with pytest.raises(ValueError, match=tells(*message)):
        save_animation(tmp_path / name, shade, cameras(), fps=fps)
    assert not list(tmp_path.iterdir())


def test_cameras_must_be_some_and_of_one_size(tmp_path):
    with pytest.raises(ValueError, match=tells("shows, cameras:", "got none")):
        save_animation(tmp_path / "a.gif", shade, [])
    with pytest.raises(ValueError, match=tells("cameras:", "(4, 4)", "(8, 12)")):
        save_animation(tmp_path / "a.gif", shade, [*cameras(1), *cameras(1, 4, 4)])


def test_what_is_missing_is_named():
    for field, color_by in (("labels", "label"), ("sh", "rgb"), ("features", "feature")):
        with pytest.raises(ValueError, match=tells(f"gaussians.{field}:", "got None")):
            show_cloud(wall().replace(**{field: None}), color_by=color_by)
    with pytest.raises(ValueError, match=tells("color_by:", "'label', 'rgb', 'feature'", "got 'score'")):
        show_cloud(wall(), color_by="score")
    with pytest.raises(ValueError, match=tells("background:", "got 'paper'")):
        show_cloud(wall(), background="paper")
    with pytest.raises(ValueError, match=tells("gaussians:", "got none")):
        show_cloud(wall().select(torch.zeros(1, dtype=torch.bool)))
