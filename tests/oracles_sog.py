"""SOG scenes decoded and made one Gaussian at a time, from the format's equations, in float64; images by pillow alone."""

import io
import json
import math
import zipfile
from pathlib import Path

import numpy as np
from oracles_packed import smallest_three
from PIL import Image


def unpack(path: Path) -> dict[str, bytes]:
    """The files of a zip."""
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def pack(path: Path, files: dict[str, bytes]) -> Path:
    """Put files into a zip, compressed."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def decode(data: bytes) -> np.ndarray:  # [H, W, 4]
    return np.array(Image.open(io.BytesIO(data)).convert("RGBA"))


def encode(pixels: np.ndarray, kind: str = "WEBP") -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(
        stream, kind, **({"lossless": True, "exact": True} if kind == "WEBP" else {})
    )
    return stream.getvalue()


def sog_gaussian(files: dict[str, bytes], i: int) -> dict[str, np.ndarray]:
    """Gaussian `i` of a scene of version 2."""
    meta = json.loads(files["meta.json"])

    def pixel(name: str) -> list[int]:
        image = decode(files[name])
        return [int(v) for v in image[i // image.shape[1], i % image.shape[1]]]

    low, high = (pixel(name) for name in meta["means"]["files"])
    means = []
    for axis in range(3):
        least, largest = meta["means"]["mins"][axis], meta["means"]["maxs"][axis]
        log = least + (largest - least) * (low[axis] + 256 * high[axis]) / 65535
        means.append(math.copysign(math.exp(abs(log)) - 1, log))
    r, g, b, tag = pixel(meta["quats"]["files"][0])
    color = pixel(meta["sh0"]["files"][0])
    sh = [[meta["sh0"]["codebook"][code] for code in color[:3]]]
    if "shN" in meta:
        centroids = decode(files[meta["shN"]["files"][0]])
        label = pixel(meta["shN"]["files"][1])
        row = label[0] + 256 * label[1]
        for k in range((meta["shN"]["bands"] + 1) ** 2 - 1):
            codes = centroids[row // 64, row % 64 * ((meta["shN"]["bands"] + 1) ** 2 - 1) + k]
            sh.append([meta["shN"]["codebook"][code] for code in codes[:3]])
    return {
        "means": np.array(means),
        "quats": np.array(smallest_three(tag - 252, [r, g, b], 255)),
        "scales": np.exp([meta["scales"]["codebook"][code] for code in pixel(meta["scales"]["files"][0])[:3]]),
        "opacities": np.array(color[3] / 255),
        "sh": np.array(sh),
    }
