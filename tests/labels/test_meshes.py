"""Labels on meshes: which Gaussian decides, areas and volumes against closed forms, and every kind of mesh."""

import numpy as np
import pytest
import torch
from messages import tells

from kfgs.formats import SplatFile
from kfgs.gaussians import Gaussians
from kfgs.labels import label_mesh

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
# Outwards: x = 0, x = 1, y = 0, y = 1, z = 0, z = 1
FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


def gaussians(means, labels):
    n = len(means)
    return Gaussians(
        means=torch.as_tensor(np.asarray(means), dtype=torch.float32),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 0.1),
        opacities=torch.full((n,), 0.5),
        labels=torch.as_tensor(labels),
    )


def boxes():
    """A box of 2 x 3 x 5 at the origin and a cube of edge 2 around (10, 0, 0), with split corners, and their splat."""
    first, second = CORNERS * (2, 3, 5), (CORNERS - 0.5) * 2 + (10, 0, 0)
    vertices = np.concatenate([first[FACES].reshape(-1, 3), second])
    faces = np.concatenate([np.arange(36).reshape(12, 3), FACES + 36])
    splats = SplatFile(gaussians([[1, 1.5, 2.5], [10, 0, 0]], [1, 0]), classes=("cube", "box"))
    return vertices, faces, splats


def test_a_vertex_and_a_face_take_the_label_of_the_nearest_gaussian():
    vertices = np.array([[0, 0, 0], [4, 0, 0], [0, 3, 0], [9, 9, 9]], dtype=np.float64)
    near = gaussians([[0.1, 0, 0], [4, 0.1, 0], [0, 3.1, 0], [4 / 3, 1, 0.1], [9, 9, 9.1]], [3, 0, 1, 2, -1])
    found = label_mesh((vertices, [[0, 1, 2], [1, 2, 3]]), near, 0.5)
    assert found.vertex_labels.tolist() == [3, 0, 1, -1]
    assert found.face_labels.tolist() == [2, -1]
    assert found.areas() == pytest.approx({"(none)": np.sqrt(27**2 + 36**2 + 51**2) / 2, "class 2": 6.0})


def test_vertices_and_faces_share_one_lambda():
    vertices, faces, splats = boxes()
    found = label_mesh((vertices, faces), splats)
    assert len(found.transfer.labels) == len(vertices) + len(faces)
    assert found.transfer.distance == label_mesh((vertices, faces), splats, found.transfer.distance).transfer.distance


def test_areas_and_volumes_of_boxes():
    vertices, faces, splats = boxes()
    found = label_mesh((vertices, faces), splats, 10.0)
    assert list(found.areas()) == ["box", "cube"]
    assert found.areas() == pytest.approx({"box": 2 * (6 + 10 + 15), "cube": 24.0})
    assert found.volumes() == pytest.approx({"box": 30.0, "cube": 8.0})
    inwards = label_mesh((vertices, faces[:, ::-1]), splats, 10.0)
    assert inwards.volumes() == pytest.approx(found.volumes())
    far = label_mesh((vertices + 1e6, faces), gaussians([[1e6 + 1, 1e6 + 1, 1e6 + 2]], [0]), 100.0)
    assert far.volumes() == pytest.approx({"class 0": 38.0}, rel=1e-6)


@pytest.mark.parametrize("fault", ["hole", "turned"])
def test_a_part_with_a_hole_or_a_turned_face_has_no_volume(fault):
    vertices, faces, splats = boxes()
    faces = np.delete(faces, 3, axis=0) if fault == "hole" else np.concatenate([faces[:1, ::-1], faces[1:]])
    assert label_mesh((vertices, faces), splats, 10.0).volumes() == pytest.approx({"cube": 8.0})


def test_the_class_of_a_part_is_the_one_with_the_largest_area_on_it():
    two = gaussians([[0.5, 0.5, 4], [0.5, 0.5, 2]], [0, 1])
    found = label_mesh((CORNERS * (1, 1, 4), FACES), two, 9.0, classes=("top", "rest"))
    assert found.areas() == pytest.approx({"rest": 17.0, "top": 1.0})
    assert found.volumes() == pytest.approx({"rest": 4.0})
    top = label_mesh((CORNERS * (1, 1, 4), FACES), two.select([0]), 1.0, classes=("top",))
    assert top.areas() == pytest.approx({"(none)": 17.0, "top": 1.0})
    assert top.volumes() == pytest.approx({"top": 4.0})
    none = label_mesh((CORNERS, FACES), two, 0.01)
    assert none.volumes() == pytest.approx({"(none)": 1.0})


def test_meshes_of_trimesh_pyvista_and_arrays_agree():
    trimesh = pytest.importorskip("trimesh")
    import pyvista as pv

    vertices, faces, splats = boxes()
    expected = label_mesh((torch.as_tensor(vertices), faces.tolist()), splats, 10.0)
    ours = trimesh.Trimesh(vertices, faces, process=False)
    theirs = pv.PolyData.from_regular_faces(vertices, faces)
    for mesh in (ours, theirs):
        found = label_mesh(mesh, splats, 10.0)
        assert np.array_equal(found.vertex_labels, expected.vertex_labels)
        assert np.array_equal(found.face_labels, expected.face_labels)
    parts = trimesh.Trimesh(vertices, faces).split()  # an independent oracle: trimesh's own areas and volumes
    assert sorted(expected.areas().values()) == pytest.approx(sorted(part.area for part in parts))
    assert sorted(expected.volumes().values()) == pytest.approx(sorted(part.volume for part in parts))
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=2.0)
    ball = label_mesh(sphere, gaussians([[0, 0, 0]], [0]), 5.0, classes=("ball",))
    assert ball.areas()["ball"] == pytest.approx(sphere.area)
    assert ball.volumes()["ball"] == pytest.approx(sphere.volume)


def test_a_legacy_mesh_of_open3d():
    open3d = pytest.importorskip("open3d")
    vertices, faces, splats = boxes()
    mesh = open3d.geometry.TriangleMesh(open3d.utility.Vector3dVector(vertices), open3d.utility.Vector3iVector(faces))
    assert label_mesh(mesh, splats, 10.0).volumes() == pytest.approx({"box": 30.0, "cube": 8.0})


def test_an_empty_mesh_has_no_areas():
    found = label_mesh((np.zeros((0, 3)), np.zeros((0, 3), np.int64)), boxes()[2])
    assert (found.areas(), found.volumes()) == ({}, {})


@pytest.mark.parametrize(
    ("mesh", "error", "words"),
    [
        ("a.ply", TypeError, ("mesh:", "got str", "trimesh.load_mesh")),
        ((CORNERS, FACES + 1), ValueError, ("mesh.faces:", "8 vertices", "from 1 to 8")),
        ((CORNERS, FACES / 2), ValueError, ("mesh.faces:", "float64")),
        ((CORNERS, FACES[:, :2]), ValueError, ("mesh.faces:", "[F, 3]")),
    ],
)
def test_what_is_no_mesh_is_named(mesh, error, words):
    with pytest.raises(error, match=tells(*words)):
        label_mesh(mesh, boxes()[2])


def test_faces_that_are_no_triangles_and_missing_labels_are_named():
    import pyvista as pv

    with pytest.raises(ValueError, match=tells("mesh:", "triangulate()")):
        label_mesh(pv.Cube(), boxes()[2])
    with pytest.raises(ValueError, match=tells("labelled:", "got none")):
        label_mesh((CORNERS, FACES), gaussians([[0, 0, 0]], [0]).replace(labels=None))
