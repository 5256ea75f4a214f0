import importlib.util
import subprocess
import sys

import numpy as np
import pytest
import torch
from cases_clouds import balls
from cases_viz import C0
from messages import refused, tells
from PIL import Image, ImageSequence

from kfgs.cameras import Camera
from kfgs.viz import palette, save_animation, show_cloud
from kfgs.viz.films import OUTLINE, show_selection


def cameras(count=3, height=8, width=12):
    K = torch.tensor([[10.0, 0, width / 2], [0, 10, height / 2], [0, 0, 1]])
    return [Camera(torch.eye(4), K, width, height, name=str(i)) for i in range(count)]


def wall():
    """A nearly opaque Gaussian, far larger than the picture: alpha is 0.99, the clamp, all over it."""
    one = balls([[0.0, 0, 2]], [3], sh=torch.tensor([[[0.5, -0.5, 0.2]]]))
    return one.replace(scales=torch.full((1, 3), 40.0), opacities=torch.tensor([0.9999]))


@pytest.mark.parametrize(("background", "paper"), [("white", (255, 255, 255)), ((0.0, 0.5, 1.0), (0, 127.5, 255))])
def test_a_cloud_is_shown_in_its_label_colours_or_in_rgb_over_the_background(background, paper):
    (camera,), plain = cameras(1), wall().replace(labels=None)
    seen = show_cloud(wall(), background=background)(camera)
    assert (seen.shape, seen.dtype) == ((8, 12, 3), np.uint8)
    assert np.abs(seen - 0.99 * palette(np.array(3)).astype(float) - 0.01 * np.array(paper)).max() <= 1
    rgb = 0.99 * 255 * (0.5 + C0 * np.array([0.5, -0.5, 0.2])) + 0.01 * np.array(paper)
    for show in (show_cloud(plain, background=background), show_cloud(wall(), color_by="rgb", background=background)):
        assert np.abs(show(camera.to(torch.float64)) - rgb).max() <= 1  # a camera of any precision


def test_a_selection_keeps_its_colours_and_the_rest_fades():
    camera = Camera(torch.eye(4), torch.tensor([[20.0, 0, 20], [0, 20, 10], [0, 0, 1]]), 40, 20)
    two = balls([[-1.0, 0, 2], [1, 0, 2]], [1, 2], scales=torch.full((2, 3), 0.3), opacities=torch.full((2,), 0.99))
    gray = lambda camera: np.full((*camera.size, 3), 100, np.uint8)  # noqa: E731
    picture = show_selection(two, torch.tensor([True, False]), gray)(camera)
    assert picture[10, 10].tolist() == [100] * 3
    assert (picture[10, 30] > 180).all()
    assert (picture == OUTLINE).all(-1).sum() > 8
    alone = show_selection(two, torch.tensor([True, False]))(camera)
    assert alone[10, 10].max() < 100
    assert (alone[10, 30] == 255).all()
    refused(lambda: show_selection(two, torch.ones(3, dtype=torch.bool)), "mask", "(3,)")


def shade(camera):
    """A picture that tells which camera it is from."""
    return np.full((camera.height, camera.width, 3), 40 * int(camera.name), np.uint8)


def frames_of(path):
    with Image.open(path) as film:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)], film.info


def test_a_gif_holds_the_frames_their_time_and_repeats(tmp_path):
    done = []
    path = save_animation(tmp_path / "new" / "a.gif", shade, cameras(4), fps=12, progress=lambda *n: done.append(n))
    frames, info = frames_of(path)
    assert [int(frame[0, 0, 0]) for frame in frames] == [0, 40, 80, 120]
    assert all((frame == frame[0, 0]).all() and frame.shape == (8, 12, 3) for frame in frames)
    assert info["loop"] == 0
    assert info["duration"] == 80  # 1/12 s in whole hundredths of a second
    assert done == [(1, 4), (2, 4), (3, 4), (4, 4)]
    mixed, _ = frames_of(save_animation(path, shade, [cameras()[0], cameras(2, 4, 4)[1]]))
    assert [frame.shape for frame in mixed] == [(8, 12, 3)] * 2  # all are drawn in the size of the first


NAMES = ["a", "b", "c", "chair"]


def test_a_legend_reaches_the_file(tmp_path):
    cloud = wall().replace(opacities=torch.tensor([0.5]), names=NAMES)
    path = save_animation(tmp_path / "a.gif", {"field": cloud}, cameras(2, 30, 100), legend=cloud)
    frames, _ = frames_of(path)
    assert all((frame[-20:] == palette(np.array(3), NAMES)).all(-1).sum() > 20 for frame in frames)


def test_a_failure_leaves_what_was_there(tmp_path):
    path = save_animation(tmp_path / "a.gif", shade, cameras())
    before = path.read_bytes()

    def broken(camera):
        if camera.name == "1":
            raise RuntimeError("no more light")
        return shade(camera)

    refused(lambda: save_animation(path, broken, cameras()), "no more light", error=RuntimeError)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.gif"]


@pytest.mark.skipif(importlib.util.find_spec("imageio_ffmpeg") is None, reason="needs imageio-ffmpeg")
def test_a_video_has_its_frames_and_time_and_one_of_odd_size_a_white_edge(tmp_path):
    import imageio_ffmpeg

    path = save_animation(tmp_path / "a.mp4", shade, cameras(6, 31, 47), fps=10)
    assert imageio_ffmpeg.count_frames_and_secs(str(path)) == (6, pytest.approx(0.6, abs=0.01))
    decode = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    frames = np.frombuffer(subprocess.run(decode, capture_output=True, check=True).stdout, np.uint8).reshape(
        6, 32, 48, 3
    )
    assert [int(level) for level in frames[:, :30, :46].mean((1, 2, 3))] == pytest.approx(
        [0, 40, 80, 120, 160, 200], abs=5
    )
    assert frames[0, :30, :46].max() < 100 < min(frames[0, 31].min(), frames[0, :, 47].min())


def test_video_without_ffmpeg_says_what_to_install_before_anything_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)

    def never(camera):
        raise AssertionError

    with pytest.raises(ImportError, match=tells("expected imageio-ffmpeg", "pip install imageio-ffmpeg")):
        save_animation(tmp_path / "a.mp4", never, cameras())


def test_what_makes_no_film_is_refused(tmp_path):
    refused(lambda: save_animation(tmp_path / "a.avi", shade, cameras()), "path:", ".gif", ".mp4", "got 'a.avi'")
    refused(lambda: save_animation(tmp_path / "a.gif", shade, cameras(), fps=60), "fps:", "[0.01, 50]", "got 60")
    refused(lambda: save_animation(tmp_path / "a.gif", shade, []), "shows, cameras:", "got none")
    refused(lambda: show_cloud(wall(), color_by="score"), "gaussians.scores:", "got None", "'score'")
    refused(lambda: show_cloud(wall(), background="paper"), "background:", "got 'paper'")
    refused(lambda: show_cloud(wall()[:0]), "gaussians:", "got none")
    assert not list(tmp_path.iterdir())
