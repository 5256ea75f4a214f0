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

from .._notes import tell
from ..gaussians import Gaussians
from .gltf_accessors import AccessorWriter, read_accessor
from .gltf_container import MAGIC as GLB
from .gltf_container import Document, open_document, write_document
from .gltf_nodes import place, placed_meshes
from .ply import Columns
from .render_mode import describe_lost_mode
from .values import (
    EXACT,
    NO_DEGREE_4,
    SCORE,
    SH_C0,
    UP_AND_BACK,
    Precision,
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
KERNEL, COLOR_SPACE, PROJECTION, SORTING = "ellipse", "srgb_rec709_display", "perspective", "cameraDistance"
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
    document = open_document(path)
    required = document.list_of(document.root, "extensionsRequired", "extensionsRequired")
    unknown = [name for name in required if name not in _UNDERSTOOD]
    if unknown:
        raise ValueError(
            f"{path}: expected a file that needs {EXTENSION} alone, got one that needs {', '.join(map(str, unknown))}; "
            "write it again without compression"
        )
    parts: list[Gaussians] = []
    ignored, total = 0, 0
    for where, mesh, matrix in placed_meshes(document):
        for primitive in document.list_of(document.item("meshes", mesh), "primitives", f"meshes[{mesh}].primitives"):
            extension = _extension(document, primitive, mesh)
            if extension is None:
                ignored += 1
                continue
            part = _read_primitive(document, primitive, f"meshes[{mesh}]")
            total += len(part)
            if total * _LEAST_BYTES > path.stat().st_size + document.fetched:
                raise ValueError(
                    f"{path}: expected {total} Gaussians in more bytes; one buffer is shown too many times"
                )
            parts.append(place(document, where, part, matrix))
            for key, drawn in (("colorSpace", COLOR_SPACE), ("projection", PROJECTION)):
                if extension.get(key, drawn) != drawn:
                    tell(f"{path.name}: the file says {key} {extension[key]!r:.80}: drawn as if it were {drawn!r}")
    if not parts:
        raise ValueError(
            f"{path}: expected a primitive with {EXTENSION}, got {ignored} primitives without; it holds no splats"
        )
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
    writer = AccessorWriter()
    quats = unit_quats(g.quats)[:, [1, 2, 3, 0]]
    attributes = {
        "POSITION": writer.add(g.means.numpy(), bounds=True),
        f"{EXTENSION}:ROTATION": writer.add(quats.numpy()),
        f"{EXTENSION}:SCALE": writer.add(g.scales.numpy()),
        f"{EXTENSION}:OPACITY": writer.add(g.opacities.clamp(0, 1).numpy()),
    }
    for k in range(g.sh.shape[1]):
        attributes[_coefficient(k)] = writer.add(g.sh[:, k].numpy())
    attributes["COLOR_0"] = writer.add(_fallback(g))
    extras, kept = _write_columns(g, writer, attributes)
    extension = {"kernel": KERNEL, "colorSpace": COLOR_SPACE, "projection": PROJECTION, "sortingMethod": SORTING}
    primitive = {
        "mode": _POINTS,
        "attributes": attributes,
        "extensions": {EXTENSION: extension},
        "extras": {"kfgs": extras},
    }
    root = {
        "asset": {"version": "2.0", "generator": "kfgs"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **({"translation": list(g.origin)} if any(g.origin) else {})}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": writer.accessors,
        "bufferViews": writer.views,
    }
    write_document(path, root, writer.binary())
    left = {name: values for name, values in g.extra.items() if name not in kept}
    lost = describe_loss(gaussians.replace(scores=None, extra=left), path.suffix, 3)
    return lost + describe_lost_mode(gaussians, path.suffix)


def precision(gaussians: Gaussians) -> Precision:
    """float32 of the values themselves; rotations are brought to length 1."""
    return Precision(means=0.0, scales=1e-6, rotation=1e-3, opacities=1e-7, sh0=0.0, sh_rest=0.0)


def _extension(document: Document, primitive: object, mesh: int) -> dict[str, Any] | None:
    if not isinstance(primitive, dict):
        raise document.wrong(f"meshes[{mesh}].primitives", "objects", primitive)
    extensions = document.table(primitive, "extensions", f"meshes[{mesh}].extensions")
    if EXTENSION not in extensions:
        return None
    extension = document.table(extensions, EXTENSION, EXTENSION)
    nested = document.table(extension, "extensions", f"{EXTENSION}.extensions")
    if extension.get("kernel", KERNEL) != KERNEL or nested:
        got = ", ".join(nested) or repr(extension["kernel"])
        raise ValueError(
            f"{document.path}: meshes[{mesh}]: expected Gaussians of the kernel {KERNEL!r} without a further extension, "
            f"got {got}; write it again as plain {EXTENSION}"
        )
    if primitive.get("mode", 4) != _POINTS:
        raise document.wrong(f"meshes[{mesh}].mode", "0 (points)", primitive.get("mode", 4))
    return extension


def _read_primitive(document: Document, primitive: dict[str, Any], where: str) -> Gaussians:
    attributes = document.table(primitive, "attributes", f"{where}.attributes")

    def values(width: int, *names: str) -> NDArray[np.float32] | None:
        index = next((attributes[name] for name in names if name in attributes), None)
        return None if index is None else read_accessor(document, index, width, count)

    count: int | None = None
    means = values(3, "POSITION")
    count = None if means is None else len(means)
    quats = values(4, f"{EXTENSION}:ROTATION", "_ROTATION")
    scales = values(3, f"{EXTENSION}:SCALE", "_SCALE")
    color = values(0, "COLOR_0")
    opacities = values(1, f"{EXTENSION}:OPACITY")
    base = values(3, _coefficient(0))
    if opacities is None and color is not None and color.shape[1] == 4:
        opacities = color[:, 3:]
    if base is None and color is not None and color.shape[1] >= 3:
        base = (color[:, :3] - 0.5) / np.float32(SH_C0)
    if means is None or quats is None or scales is None or opacities is None or base is None:
        raise document.wrong(f"{where}.attributes", "POSITION, ROTATION, SCALE, OPACITY and SH_DEGREE_0", [*attributes])
    coefficients = [base, *_higher(document, attributes, where, len(means))]
    outside = opacities[np.isfinite(opacities) & ((opacities < 0) | (opacities > 1))]
    if outside.size:
        raise document.wrong(f"{where}.OPACITY", "values in [0, 1]", outside[:4].tolist())
    if (scales < 0).any():  # "MUST NOT be negative": a draft's logarithms
        with np.errstate(invalid="ignore"):  # left out
            scales = np.exp(np.minimum(scales, np.float32(80)))
    sh = np.stack(coefficients, 1)
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats)[:, [3, 0, 1, 2]],
        scales=positive_scales(document.path, scales),
        opacities=torch.from_numpy(opacities[:, 0].copy()),
        sh=torch.from_numpy(sh),
    )
    return _read_columns(document, primitive, attributes, gaussians, where)


def _coefficient(k: int) -> str:
    """The attribute of coefficient k in the order of 3DGS: degree by degree, order m from -l to l."""
    degree = math.isqrt(k)
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree * degree}"


def _higher(
    document: Document, attributes: dict[str, Any], where: str, count: int
) -> list[NDArray[np.float32]]:  # of [N, 3]
    """The coefficients of degrees 1 to 4, as far as present; each degree must be complete, and none skipped."""
    have = [k for k in range(1, 25) if _coefficient(k) in attributes]
    if len(have) not in (0, 3, 8, 15, 24) or have != list(range(1, len(have) + 1)):
        raise document.wrong(f"{where}.attributes", "whole degrees of harmonics", [_coefficient(k) for k in have][-3:])
    return [read_accessor(document, attributes[_coefficient(k)], 3, count) for k in have if k < 16]


def _read_columns(
    document: Document, primitive: dict[str, Any], attributes: dict[str, Any], gaussians: Gaussians, where: str
) -> Gaussians:
    """Labels, score and other columns: attributes of one number whose name begins with an underscore."""
    extras = primitive.get("extras")
    ours = extras.get("kfgs") if isinstance(extras, dict) else None
    ours = ours if isinstance(ours, dict) else {}
    names, classes = ours.get("columns"), ours.get("classes")
    names = names if isinstance(names, dict) else {}
    extra: Columns = {}
    for attribute, index in attributes.items():
        known = attribute in ("_ROTATION", "_SCALE")
        if known or not attribute.startswith("_") or document.item("accessors", index).get("type") != "SCALAR":
            continue
        name = names.get(attribute)
        name = name if isinstance(name, str) else attribute[1:].lower()
        extra[name] = read_accessor(document, index, 1, len(gaussians))[:, 0].copy()
    if _coefficient(16) in attributes:
        tell(f"{document.path.name}: {NO_DEGREE_4}")
    labels = extra.pop("class_id", None)
    if labels is not None:
        if (labels != np.trunc(labels))[np.isfinite(labels)].any() or (labels < -1).any() or (labels > EXACT).any():
            raise document.wrong(f"{where}._CLASS_ID", "whole numbers of -1 or more", labels[:4].tolist())
        gaussians = gaussians.replace(labels=whole_labels(labels))
    if labels is None or not isinstance(classes, list) or not all(isinstance(name, str) for name in classes):
        classes = []
    score = extra.pop(SCORE, None)
    scores = None if score is None else torch.from_numpy(score)
    return gaussians.replace(scores=scores, names=tuple(classes), extra=extra)


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


def _fallback(g: Gaussians) -> NDArray[np.uint8]:  # [N, 4]
    """Base colour and opacity, for viewers that cannot draw splats."""
    assert g.sh is not None
    color = torch.cat([g.sh[:, 0] * SH_C0 + 0.5, g.opacities[:, None]], 1)
    return (color.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def _write_columns(g: Gaussians, writer: AccessorWriter, attributes: dict[str, int]) -> tuple[dict[str, Any], set[str]]:
    """Add labels and other columns; returns their entry in `extras`, and the names of the columns that fit."""
    columns: Columns = {}
    if g.labels is not None:
        columns["class_id"] = g.labels.numpy()
        if (high := int(columns["class_id"].max())) > EXACT:
            raise ValueError(f"labels: expected -1 to {EXACT} for glTF, got {high}; number the classes from 0")
    if g.scores is not None:
        columns[SCORE] = g.scores.numpy().astype(np.float32)
    for name, values in g.extra.items():
        as_written = values.astype(np.float32)
        if np.array_equal(as_written.astype(values.dtype), values):  # float32 holds them
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
    return extras, set(extras["columns"].values())
