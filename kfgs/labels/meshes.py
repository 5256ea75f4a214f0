"""Carry labels from Gaussians to a mesh of the same scene, and measure it: area and volume of each class."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .._check import as_array, check_shapes
from .._typed import typed
from ..formats.splat_file import SplatFile
from ..gaussians import Gaussians
from .nearest import Array
from .transfer import Method, Transfer, transfer_labels

NONE = "(none)"  # the key of what has no class


@dataclass(frozen=True, eq=False)
class LabelledMesh:
    """A mesh of V vertices and F triangles with labels. It holds arrays only; attach them to your mesh as you like."""

    vertices: Array  # [V, 3] float64
    faces: Array  # [F, 3] int64
    vertex_labels: Array  # [V] int64, -1 = none
    face_labels: Array  # [F] int64, -1 = none
    classes: tuple[str, ...]
    transfer: Transfer
    """How the labels were found: of the V vertices, then of the F centres of the faces."""

    def __repr__(self) -> str:
        labelled = int((self.face_labels >= 0).sum())
        return f"LabelledMesh({len(self.vertices):,} vertices, {labelled:,} of {len(self.faces):,} faces labelled)"

    @property
    def face_areas(self) -> Array:  # [F]
        """The area of each face, in square world units."""
        a, b, c = self.vertices[self.faces].transpose(1, 0, 2)
        areas: Array = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        return areas

    def areas(self) -> dict[str, float]:
        """The area of each class in square world units, the largest first; "(none)" for faces without a class."""
        return self._by_class(self.face_labels, self.face_areas)

    def volumes(self) -> dict[str, float]:
        """The volume of each class in cubic world units, the largest first. Only closed parts of the mesh have one.

        A part is a set of faces that are connected by edges; corners at one position count as one. It is closed if each
        edge is passed as often in one direction as in the other: no holes, and all faces look outwards or all inwards.
        Its class is the one with the largest area on it, even if most of it has none. A closed hollow inside another part
        adds to the sum.
        """
        part, closed = self._parts()
        signed = np.zeros(len(closed))
        middle = self.vertices.mean(axis=0) if len(self.vertices) else 0.0  # near the mesh, less is lost in rounding
        corners = (self.vertices - middle)[self.faces]
        np.add.at(signed, part, np.linalg.det(corners) / 6)
        share = np.zeros((len(closed), int(self.face_labels.max(initial=-1)) + 2))
        np.add.at(share, (part, self.face_labels + 1), self.face_areas)
        share[:, 0] = 0  # no class
        return self._by_class(share.argmax(axis=1)[closed] - 1, np.abs(signed)[closed])

    def _parts(self) -> tuple[Array, Array]:  # [F] int64, [P] bool
        """The part of each face, and which parts are closed."""
        F = len(self.faces)
        corner = np.unique(self.vertices, axis=0, return_inverse=True)[1].reshape(-1)[self.faces]
        ends = corner[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)  # [3 F, 2], in the direction of their face
        edges, edge = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
        edge, owner = edge.reshape(-1), np.repeat(np.arange(F), 3)
        links = coo_array((np.ones(3 * F), (owner, F + edge)), shape=(F + len(edges), F + len(edges)))
        count, number = connected_components(links, directed=False)
        passed = np.bincount(edge, np.sign(ends[:, 1] - ends[:, 0]), len(edges))  # 0: as often in both directions
        closed = np.ones(count, dtype=bool)
        closed[number[F:][passed != 0]] = False
        return number[:F], closed

    def _by_class(self, labels: Array, values: Array) -> dict[str, float]:
        sums = {self._name(label): float(values[labels == label].sum()) for label in np.unique(labels).tolist()}
        return dict(sorted(sums.items(), key=lambda item: -item[1]))

    def _name(self, label: int) -> str:
        return NONE if label < 0 else self.classes[label] if label < len(self.classes) else f"class {label}"


@typed
def label_mesh(
    mesh: Any,
    labelled: SplatFile | Gaussians,
    distance: float | None = None,
    *,
    method: Method = "nearest",
    classes: Sequence[str] = (),
) -> LabelledMesh:
    """Label the vertices and faces of a mesh by the nearest Gaussians; a face takes the label of its centre.

    Mesh and Gaussians must share one frame. Faces should not be larger than the things to tell apart: subdivide others
    first, for example with `mesh.subdivide_to_size(0.05)` of trimesh.

    Args:
        mesh: a trimesh.Trimesh, a pyvista.PolyData of triangles, a legacy mesh of Open3D, or (vertices [V, 3], faces [F, 3]).
        labelled: a splat or Gaussians with labels.
        distance: lambda, the distance within which a label is carried over, in world units; None: `default_distance`.
        method: which label wins, see `transfer_labels`.
        classes: the names of the classes; by default those of a labelled splat.

    Returns:
        Labels of vertices and faces, areas and volumes.

    Raises:
        TypeError: if `mesh` is no mesh.
        ValueError: if it has faces that are not triangles, or that name a missing vertex; if `labelled` has no labels; or as
            `transfer_labels`.
    """
    splats = SplatFile(labelled) if isinstance(labelled, Gaussians) else labelled
    if splats.gaussians.labels is None:
        raise ValueError("labelled: expected Gaussians with labels, got none; `SemanticField.label` gives them some")
    vertices, faces = _triangles(mesh)
    places = np.concatenate([vertices, vertices[faces].mean(axis=1)]) - splats.gaussians.origin
    found = transfer_labels(splats.gaussians, splats.gaussians.labels, places, distance, method=method)
    labels = as_array(found.labels)
    names = tuple(classes) or splats.classes
    return LabelledMesh(vertices, faces, labels[: len(vertices)], labels[len(vertices) :], names, found)


def _triangles(mesh: Any) -> tuple[Array, Array]:  # [V, 3] float64, [F, 3] int64
    if hasattr(mesh, "is_all_triangles"):  # pyvista
        if not mesh.is_all_triangles:
            raise ValueError("mesh: expected triangles, got other faces; pass mesh.triangulate()")
        mesh = mesh.points, mesh.regular_faces
    elif hasattr(mesh, "vertices"):  # trimesh, Open3D
        mesh = mesh.vertices, mesh.faces if hasattr(mesh, "faces") else getattr(mesh, "triangles", None)
    if not isinstance(mesh, tuple | list) or len(mesh) != 2 or mesh[1] is None:
        raise TypeError(
            f"mesh: expected a mesh of trimesh, pyvista or Open3D, or (vertices, faces), got {type(mesh).__name__}; a path is "
            "read by trimesh.load_mesh or pyvista.read"
        )
    vertices, faces = (as_array(part) for part in mesh)
    check_shapes(("mesh.vertices", vertices, "V 3"), ("mesh.faces", faces, "F 3"))
    if faces.size and not (faces.dtype.kind in "iu" and 0 <= int(faces.min()) <= int(faces.max()) < len(vertices)):
        raise ValueError(
            f"mesh.faces: expected indices of {len(vertices)} vertices, got {faces.dtype} from {faces.min()} to {faces.max()}"
        )
    return vertices.astype(np.float64), faces.astype(np.int64)
