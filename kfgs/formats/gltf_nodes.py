"""Apply the transforms of a glTF scene's nodes to their meshes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..cameras.similarity import Similarity
from ..gaussians import Gaussians
from ..splat.transform import transform_gaussians
from .gltf_container import Document

_DEEPEST = 256  # nodes below nodes


def placed_meshes(document: Document) -> Iterator[tuple[str, int, Tensor]]:  # name of the node, mesh, [4, 4] float64
    """Every mesh of the default scene, with the matrix from the mesh's axes to the scene's.

    A document without scenes shows all nodes without a parent; one without nodes shows all meshes unmoved.

    Raises:
        ValueError: if nodes form a loop, or a transform is no list of finite numbers.
    """
    nodes = document.all("nodes")
    if not nodes:
        for mesh in range(len(document.all("meshes"))):
            yield "", mesh, torch.eye(4, dtype=torch.float64)
        return
    if document.all("scenes"):
        scene = document.item("scenes", document.root.get("scene", 0))
        roots = document.list_of(scene, "nodes", "scenes.nodes")
    else:
        below = {child for i in range(len(nodes)) for child in _children(document, i) if isinstance(child, int)}
        roots = [i for i in range(len(nodes)) if i not in below]
    waiting = [(root, torch.eye(4, dtype=torch.float64), 0) for root in reversed(roots)]
    seen: set[int] = set()
    while waiting:
        index, above, depth = waiting.pop()
        node = document.item("nodes", index)
        if index in seen or depth > _DEEPEST:  # in glTF a node has one parent
            raise document.wrong(f"nodes[{index}]", "a tree of nodes", "a node that is met twice")
        seen.add(index)
        matrix = above @ _local(document, node, f"nodes[{index}]")
        if "mesh" in node:
            yield f"nodes[{index}]", document.whole(node, "mesh", f"nodes[{index}]"), matrix
        waiting += [(child, matrix, depth + 1) for child in reversed(_children(document, index))]


def place(document: Document, where: str, gaussians: Gaussians, matrix: Tensor) -> Gaussians:  # matrix: [4, 4]
    """Apply a node's matrix to the Gaussians of its mesh, and turn their colours with it.

    Raises:
        ValueError: if the node mirrors, shears or scales the axes differently.
    """
    if torch.equal(matrix, torch.eye(4, dtype=torch.float64)):
        return gaussians
    try:
        similarity = Similarity.from_matrix(matrix)
    except ValueError as error:
        raise ValueError(
            f"{document.path}: {where}: expected a rotation, one scale for all axes and a translation ({error}); apply "
            "the node's transform in the program that wrote it"
        ) from error
    return transform_gaussians(gaussians, similarity)


def _children(document: Document, index: int) -> list[Any]:
    return document.list_of(document.item("nodes", index), "children", f"nodes[{index}].children")


def _local(document: Document, node: dict[str, Any], where: str) -> Tensor:  # [4, 4] float64
    if "matrix" in node:
        return torch.tensor(_numbers(document, node, "matrix", where, [0.0] * 16), dtype=torch.float64).view(4, 4).T
    x, y, z, w = _numbers(document, node, "rotation", where, [0.0, 0.0, 0.0, 1.0])
    if not 0.99 < math.hypot(x, y, z, w) < 1.01:
        raise document.wrong(f"{where}.rotation", "a unit quaternion x, y, z, w", [x, y, z, w])
    local = torch.eye(4, dtype=torch.float64)
    turn = torch.from_numpy(Rotation.from_quat([x, y, z, w]).as_matrix())
    scale = torch.tensor(_numbers(document, node, "scale", where, [1.0] * 3), dtype=torch.float64)
    local[:3, :3] = turn * scale
    local[:3, 3] = torch.tensor(_numbers(document, node, "translation", where, [0.0] * 3), dtype=torch.float64)
    return local


def _numbers(document: Document, node: dict[str, Any], key: str, where: str, default: list[float]) -> list[float]:
    values = node.get(key, default)
    if (
        not isinstance(values, list)
        or len(values) != len(default)
        or not all(isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) < 1e30 for v in values)
    ):  # NaN fails the comparison too
        raise document.wrong(f"{where}.{key}", f"{len(default)} finite numbers", values)
    return [float(v) for v in values]
