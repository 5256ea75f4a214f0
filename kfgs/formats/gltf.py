"""glTF 2.0 with `KHR_gaussian_splatting` (ratified 2026), `.glb` or `.gltf`: Gaussians as a primitive of points.

| attribute | what |
|---|---|
| POSITION | mean |
| KHR_gaussian_splatting:ROTATION | unit quaternion x, y, z, w |
| KHR_gaussian_splatting:SCALE | standard deviations, linear |
| KHR_gaussian_splatting:OPACITY | opacity in [0, 1] |
| KHR_gaussian_splatting:SH_DEGREE_l_COEF_n | coefficient n = m + l of degree l for red, green, blue, signs as in 3DGS |
| COLOR_0 | red, green, blue, opacity for viewers that draw points only |
| _CLASS_ID, _SCORE | kfgs's labels, float32; names of classes in the primitive's `extras` |

**Convention**: glTF has x right, y up, z back; the 3DGS PLY has x right, y down, z forward. Reading and writing turn all
values, harmonics too, by 180 degrees around x, so a scene stands upright in any viewer.

**Why not a library**: pygltflib 1.16.5 reads the JSON, but not accessors, buffers and this extension.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .._notes import tell
from ..cameras.similarity import Similarity
from ..gaussians import Gaussians
from ..splat.transform import transform_gaussians
from .gltf_document import MAGIC as GLB
from .gltf_document import BufferWriter, Document
from .values import EXACT, SH_C0, UP_AND_BACK, flip_axes, positive_scales, unit_quats, up_to_degree_3, whole_labels

NAME = "gltf"
SUFFIXES = (".glb", ".gltf")
HOLDS = frozenset({"labels", "origin", "harmonics"})
EXTENSION = "KHR_gaussian_splatting"
_WRITTEN = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
_WRITTEN |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
_UNDERSTOOD = (EXTENSION, "KHR_mesh_quantization")
_POINTS = 0
_LEAST_BYTES = 8  # bytes per Gaussian: with fewer, the file shows one buffer many times


def matches(head: bytes) -> bool:
    """A .glb, or JSON that mentions accessors or the extension."""
    is_json = head.lstrip()[:1] == b"{"
    return head.startswith(GLB) or (is_json and (EXTENSION.encode() in head or b'"accessors"' in head))


def read(path: Path) -> Gaussians:
    """Read all splat primitives of the default scene, moved by their nodes, in the axes of the 3DGS PLY."""
    document = Document(path)
    unknown = [name for name in document.root.get("extensionsRequired", []) if name not in _UNDERSTOOD]
    if unknown:
        raise ValueError(f"it needs {', '.join(map(str, unknown))}; write it with {EXTENSION} alone, uncompressed")
    parts: list[Gaussians] = []
    for mesh, matrix in document.placed_meshes():
        for primitive in document.root["meshes"][mesh]["primitives"]:
            if EXTENSION not in primitive.get("extensions", {}):
                continue
            part = _read_primitive(path, document, primitive)
            if not torch.equal(matrix, torch.eye(4, dtype=torch.float64)):
                part = transform_gaussians(part, Similarity.from_matrix(matrix))
            parts.append(part)
            if sum(map(len, parts)) * _LEAST_BYTES > path.stat().st_size + document.fetched:
                raise ValueError(f"{sum(map(len, parts))} Gaussians in fewer bytes: one buffer is shown many times")
    if not parts:
        raise ValueError(f"it has no primitive with {EXTENSION}: it holds no splats")
    return flip_axes(_join(parts), UP_AND_BACK)


def write(path: Path, g: Gaussians) -> list[str]:
    """Write one primitive with float32 values. A ValueError if it is empty, has labels beyond 2^24, or fills 4 GiB."""
    if len(g) == 0:
        raise ValueError("gaussians: expected at least one Gaussian, got none; glTF has no empty accessors, write .ply")
    g = flip_axes(g, UP_AND_BACK)
    assert g.sh is not None
    writer, means = BufferWriter(), g.means.float()
    attributes = {
        "POSITION": writer.add(means.numpy(), min=means.amin(0).tolist(), max=means.amax(0).tolist()),
        f"{EXTENSION}:ROTATION": writer.add(unit_quats(g.quats)[:, [1, 2, 3, 0]].numpy()),
        f"{EXTENSION}:SCALE": writer.add(g.scales.numpy()),
        f"{EXTENSION}:OPACITY": writer.add(g.opacities.clamp(0, 1).numpy()),
    }
    for k in range(g.sh.shape[1]):
        attributes[_coefficient(k)] = writer.add(g.sh[:, k].numpy())
    color = torch.cat([g.sh[:, 0] * SH_C0 + 0.5, g.opacities[:, None]], 1)
    attributes["COLOR_0"] = writer.add((color.clamp(0, 1) * 255).round().to(torch.uint8).numpy())
    if g.labels is not None:
        if (high := int(g.labels.max())) > EXACT:
            raise ValueError(f"labels: expected -1 to {EXACT} for glTF, got {high}; number the classes from 0")
        attributes["_CLASS_ID"] = writer.add(g.labels.numpy().astype(np.float32))
        if g.scores is not None:
            attributes["_SCORE"] = writer.add(g.scores.numpy())
    primitive = {"mode": _POINTS, "attributes": attributes, "extensions": {EXTENSION: _WRITTEN}}
    primitive["extras"] = {"kfgs": {"classes": list(g.names)}}
    root = {
        "asset": {"version": "2.0", "generator": "kfgs"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **({"translation": list(g.origin)} if any(g.origin) else {})}],
        "meshes": [{"primitives": [primitive]}],
    }
    writer.write(path, root)
    return []


def _read_primitive(path: Path, document: Document, primitive: dict[str, Any]) -> Gaussians:
    extension, attributes = primitive["extensions"][EXTENSION], primitive["attributes"]
    kernel, mode = extension.get("kernel", _WRITTEN["kernel"]), primitive.get("mode", 4)
    if kernel != _WRITTEN["kernel"] or extension.get("extensions") or mode != _POINTS:
        got = ", ".join(extension.get("extensions", ())) or f"kernel {kernel!r}, mode {mode!r}"
        raise ValueError(f"expected points, kernel {_WRITTEN['kernel']!r} and no further extension, got {got:.60}")
    for key in ("colorSpace", "projection"):
        if extension.get(key, _WRITTEN[key]) != _WRITTEN[key]:
            tell(f"{path.name}: the file says {key} {extension[key]!r:.80}: drawn as if it were {_WRITTEN[key]!r}")
    means = document.values(attributes["POSITION"], 3, None)
    quats, scales, opacities = (
        document.values(attributes[f"{EXTENSION}:{name}"], width, len(means))
        for name, width in (("ROTATION", 4), ("SCALE", 3), ("OPACITY", 1))
    )
    K = sum(name.startswith(f"{EXTENSION}:SH_DEGREE_") for name in attributes)
    if K not in (1, 4, 9, 16, 25):
        raise ValueError(f"{K} coefficients of harmonics are not whole degrees up to 4")
    sh = np.stack([document.values(attributes[_coefficient(k)], 3, len(means)) for k in range(K)], 1)
    outside = opacities[np.isfinite(opacities) & ((opacities < 0) | (opacities > 1))]
    if outside.size:
        raise ValueError(f"OPACITY has {outside[:4].tolist()}, not values in [0, 1]")
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats)[:, [3, 0, 1, 2]],
        scales=positive_scales(scales),
        opacities=torch.from_numpy(opacities[:, 0].copy()),
        sh=up_to_degree_3(path, torch.from_numpy(sh)),
    )
    if "_CLASS_ID" not in attributes:
        return gaussians
    labels = document.values(attributes["_CLASS_ID"], 1, len(means))[:, 0]
    if (labels < -1).any() or (labels > EXACT).any():
        raise ValueError(f"_CLASS_ID has {labels[:4].tolist()}, not whole numbers from -1 to {EXACT}")
    scores = document.values(attributes["_SCORE"], 1, len(means))[:, 0].copy() if "_SCORE" in attributes else None
    extras = primitive.get("extras")  # any JSON
    ours = extras.get("kfgs", {}) if isinstance(extras, dict) else {}
    names = tuple(map(str, ours.get("classes", [])))
    return gaussians.replace(labels=whole_labels(labels), scores=scores, names=names)


def _coefficient(k: int) -> str:
    """The attribute of coefficient k in the order of 3DGS: degree by degree, order m from -l to l."""
    degree = math.isqrt(k)
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree * degree}"


def _join(parts: list[Gaussians]) -> Gaussians:
    """One cloud of several primitives: harmonics are padded to the highest degree; the labels of a single one stay."""
    if len(parts) == 1:
        return parts[0]
    harmonics = [part.sh for part in parts if part.sh is not None]
    most = max(sh.shape[1] for sh in harmonics)
    padded = [torch.nn.functional.pad(sh, (0, 0, 0, most - sh.shape[1])) for sh in harmonics]
    clouds = [part.with_origin(parts[0].origin).replace(labels=None, scores=None, names=()) for part in parts]
    return Gaussians.cat([cloud.replace(sh=sh) for cloud, sh in zip(clouds, padded, strict=True)])
