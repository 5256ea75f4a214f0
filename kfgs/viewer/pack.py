"""Pack an exploration for the viewer in JavaScript: one JSON header and one block of bytes.

The splats are quantised: 16 bytes for shape and opacity, 4 for the constant colour, and one byte for each further harmonic
coefficient. Most of these bytes are 0, so `Packed.compressed` makes them small. Labels, scores, sources and distances
are exact: what JavaScript selects is what Python selects.
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image

from .._check import as_array
from .._rows import check_finite
from ..cameras import Camera
from ..formats.encodings import pack_smallest_three
from ..gaussians import Gaussians
from ..scenes import Scene
from ..viz.colors import COLORMAP, Array
from ..viz.films import show_photos
from ..viz.palette import palette
from .state import Exploration, Side

ALIGN = 16  # bytes: an offset at which JavaScript may start an array of any type
MEAN_STEPS = (1 << 21) - 1  # 21 bits for each coordinate
SCALE_RANGE = 12.0  # in log units: smaller scales are far below a pixel and become the smallest one
DC_STEPS = (1 << 10) - 1
# Of the harmonics above degree 0. 1/32 is 2 dB better (room_0: 50 instead of 48 dB), with 2 to 3 bytes a Gaussian more.
SH_STEP = 1 / 20
SH_PLANES = {0: 0, 1: 2, 2: 3, 3: 6}  # texels of 8 bytes that hold the coefficients above degree 0
Buffers = dict[str, Array]
PHOTO = 400  # pixels: the longer edge of a photo in the page, about 20 KB


class Packed(NamedTuple):
    """What the viewer loads."""

    header: dict[str, Any]
    data: bytes

    def compressed(self, level: int = 6) -> bytes:
        """The data as a zlib stream, which JavaScript's `inflate` reads.

        The bytes of each buffer are sorted by their place in a row first, because the last bytes of all rows are more alike
        than the bytes of one row. A row is the last axis, or a number if there is only one axis.
        """
        parts, end = [], 0
        for entry in self.header["buffers"].values():
            parts.append(self.data[end : entry["offset"]])  # padding
            end = entry["offset"] + entry["length"]
            width = np.dtype(entry["type"]).itemsize * (entry["shape"][-1] if len(entry["shape"]) > 1 else 1)
            rows = np.frombuffer(self.data[entry["offset"] : end], np.uint8).reshape(-1, width)
            parts.append(np.ascontiguousarray(rows.T).tobytes())
        return zlib.compress(b"".join([*parts, self.data[end:]]), level)


def _joined(buffers: Buffers) -> tuple[dict[str, dict[str, Any]], bytes]:
    """All arrays as one block of bytes, each at a multiple of 16, and where each one is."""
    table: dict[str, dict[str, Any]] = {}
    parts, size = [], 0
    for name, array in buffers.items():
        content = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
        table[name] = {"offset": size, "length": len(content), "type": array.dtype.name, "shape": list(array.shape)}
        parts += [content, bytes(-len(content) % ALIGN)]
        size += len(content) + len(parts[-1])
    return table, b"".join(parts)


def pack_scene(state: Exploration, *, title: str = "kfgs", scene: Scene | None = None) -> Packed:
    """Pack both sides of an exploration, the classes with their scores, the cameras, and what is asked and shown now.

    Row i of every buffer is Gaussian i of Python. A score is NaN where nothing is known about a Gaussian. `scene` has the
    photos of the cameras, found by name. A ValueError if a number of a Gaussian is not finite.
    """
    from matplotlib import colormaps

    meaning, asked = state.meaning, state.asked
    buffers: Buffers = {}
    sides = {side: _add_side(buffers, state, side) for side in state.sides}
    labels = state.labels("semantic")
    scores = np.where(labels >= 0, as_array(meaning.scores).astype(np.float32), np.float32("nan"))
    buffers["semantic/labels"] = labels.astype(np.int16)
    buffers["semantic/label_scores"] = scores.astype(np.float32)
    if "latents" in state.show_choices:
        buffers["semantic/latents"] = np.insert(state.latents, 3, 255, axis=1)  # opaque: textures have four channels
    if "color" in state.sides:
        buffers["color/source"] = state.source.astype(np.int32)
        buffers["color/far"] = rounded_far(state.far, state.distance)
    buffers["colormap"] = colormaps[COLORMAP](np.arange(256), bytes=True)
    low, high = state.distance_range
    colors = palette(torch.arange(len(meaning.names)), meaning.names)
    header = {
        "title": title,
        "origin": list(meaning.gaussians.origin),
        "sides": sides,
        "classes": [{"name": name, "color": rgb.tolist()} for name, rgb in zip(meaning.names, colors, strict=True)],
        "lambda": {"value": state.distance, "how": state.distance_how, "low": low, "high": high},
        "phrases": meaning.phrases,
        "examples": meaning.examples,
        "clim": list(state.clim) if asked is None else [0.0, 1.0],
        "cameras": _add_cameras(buffers, state, scene),
        "up": list(state.up),
        "focus": find_focus(state) if state.cameras else None,
        "default_view": 0 if state.cameras else None,
        "query": _add_scores(
            buffers, state, [*meaning.names, *([] if asked is None or asked.known else [asked.words])]
        ),
        "start": {
            "show": "color" if state.show == "rgb" else state.show,
            "words": None if asked is None else asked.words,
            "gamma": state.gamma,
        },
        "things": state.things,
    }
    header["buffers"], data = _joined(buffers)
    return Packed(header, data)


def _add_side(buffers: Buffers, state: Exploration, side: Side) -> dict[str, Any]:
    """Add the splats of a side; returns what is needed to decode them."""
    cloud = state.cloud(side)
    for name in ("quats", "scales", "opacities", "sh"):  # JSON has no NaN, and one would spoil the steps of all others
        if (values := getattr(cloud, name)) is not None:
            check_finite(f"{side}.{name}", values)
    places = as_array(cloud.means).astype(np.float64)
    low, high = np.quantile(places, [0.01, 0.99], axis=0)  # outside twice this box, steps grow with the distance
    center, half = (low + high) / 2, np.maximum(high - low, 1e-6)
    log_scales = np.log(np.maximum(as_array(cloud.scales).astype(np.float64), 1e-30))
    highest = float(log_scales.max())
    lowest = max(float(log_scales.min()), highest - SCALE_RANGE)
    step = max(highest - lowest, 1e-6) / 255
    buffers[f"{side}/splats"] = pack_splats(cloud, center, half, lowest, step)
    degree = 0 if cloud.sh is None else int(cloud.sh.shape[1] ** 0.5) - 1
    base = state.base_colors(side)
    dc_low, dc_high = min(float(base.min()), 0.0), max(float(base.max()), 1.0)  # room for new colours
    dc_step = max(dc_high - dc_low, 1e-6) / DC_STEPS
    buffers[f"{side}/dc"] = pack_dc(base, dc_low, dc_step)
    if degree:
        assert cloud.sh is not None
        buffers[f"{side}/sh"] = pack_sh(as_array(cloud.sh), SH_STEP)
    return {
        "count": len(cloud),
        "sh_degree": None if cloud.sh is None else degree,
        "antialiased": cloud.antialiased,
        "center": center.tolist(),
        "half": half.tolist(),
        "scale": [lowest, step],
        "dc": [dc_low, dc_step],
        "sh_step": SH_STEP,
    }


def rounded_far(far: Array, given: float) -> Array:  # [N] float64 -> [N] float32
    """Distances rounded down, so that `rounded < lambda` says what `far < lambda` does for every lambda that is a float32.

    The viewer sets only such lambdas. The one that is given at the start may be any number: distances next to it are
    rounded for it.
    """
    nearest = far.astype(np.float32)
    down = np.where(nearest > far, np.nextafter(nearest, np.float32(-np.inf)), nearest)
    wrong = (down.astype(np.float64) < given) & (far >= given)  # not as float32, to which NumPy would round `given`
    return np.where(wrong, np.nextafter(down, np.float32(np.inf)), down).astype(np.float32)


def find_focus(state: Exploration) -> list[float] | None:
    """The point that the cameras look at, which a drag turns about. None in a room, where a drag looks around.

    That is: if one camera in ten looks elsewhere (by 25 degrees), or 1 % of the Gaussians are a ceiling over the cameras.
    """
    centers = np.stack([as_array(camera.center).astype(np.float64) for camera in state.cameras])
    axes = np.stack([as_array(camera.viewmat).astype(np.float64)[2, :3] for camera in state.cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    point = np.linalg.lstsq(across.sum(0), np.einsum("cij,cj->i", across, centers), rcond=None)[0]
    far, up = np.linalg.norm(point - centers, axis=1), np.array(state.up)
    places = as_array(state.cloud(state.sides[-1]).means) - point
    heights, top, reach = places @ up, ((centers - point) @ up).max(), np.median(far)
    aside = np.linalg.norm(places - np.outer(heights, up), axis=1)
    over = (heights > top) & (heights < top + 2 * reach) & (aside < reach)
    looks = ((point - centers) * axes).sum(1) > 0.9 * far
    return point.tolist() if looks.mean() >= 0.9 and over.mean() < 0.01 else None


def pack_splats(
    cloud: Gaussians,
    center: Array,  # [3]
    half: Array,  # [3]
    lowest: float,
    step: float,
) -> Array:  # [N, 4] uint32
    """Position (3 x 21 bits), rotation (2 + 3 x 10), log-scales (3 x 8) and opacity (8) of each Gaussian in 16 bytes."""
    u = (as_array(cloud.means).astype(np.float64) - center) / half
    size = np.maximum(np.abs(u), 1e-30)
    contracted = np.where(size <= 1, u, (2 - 1 / size) * np.sign(u))  # all of space in [-2, 2]
    x, y, z = np.rint((contracted + 2) / 4 * MEAN_STEPS).astype(np.uint32).T
    largest, others = pack_smallest_three(cloud.quats, 1023)
    a, b, c = others.astype(np.uint32).T
    logs = np.log(np.maximum(as_array(cloud.scales).astype(np.float64), 1e-30))
    sx, sy, sz = np.rint(np.clip((logs - lowest) / step, 0, 255)).astype(np.uint32).T
    opacity = np.rint(np.clip(as_array(cloud.opacities).astype(np.float64), 0, 1) * 255).astype(np.uint32)
    words = [
        x | (y << np.uint32(21)),
        (y >> np.uint32(11)) | (z << np.uint32(10)),
        a | (b << np.uint32(10)) | (c << np.uint32(20)) | (largest[:, 0].astype(np.uint32) << np.uint32(30)),
        sx | (sy << np.uint32(8)) | (sz << np.uint32(16)) | (opacity << np.uint32(24)),
    ]
    return np.stack(words, axis=1)


def pack_dc(base: Array, low: float, step: float) -> Array:  # [N, 3] -> [N] uint32
    """The constant colour with 10 bits a channel."""
    r, g, b = np.rint(np.clip((base - low) / step, 0, DC_STEPS)).astype(np.uint32).T
    return r | (g << np.uint32(10)) | (b << np.uint32(20))


def pack_sh(sh: Array, step: float) -> Array:  # [N, K, 3] -> [planes, N, 2] uint32
    """The coefficients above degree 0 as signed bytes, eight to a texel; texel t of all Gaussians is plane t."""
    N, K, _ = sh.shape
    planes = SH_PLANES[int(K**0.5) - 1]
    rows = np.zeros((N, planes * 8), dtype=np.int8)
    rows[:, : (K - 1) * 3] = np.rint(np.clip(sh[:, 1:].reshape(N, -1) / step, -127, 127)).astype(np.int8)
    return rows.view("<u4").reshape(N, planes, 2).transpose(1, 0, 2)


def _add_scores(buffers: Buffers, state: Exploration, questions: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Add the score of each question, and return what the answer suggests, by name."""
    answers: dict[str, dict[str, Any]] = {}
    for words in questions:
        answer, scores = state.meaning.ask(words).packed()
        if answer["words"] not in answers:
            name = f"scores/{len(answers)}"
            buffers[name] = np.frombuffer(scores, np.float32)
            answers[answer["words"]] = answer | {"buffer": name}
    return answers


def _add_cameras(buffers: Buffers, state: Exploration, scene: Scene | None) -> list[dict[str, Any]]:
    """Add the photos of the cameras that have one, and describe all cameras."""
    paths = [] if scene is None else zip(scene.cameras, scene.image_paths, strict=True)
    there, packed = {camera.name for camera, path in paths if path.is_file()}, []
    show = None if scene is None else show_photos(scene)
    for index, camera in enumerate(state.cameras):
        name = None
        if show is not None and camera.name in there:
            name = f"thumbnails/{index}"
            buffers[name] = np.frombuffer(as_jpeg(show(camera.fitted(PHOTO))), dtype=np.uint8)
        packed.append(pack_camera(camera) | {"thumbnail": name})
    return packed


def pack_camera(camera: Camera) -> dict[str, Any]:
    """A camera without distortion as JSON."""
    return {
        "name": camera.name, "width": camera.width, "height": camera.height, "near": camera.near,
        "viewmat": camera.viewmat.detach().double().cpu().flatten().tolist(),
        "K": [camera.K[row, column].item() for row, column in ((0, 0), (1, 1), (0, 2), (1, 2))],
    }  # fmt: skip


def as_jpeg(picture: Array) -> bytes:  # [h, w, 3] uint8
    """A picture as a JPEG file."""
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "JPEG", quality=80)
    return stream.getvalue()
