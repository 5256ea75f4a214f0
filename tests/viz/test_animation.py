import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from kfgs.viz.animation import _few_colors, _indexed, save_animation, save_frames
from messages import tells
from PIL import Image

from kfgs.cameras import Camera
from kfgs.gaussians import Gaussians
from kfgs.viz import legend_strip, palette


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


def test_legend_colours_stay_exact_where_a_frame_has_thousands_of_others():
    labels = torch.arange(18)
    names = [f"class {i}" for i in range(18)]
    strip = legend_strip(labels, names, 300)
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (60, 300, 3)).astype(np.uint8)
    seen = np.asarray(_indexed(np.concatenate([picture, strip]), _few_colors(strip)).convert("RGB"))
    for color in palette(labels, names):
        there = (strip == color).all(-1)
        assert there.sum() > 20
        assert (seen[60:][there] == color).all()
    assert np.abs(seen[:60].astype(float) - picture).mean() < 25  # 192 colours for random ones
    assert np.abs(seen[60:].astype(float) - strip).mean() < 1
    plain = np.asarray(_indexed(strip, None).convert("RGB"))
    assert plain.shape == strip.shape


@pytest.mark.parametrize("width", [160, 320, 960])
def test_a_legend_of_a_hundred_classes_keeps_all_their_colours(width):
    names = [f"a long name of class {i}" for i in range(100)]  # letters have more pixels than patches
    strip = legend_strip(torch.arange(100), names, width)
    index, colors = _few_colors(strip)
    for color in palette(torch.arange(100), names):
        there = (strip == color).all(-1)
        assert there.sum() > 20
        assert (colors[index[there]] == color).all()


def test_a_small_area_has_its_colour_in_the_legend():
    names = [f"class {i}" for i in range(18)]
    strip = legend_strip(torch.arange(18), names, 300)
    picture = np.random.default_rng(0).integers(0, 256, (60, 300, 3)).astype(np.uint8)
    for i, color in enumerate(palette(torch.arange(18), names)):
        picture[20:23, 10 * i : 10 * i + 3] = color
    seen = np.asarray(_indexed(np.concatenate([picture, strip]), _few_colors(strip)).convert("RGB"))
    for i in range(18):
        area = np.s_[20:23, 10 * i : 10 * i + 3]
        assert np.abs(seen[area].astype(int) - picture[area]).max() <= 8  # Pillow looks colours up in steps of 4


NAMES = ["a", "b", "c", "chair"]


def test_a_legend_reaches_the_file(tmp_path):
    cloud = Gaussians(
        torch.tensor([[0.0, 0, 2]]), torch.eye(4)[:1], torch.ones(1, 3), torch.ones(1) / 2, labels=torch.tensor([3])
    )
    path = save_animation(tmp_path / "a.gif", {"field": cloud}, cameras(2, 30, 100), names=NAMES)
    frames, _ = frames_of(path)
    assert all((frame[-20:] == palette(np.array(3), NAMES)).all(-1).sum() > 20 for frame in frames)


def test_a_failure_leaves_what_was_there(tmp_path):
    path = save_frames(tmp_path / "a.gif", [np.zeros((4, 4, 3))])
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

    with pytest.raises(ImportError, match=tells(".mp4: expected imageio-ffmpeg", "pip install imageio-ffmpeg")):
        save_animation(tmp_path / "a.mp4", never, cameras())


@pytest.mark.parametrize(
    ("name", "frames", "fps", "message"),
    [
        ("a.avi", [np.zeros((2, 2, 3))], 10, ("path:", ".gif", ".mp4", "got 'a.avi'")),
        ("a.gif", [], 10, ("frames:", "got none")),
        ("a.gif", [np.zeros((2, 2))], 10, ("frames[0]:", "[H, W, 3]", "got (2, 2)")),
        ("a.gif", [np.zeros((2, 2, 3)), np.zeros((2, 4, 3))], 10, ("frames[1]:", "[2, 2, 3]", "got (2, 4, 3)")),
        ("a.gif", [np.zeros((2, 2, 3))], 60, ("fps:", "[0.01, 50]", "got 60")),
        ("a.gif", [np.zeros((2, 2, 3))], 1e-9, ("fps:", "[0.01, 50]", "got 1e-09")),
        ("a.gif", [np.zeros((2, 2, 3))], 0, ("fps:", "got 0")),
    ],
)
def test_what_makes_no_film_is_refused(tmp_path, name, frames, fps, message):
    with pytest.raises(ValueError, match=tells(*message)):
        save_frames(tmp_path / name, frames, fps=fps)
    assert not list(tmp_path.iterdir())


def test_cameras_must_be_some_and_of_one_size(tmp_path):
    with pytest.raises(ValueError, match=tells("cameras:", "got none")):
        save_animation(tmp_path / "a.gif", shade, [])
    with pytest.raises(ValueError, match=tells("cameras:", "(4, 4)", "(8, 12)")):
        save_animation(tmp_path / "a.gif", shade, [*cameras(1), *cameras(1, 4, 4)])
