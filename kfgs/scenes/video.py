"""The sharp frames of a video, for structure from motion."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from contextlib import closing
from itertools import groupby, islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.filters import laplacian
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from .._check import check_range, one_line
from .._files import as_path, atomic_folder, check_output, digest_file, read_json, real_path, write_json
from .files import PIXELS, SceneError, list_images, some

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
SOURCE = "source.json"  # in the folder of the pictures: what they were made of
CANDIDATES = 8  # frames of an interval that are compared: 8 of 15 find a moment between two shakes of a hand
QUALITY = 95  # of JPEG: SIFT finds the same features as in the original

Frame = NDArray[np.uint8]  # [H, W, 3]


def is_video(path: str | Path) -> bool:
    """Whether a path is a file with the ending of a video."""
    return as_path(path).suffix.lower() in VIDEO_SUFFIXES and as_path(path).is_file()


def extract_frames(video: str | Path, out: str | Path, *, fps: float = 2.0, progress: bool = False) -> list[Path]:
    """Write the sharpest frame of each part of a video that is 1 / `fps` seconds long, as `out/frame_00001.jpg`, ....

    The sharpest frame is that with the largest variance of the Laplacian of its grey values. Frames stay as they are: no
    resizing; the rotation that a phone notes in the file is applied. Frames of the same video and `fps` that are there are kept.

    Raises:
        FileNotFoundError: if there is no such file.
        FileExistsError: if `out` holds something else.
        ValueError: if `fps` is not above 0.
        SceneError: if the file cannot be decoded.
        ImportError: if imageio-ffmpeg is not installed.
    """
    video, out = as_path(video), as_path(out)
    check_range("fps", fps, 0, closed=(False, False))
    if not video.is_file():
        raise FileNotFoundError(f"{video}: no such file; expected a video there")
    source = {"video": video.name, "sha256": digest_file(video), "fps": fps}
    check_output("out", out, "a folder")
    held = sorted(file.name for file in out.iterdir()) if out.exists() else []
    if held and (SOURCE not in held or read_json(out / SOURCE) != source):
        got = f"one with {some(held, 3)}; name another scene folder (--out)"
        raise FileExistsError(f"{out}: expected a new or empty folder for the pictures, got {got}")
    if not held:
        frames = _decode(video)
        rate, numbered = next(frames), enumerate(tqdm(frames, disable=not progress, unit="frame", desc="frames"))
        step = max(1, round(rate / fps / CANDIDATES))
        with atomic_folder(out) as folder:
            for count, (_, part) in enumerate(groupby(numbered, lambda pair: math.floor(pair[0] / rate * fps)), 1):
                sharpest = max((frame for _, frame in islice(part, 0, None, step)), key=sharpness)  # two are in memory
                Image.fromarray(sharpest).save(folder / f"frame_{count:05d}.jpg", quality=QUALITY, subsampling=0)
            if not any(folder.iterdir()):
                raise SceneError(f"{video}: expected a video with frames, got none; does it play?")
            write_json(folder / SOURCE, source)
    return [out / name for name in list_images(out)]


def sharpness(frame: Frame) -> float:
    """The variance of the Laplacian of a picture's grey values: larger is sharper, if both show the same."""
    grey = torch.from_numpy(np.array(Image.fromarray(frame).convert("L"))).float()
    return float(laplacian(grey[None, None], kernel_size=3, normalized=False).var())


def _decode(video: Path) -> Iterator[Any]:
    """The frames per second of a video, and then each of them."""
    try:
        ffmpeg = importlib.import_module("imageio_ffmpeg")
    except ImportError as error:
        raise ImportError("video: expected imageio-ffmpeg to decode it; run: pip install imageio-ffmpeg") from error
    safe = ["-protocol_whitelist", "file"]  # a playlist that is named .mp4 could make ffmpeg fetch pages: files only
    try:
        with closing(ffmpeg.read_frames(str(real_path(video)), pix_fmt="rgb24", input_params=safe)) as frames:
            about = next(frames)
            (width, height), rate = about["size"], float(about["fps"])
            if not (0 < width * height <= PIXELS and 0 < rate < 10_000):
                raise ValueError(f"{width}x{height} pixels, {rate:g} frames per second")
            yield rate
            for data in frames:
                yield np.frombuffer(data, np.uint8).reshape(height, width, 3)
    except (OSError, RuntimeError, ValueError, KeyError, IndexError, StopIteration) as error:
        got = f"an error ({one_line(error, 160)}); convert it to MP4 (H.264)"
        raise SceneError(f"{video}: expected a video that ffmpeg can decode, got {got}") from error
