from pathlib import Path

import pytest
from meshes import QUADS, XYZ, write_mesh
from messages import tells

from kfgs.formats.ply import read_mesh, write_ply


@pytest.mark.parametrize("id_first", [False, True])
def test_a_mesh_with_faces_of_several_sizes(tmp_path: Path, id_first: bool) -> None:
    write_mesh(tmp_path / "mesh.ply", QUADS, id_first=id_first)
    mesh = read_mesh(tmp_path / "mesh.ply")
    assert mesh.corners.tolist() == [i for corners, _ in QUADS for i in corners]
    assert mesh.counts.tolist() == [4, 4, 3, 4]
    assert mesh.faces["object_id"].tolist() == [4, 9, 9, 4]
    assert mesh.vertices["y"].tolist() == XYZ[:, 1].tolist()


def test_meshes_that_are_damaged(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    write_mesh(path, QUADS)
    whole = path.read_bytes()
    for cut in (1, 10, 30):
        path.write_bytes(whole[:-cut])
        with pytest.raises(ValueError, match=tells("mesh.ply", "4 faces", "truncated")):
            read_mesh(path)
    write_mesh(path, [([0, 1, 77], 4)])
    with pytest.raises(ValueError, match=tells("6 vertices", "77")):
        read_mesh(path)
    path.write_bytes(whole.replace(b"vertex_indices", b"other_indices_"))
    with pytest.raises(ValueError, match=tells("one list", "other_indices_")):
        read_mesh(path)
    path.write_bytes(whole.replace(b"binary_little_endian", b"ascii"))
    with pytest.raises(ValueError, match="mesh.ply"):
        read_mesh(path)
    write_ply(path, {name: XYZ[:, i] for i, name in enumerate("xyz")})
    with pytest.raises(ValueError, match=tells("'face' element", "vertex")):
        read_mesh(path)
    write_mesh(path, [])
    assert len(read_mesh(path).counts) == 0
