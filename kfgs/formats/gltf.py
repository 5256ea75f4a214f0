"""glTF 2.0 with `KHR_gaussian_splatting` (ratified 2026), `.glb` or `.gltf`: Gaussians as a primitive of points.

| attribute | what |
|---|---|
| POSITION | mean |
| KHR_gaussian_splatting:ROTATION | unit quaternion x, y, z, w |
| KHR_gaussian_splatting:SCALE | standard deviations, linear |
| KHR_gaussian_splatting:OPACITY | opacity in [0, 1] |
| KHR_gaussian_splatting:SH_DEGREE_l_COEF_n | coefficient n = m + l of degree l for red, green, blue, signs as in 3DGS |
| COLOR_0 | red, green, blue, opacity for viewers that draw points only |
| _CLASS_ID, _SCORE, _other | kfgs's labels and extra columns; names of classes and columns in the primitive's `extras` |

**Convention**: glTF has x right, y up, z back; the 3DGS PLY has x right, y down, z forward. Reading and writing turn all
values, harmonics too, by 180 degrees around x, so a scene stands upright in any viewer.

**Why not a library**: pygltflib 1.16.5 reads the JSON, but not accessors, buffers and this extension, and accepts files
with accessors that reach beyond their buffers. The tests use it as an independent reader and writer.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._arrays import FileError, reading
from .._notes import tell
from ..cameras.similarity import Similarity
from ..gaussians import Gaussians
from ..splat.transform import transform_gaussians
from .gltf_document import MAGIC as GLB
from .gltf_document import BufferWriter, Document
from .ply import Columns
from .render_mode import describe_lost_mode
from .values import (
    EXACT,
    NO_DEGREE_4,
    SCORE,
    SH_C0,
    UP_AND_BACK,
    colours_to_write,
    describe_loss,
    flip_axes,
    positive_scales,
    unit_quats,
    whole_labels,
)

NAME = "gltf"
SUFFIXES = (".glb", ".gltf")
HOLDS_LABELS = True
HOLDS_ORIGIN = True
EXTENSION = "KHR_gaussian_splatting"
_WRITTEN = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
_UNDERSTOOD = (EXTENSION, "KHR_mesh_quantization")
_POINTS = 0
_LEAST_BYTES = 8  # bytes per Gaussian: with fewer, the file shows one buffer many times


def matches(head: bytes) -> bool:
    """A .glb, or JSON that mentions accessors or the extension."""
    if head.startswith(GLB):
        return True
    return head.lstrip()[:1] == b"{" and (EXTENSION.encode() in head or b'"accessors"' in head)


def read(path: Path) -> Gaussians:
    """Read all splat primitives of the default scene, moved by their nodes, in the axes of the 3DGS PLY.

    Files of older drafts are read too: scales as logarithms (recognised by negative values, which the ratified text
    forbids), `_ROTATION` and `_SCALE`, and colour and opacity from COLOR_0 if their attributes are missing.

    Raises:
        ValueError: if it is damaged, holds no splats, needs an extension that kfgs does not know (compressed splats), or
            a node mirrors or shears its splats.
    """
    with reading(path, "glTF 2.0 with Gaussians", "export it again"):
        document = Document(path)
        unknown = [name for name in document.root.get("extensionsRequired", []) if name not in _UNDERSTOOD]
        if unknown:
            raise FileError(
                f"{path}: expected a file that needs {EXTENSION} alone, got one that needs {', '.join(map(str, unknown))}; "
                "write it again without compression"
            )
        parts: list[Gaussians] = []
        total = 0
        for where, mesh, matrix in document.placed_meshes():
            for primitive in document.item("meshes", mesh).get("primitives", []):
                if EXTENSION not in primitive.get("extensions", {}):
                    continue
                part = _read_primitive(document, primitive, f"meshes[{mesh}]")
                total += len(part)
                if total * _LEAST_BYTES > path.stat().st_size + document.fetched:
                    raise FileError(
                        f"{path}: expected {total} Gaussians in more bytes; one buffer is shown too many times"
                    )
                parts.append(_place(document, where, part, matrix))
        if not parts:
            raise FileError(f"{path}: expected a primitive with {EXTENSION}, got none; it holds no splats")
        return flip_axes(_join(parts), UP_AND_BACK)


def write(path: Path, gaussians: Gaussians) -> tuple[str, ...]:
    """Write one primitive with float32 values, with labels, score, class names and extra columns.

    Raises:
        ValueError: if the cloud is empty, has no colours or labels beyond 2^24, or is too large for a .glb.
    """
    g = flip_axes(colours_to_write(gaussians, ".glb"), UP_AND_BACK)
    if len(g) == 0:
        raise ValueError("gaussians: expected at least one Gaussian, got none; glTF has no empty accessors, write .ply")
    assert g.sh is not None
    writer = BufferWriter()
    attributes = {
        "POSITION": writer.add(g.means.numpy(), bounds=True),
        f"{EXTENSION}:ROTATION": writer.add(unit_quats(g.quats)[:, [1, 2, 3, 0]].numpy()),
        f"{EXTENSION}:SCALE": writer.add(g.scales.numpy()),
        f"{EXTENSION}:OPACITY": writer.add(g.opacities.clamp(0, 1).numpy()),
    }
    for k in range(g.sh.shape[1]):
        attributes[_coefficient(k)] = writer.add(g.sh[:, k].numpy())
    color = torch.cat([g.sh[:, 0] * SH_C0 + 0.5, g.opacities[:, None]], 1)
    attributes["COLOR_0"] = writer.add((color.clamp(0, 1) * 255).round().to(torch.uint8).numpy())
    extras = _write_columns(g, writer, attributes)
    primitive = {
        "mode": _POINTS,
        "attributes": attributes,
        "extensions": {EXTENSION: _WRITTEN},
        "extras": {"kfgs": extras},
    }
    root = {
        "asset": {"version": "2.0", "generator": "kfgs"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **({"translation": list(g.origin)} if any(g.origin) else {})}],
        "meshes": [{"primitives": [primitive]}],
    }
    writer.write(path, root)
    left = {name: values for name, values in g.extra.items() if name not in extras["columns"].values()}
    lost = describe_loss(gaussians.replace(scores=None, extra=left), path.suffix, 3)
    return lost + describe_lost_mode(gaussians, path.suffix)


def _read_primitive(document: Document, primitive: dict[str, Any], where: str) -> Gaussians:
    extension, attributes = primitive["extensions"][EXTENSION], primitive["attributes"]
    kernel = extension.get("kernel", _WRITTEN["kernel"])
    if kernel != _WRITTEN["kernel"] or extension.get("extensions"):
        got = ", ".join(extension.get("extensions", ())) or repr(kernel)
        raise FileError(
            f"{document.path}: {where}: expected Gaussians of the kernel {_WRITTEN['kernel']!r} without a further extension, "
            f"got {got:.80}; write it again as plain {EXTENSION}"
        )
    if primitive.get("mode", 4) != _POINTS:
        raise document.wrong(f"{where}.mode", "0 (points)", primitive.get("mode", 4))
    for key in ("colorSpace", "projection"):
        if extension.get(key, _WRITTEN[key]) != _WRITTEN[key]:
            said = f"the file says {key} {extension[key]!r:.80}"
            tell(f"{document.path.name}: {said}: drawn as if it were {_WRITTEN[key]!r}")

    def values(width: int, *names: str) -> NDArray[np.float32] | None:
        index = next((attributes[name] for name in names if name in attributes), None)
        return None if index is None else document.values(index, width, count)

    count: int | None = None
    means = values(3, "POSITION")
    count = None if means is None else len(means)
    quats = values(4, f"{EXTENSION}:ROTATION", "_ROTATION")
    scales = values(3, f"{EXTENSION}:SCALE", "_SCALE")
    opacities, base, color = values(1, f"{EXTENSION}:OPACITY"), values(3, _coefficient(0)), values(0, "COLOR_0")
    if color is not None:
        opacities = color[:, 3:] if opacities is None and color.shape[1] == 4 else opacities
        base = (color[:, :3] - 0.5) / np.float32(SH_C0) if base is None and color.shape[1] >= 3 else base
    if means is None or quats is None or scales is None or opacities is None or base is None:
        raise document.wrong(f"{where}.attributes", "POSITION, ROTATION, SCALE, OPACITY and SH_DEGREE_0", [*attributes])
    have = [k for k in range(1, 25) if _coefficient(k) in attributes]
    if len(have) not in (0, 3, 8, 15, 24) or have != list(range(1, len(have) + 1)):
        raise document.wrong(f"{where}.attributes", "whole degrees of harmonics", [_coefficient(k) for k in have][-3:])
    if len(have) > 15:
        tell(f"{document.path.name}: {NO_DEGREE_4}")
    outside = opacities[np.isfinite(opacities) & ((opacities < 0) | (opacities > 1))]
    if outside.size:
        raise document.wrong(f"{where}.OPACITY", "values in [0, 1]", outside[:4].tolist())
    if (scales < 0).any():  # "MUST NOT be negative": a draft's logarithms
        with np.errstate(invalid="ignore"):  # left out
            scales = np.exp(np.minimum(scales, np.float32(80)))
    sh = np.stack([base, *(document.values(attributes[_coefficient(k)], 3, count) for k in have[:15])], 1)
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats)[:, [3, 0, 1, 2]],
        scales=positive_scales(document.path, scales),
        opacities=torch.from_numpy(opacities[:, 0].copy()),
        sh=torch.from_numpy(sh),
    )
    return _read_columns(document, primitive, gaussians, where)


def _coefficient(k: int) -> str:
    """The attribute of coefficient k in the order of 3DGS: degree by degree, order m from -l to l."""
    degree = math.isqrt(k)
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree * degree}"


def _read_columns(document: Document, primitive: dict[str, Any], gaussians: Gaussians, where: str) -> Gaussians:
    """Labels, score and other columns: attributes of one number whose name begins with an underscore."""
    extras = primitive.get("extras")
    ours = extras.get("kfgs") if isinstance(extras, dict) else None
    ours = ours if isinstance(ours, dict) else {}
    names, classes = ours.get("columns", {}), ours.get("classes", [])
    extra: Columns = {}
    for attribute, index in primitive["attributes"].items():
        known = attribute in ("_ROTATION", "_SCALE")
        if known or not attribute.startswith("_") or document.item("accessors", index).get("type") != "SCALAR":
            continue
        extra[str(names.get(attribute, attribute[1:].lower()))] = document.values(index, 1, len(gaussians))[:, 0].copy()
    labels, score = extra.pop("class_id", None), extra.pop(SCORE, None)
    if labels is not None:
        if (labels != np.trunc(labels))[np.isfinite(labels)].any() or (labels < -1).any() or (labels > EXACT).any():
            raise document.wrong(f"{where}._CLASS_ID", "whole numbers of -1 or more", labels[:4].tolist())
        gaussians = gaussians.replace(labels=whole_labels(labels))
    if labels is None or not all(isinstance(name, str) for name in classes):
        classes = []
    scores = None if score is None else torch.from_numpy(score)
    return gaussians.replace(scores=scores, names=tuple(classes), extra=extra)


def _place(document: Document, where: str, gaussians: Gaussians, matrix: Tensor) -> Gaussians:  # matrix: [4, 4]
    """Apply a node's matrix to the Gaussians of its mesh, and turn their colours with it."""
    if torch.equal(matrix, torch.eye(4, dtype=torch.float64)):
        return gaussians
    try:
        similarity = Similarity.from_matrix(matrix)
    except ValueError as error:
        raise FileError(
            f"{document.path}: {where}: expected a rotation, one scale for all axes and a translation ({error}); apply "
            "the node's transform in the program that wrote it"
        ) from error
    return transform_gaussians(gaussians, similarity)


def _join(parts: list[Gaussians]) -> Gaussians:
    """Join primitives to one cloud: harmonics are padded to the highest degree; columns stay if all have them."""
    if len(parts) == 1:
        return parts[0]
    clouds = [part.with_origin(parts[0].origin) for part in parts]
    most = max(cloud.sh.shape[1] for cloud in clouds if cloud.sh is not None)
    same_names = len({cloud.names for cloud in clouds if cloud.labels is not None}) <= 1
    labelled = same_names and any(cloud.labels is not None for cloud in clouds)
    scored = all(cloud.scores is not None for cloud in clouds)
    names = max((cloud.names for cloud in clouds), key=len) if labelled else ()
    padded = []
    for cloud in clouds:
        assert cloud.sh is not None
        sh: Tensor = torch.nn.functional.pad(cloud.sh, (0, 0, 0, most - cloud.sh.shape[1]))
        none = torch.full((len(cloud),), -1)
        labels = (none if cloud.labels is None else cloud.labels) if labelled else None
        extra = {name: values for name, values in cloud.extra.items() if all(name in other.extra for other in clouds)}
        scores = cloud.scores if scored else None
        padded.append(cloud.replace(sh=sh, labels=labels, scores=scores, names=names, extra=extra))
    return Gaussians.cat(padded)


def _write_columns(g: Gaussians, writer: BufferWriter, attributes: dict[str, int]) -> dict[str, Any]:
    """Add labels and the columns that float32 holds; returns the entry in `extras`, with the names of these columns."""
    columns: Columns = {}
    if g.labels is not None:
        columns["class_id"] = g.labels.numpy()
        if (high := int(columns["class_id"].max())) > EXACT:
            raise ValueError(f"labels: expected -1 to {EXACT} for glTF, got {high}; number the classes from 0")
    if g.scores is not None:
        columns[SCORE] = g.scores.numpy().astype(np.float32)
    for name, values in g.extra.items():
        as_written = values.astype(np.float32)
        if np.array_equal(as_written.astype(values.dtype), values):
            columns[name] = as_written
    extras: dict[str, Any] = {"columns": {}}
    for name, values in columns.items():
        attribute = "_" + re.sub(r"[^A-Z0-9_]", "_", name.upper())
        while attribute in attributes:
            attribute += "_"
        if np.isfinite(values).all():  # glTF forbids NaN and infinity
            attributes[attribute] = writer.add(values.astype(np.float32))
            extras["columns"][attribute] = name
    if g.labels is not None and g.names:
        extras["classes"] = list(g.names)
    return extras
