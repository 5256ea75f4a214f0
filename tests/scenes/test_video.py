"""Pictures that structure from motion takes from a video."""

import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from cases_sfm import downsized
from messages import refused, tells
from PIL import Image, ImageFilter

from kfgs.cli import main
from kfgs.scenes import SceneError, load_scene
from kfgs.scenes.video import SOURCE, extract_frames, is_video, sharpness

# imageio-ffmpeg leaves the pipes of a finished ffmpeg to the garbage collector, which warns.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
SIZE = (96, 64)  # width, height


def texture(seed: int) -> Image.Image:
    g = np.random.default_rng(seed)
    return Image.fromarray(g.integers(0, 255, (8, 12, 3), dtype=np.uint8)).resize(SIZE, Image.Resampling.NEAREST)


def write_video(path: Path, frames: list[Image.Image], fps: float = 10) -> Path:
    writer = imageio_ffmpeg.write_frames(
        str(path), frames[0].size, fps=fps, codec="libx264", quality=9, macro_block_size=2
    )
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(np.asarray(frame.convert("RGB"))))
    writer.close()
    return path


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seconds at 10 frames a second; one frame of each half second is sharp, all others are blurred."""
    frames = [texture(i // 5).filter(ImageFilter.GaussianBlur(4)) for i in range(30)]
    for i in (2, 8, 12, 18, 22, 28):
        frames[i] = texture(i // 5)
    return write_video(tmp_path_factory.mktemp("video") / "walk.mp4", frames)


def test_the_sharpest_frame_of_each_half_second_is_taken(video: Path, tmp_path: Path) -> None:
    assert is_video(video)
    assert not is_video(video.parent)
    files = extract_frames(video, tmp_path / "images", fps=2)
    assert [file.name for file in files] == [f"frame_{i:05d}.jpg" for i in range(1, 7)]
    for i, file in enumerate(files):
        with Image.open(file) as frame:
            sharp = np.asarray(frame, dtype=np.float64)
        assert sharp.shape == (64, 96, 3)
        assert np.abs(sharp - np.asarray(texture(i), dtype=np.float64)).mean() < 12  # H.264 and JPEG
        blurred = np.asarray(texture(i).filter(ImageFilter.GaussianBlur(4)))
        assert sharpness(sharp.astype(np.uint8)) > 5 * sharpness(blurred)


def test_the_first_frame_of_each_interval_is_a_candidate(tmp_path: Path) -> None:
    """30 frames a second: every second frame is compared, and the second half second begins with an odd one."""
    blurred = [texture(i // 15).filter(ImageFilter.GaussianBlur(4)) for i in range(30)]
    video = write_video(tmp_path / "walk.mp4", [*blurred[:15], texture(1), *blurred[16:]], fps=30)
    with Image.open(extract_frames(video, tmp_path / "images")[1]) as frame:
        assert np.abs(np.asarray(frame, np.float64) - np.asarray(texture(1), np.float64)).mean() < 12


def test_sharpness_is_the_variance_of_the_laplacian() -> None:
    g = np.random.default_rng(1)
    grey = g.integers(0, 255, (9, 11), dtype=np.uint8)
    frame = np.repeat(grey[..., None], 3, 2)
    padded = np.pad(grey.astype(np.float64), 1, mode="reflect")
    values = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).sum((2, 3)) - 9.0 * grey
    assert sharpness(frame) == pytest.approx(values.var(ddof=1), rel=1e-4)
    assert sharpness(np.full((9, 11, 3), 7, np.uint8)) == 0


def test_frames_that_are_there_are_kept_and_others_are_not_mixed(video: Path, tmp_path: Path) -> None:
    first = extract_frames(video, tmp_path / "images", fps=1)
    times = [file.stat().st_mtime_ns for file in first]
    assert [file.stat().st_mtime_ns for file in extract_frames(video, tmp_path / "images", fps=1)] == times
    refused(lambda: extract_frames(video, tmp_path / "images", fps=2), "images", "--out", error=FileExistsError)
    assert (tmp_path / "images" / SOURCE).is_file()


def test_what_is_no_video(tmp_path: Path, video: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileNotFoundError, match=tells("none.mp4", "no such file")):
        extract_frames(tmp_path / "none.mp4", tmp_path / "out")
    (tmp_path / "bad.mp4").write_bytes(b"not a video" * 100)
    with pytest.raises(SceneError, match=tells("bad.mp4", "ffmpeg can decode", "H.264")):
        extract_frames(tmp_path / "bad.mp4", tmp_path / "out")
    refused(lambda: extract_frames(video, tmp_path / "out", fps=0), "fps")
    # a playlist that is named .mp4: ffmpeg must not open what it names
    (tmp_path / "list.mp4").write_text(
        "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nhttp://127.0.0.1:9/a.ts\n#EXT-X-ENDLIST\n"
    )
    refused(lambda: extract_frames(tmp_path / "list.mp4", tmp_path / "out"), "list.mp4", error=SceneError)
    assert not (tmp_path / "out").exists()
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=tells("imageio-ffmpeg", "pip install imageio-ffmpeg")):
        extract_frames(video, tmp_path / "out")


def test_sfm_of_a_video(shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos = downsized(shared_data / "lund_door/images", tmp_path / "photos", 6)
    frames = []
    for file in sorted(photos.iterdir()):
        with Image.open(file) as picture:
            whole = picture.convert("RGB")
            frames += [whole.filter(ImageFilter.GaussianBlur(3)), whole]
    video = write_video(tmp_path / "door.mp4", frames, fps=4)
    arguments = ["sfm", str(video), "--out", str(tmp_path / "scene"), "--min-registered", "0.8"]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "the 6 sharpest frames" in said
    scene = load_scene(tmp_path / "scene", split="all")
    assert 5 <= len(scene) <= 6
    assert scene.image(0).shape == (frames[0].height, frames[0].width, 3)
    assert len(scene.points) > 100
    for file, message in (("a.gif", ".mp4, .mov"), ("gone.mp4", "no such folder")):
        (tmp_path / "a.gif").write_bytes(b"GIF89a")
        assert main(["sfm", str(tmp_path / file), "--out", str(tmp_path / "other")]) == 1
        assert message in capsys.readouterr().err
