import numpy as np
import pytest
import torch
from cases_gltf import random_cloud
from messages import refused, tells

from kfgs import Gaussians
from kfgs.formats import read_splats, write_splats
from kfgs.formats.ply import (
    points_from_columns,
    read_header,
    read_ply,
    read_ply_elements,
    write_ply,
    write_ply_elements,
)
from kfgs.formats.ply_3dgs import columns_from_gaussians


def _cloud(n: int = 7, degree: int = 3) -> Gaussians:
    features = torch.randn(n, 9, generator=torch.Generator().manual_seed(1))
    return random_cloud(n, degree, features=features, labels=torch.arange(n) - 1)


def test_sh_is_stored_channel_major():
    cloud = _cloud(2)
    columns = columns_from_gaussians(cloud)
    assert columns["f_rest_0"][1] == cloud.sh[1, 1, 0]  # first higher coefficient, red
    assert columns["f_rest_15"][1] == cloud.sh[1, 1, 1]  # first higher coefficient, green
    assert columns["f_rest_1"][1] != cloud.sh[1, 1, 1]  # coefficient-major would put green here


def test_ascii_of_windows_has_other_words_for_nan(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
    rows = "property uchar red\nend_header\n1 1.#QNAN 255 # 2\n-nan(ind) -1.#IND000 7\n"
    (tmp_path / "a.ply").write_text(head + rows)  # y is not 1
    columns = read_ply(tmp_path / "a.ply")
    assert columns["x"][0] == 1
    assert np.isnan([columns["x"][1], *columns["y"]]).all()
    assert (columns["red"].dtype, columns["red"].tolist()) == (np.uint8, [255, 7])


LITTLE = b"ply\nformat binary_little_endian 1.0\n"


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"hello", "end_header"),
        (LITTLE + b"element vertex 5\nproperty float x\nend_header\n" + b"\0" * 19, "truncated"),
        (LITTLE + b"element vertex 99999999999\nproperty float x\nend_header\n", "truncated"),
        (LITTLE + b"element vertex -5\nproperty float x\nend_header\n", "'-5'"),
        (b"ply\nformat ascii 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n1\n", "truncated"),
        (b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\nbanana\n", "banana"),
        (b"ply\nformat ascii 1.0\nend_header\n", "'vertex'"),
        (LITTLE + b"element face 5\nproperty float x\nend_header\n", "['face']"),
        (LITTLE + b"element vertex 1\nproperty list uchar int x\nend_header\n", "scalar"),
        (LITTLE + b"element vertex 1\nproperty quad x\nend_header\n", "scalar"),
        (LITTLE + b"element vertex 1\nproperty float x\nproperty float x\nend_header\n", "different names"),
        (LITTLE + b"element vertex 0\nend_header\n", "scalar"),
        (b"ply\nformat exotic 1.0\nelement vertex 0\nproperty float x\nend_header\n", "'exotic'"),
    ],
)
def test_bad_files_are_named(tmp_path, content, why):
    (tmp_path / "bad.ply").write_bytes(content)
    refused(lambda: read_ply(tmp_path / "bad.ply"), "bad.ply:", why, "write it again")


def test_missing_file_and_columns(tmp_path):
    refused(lambda: read_ply(tmp_path / "none.ply"), "none.ply:", "no such file", error=FileNotFoundError)
    refused(lambda: points_from_columns("b.ply", {"x": np.zeros(1)}), "b.ply: ", "y, z", "got x")
    write_ply(tmp_path / "points.ply", {name: np.zeros(1) for name in "xyz"})
    refused(lambda: read_splats(tmp_path / "points.ply"), "points.ply:", "opacity, scale_0", "point cloud")
    (tmp_path / "points.ply").unlink()
    refused(lambda: write_ply(tmp_path / "a.ply", {"x": np.zeros(1), "y": np.zeros(2)}), "columns:", "{'x': 1, 'y': 2}")
    refused(lambda: write_ply(tmp_path / "a.ply", {"x": np.zeros(1, np.int64)}), "got {'x': 'i8'}", "convert")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("without", "message"),
    [
        (("f_rest_44",), ("24 or 45", "got 44")),
        (("f_rest_7",), ("f_rest_7 missing",)),
        (("f_dc_1",), ("f_dc_1 missing",)),
        (("f_dc_2",), ("0 or 3", "got 2")),
        (("f_dc_0", "f_dc_1", "f_dc_2"), ("f_dc_0", "f_rest_*", "got none")),
        (("semantic_3",), ("semantic_3 missing",)),
    ],
)
def test_odd_columns_are_named(tmp_path, without, message):
    columns = columns_from_gaussians(_cloud())
    write_ply(tmp_path / "a.ply", {name: values for name, values in columns.items() if name not in without})
    refused(lambda: read_splats(tmp_path / "a.ply"), "a.ply:", *message)


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian"])
def test_a_mesh_is_read_and_its_faces_are_told(tmp_path, layout):
    head = f"ply\nformat {layout} 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 1\nproperty list uchar int vertex_indices\nelement edge 0\nproperty int vertex1\nend_header\n"
    points = np.arange(9, dtype="<f4").reshape(3, 3)
    face = b"\x03" + np.arange(3, dtype="<i4").tobytes()
    text = "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in points) + "3 0 1 2\n"
    (tmp_path / "a.ply").write_bytes(head.encode() + (text.encode() if layout == "ascii" else points.tobytes() + face))
    np.testing.assert_array_equal(points_from_columns("", read_ply(tmp_path / "a.ply")).numpy(), points)
    assert [element.name for element in read_header(tmp_path / "a.ply").elements if element.rows] == ["vertex", "face"]


TABLES = {
    "chunk": {"low": np.float32([-1, 2.5]), "high": np.float64([3, 1e-9])},
    "vertex": {"packed": np.uint32([0, 4294967295, 7]), "id": np.int16([-3, 2, 1])},
    "sh": {"f_rest_0": np.uint8([0, 128, 255])},
}


def _assert_same(back, tables):
    assert list(back) == list(tables)
    for element, columns in tables.items():
        assert list(back[element]) == list(columns)
        for name, values in columns.items():
            assert back[element][name].dtype == values.dtype
            np.testing.assert_array_equal(back[element][name], values)


def test_several_elements_survive_the_file(tmp_path):
    write_ply_elements(tmp_path / "a.ply", TABLES, comments=("first", "and second"))
    _assert_same(read_ply_elements(tmp_path / "a.ply"), TABLES)
    assert read_header(tmp_path / "a.ply").comments == ["first", "and second"]
    refused(lambda: read_ply(tmp_path / "a.ply"), "a.ply:", "'vertex'", "['chunk'")
    (tmp_path / "short.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-1])
    refused(lambda: read_ply_elements(tmp_path / "short.ply"), "short.ply:", "'sh'", "truncated")


@pytest.mark.parametrize("label", [0.5, 1e300])
def test_labels_that_are_no_whole_numbers_are_named(tmp_path, label):
    path = tmp_path / "a.ply"
    columns = columns_from_gaussians(_cloud())
    count = len(columns["x"])
    write_ply(path, columns | {"class_id": np.full(count, 2.0)})
    assert read_splats(path).labels.tolist() == [2] * count
    write_ply(path, columns | {"class_id": np.array([0.0] * (count - 1) + [label])})
    refused(lambda: read_splats(path), "a.ply:", "class_id:", "whole number", f"at Gaussian {count - 1}")


def test_scales_far_below_the_smallest_that_is_needed_come_back(tmp_path):
    scales = torch.tensor([[1e-12, 1e-20, 3e-30], [1.0, 1e-9, 1e-38]])
    cloud = _cloud()[:2].replace(scales=scales, labels=None)
    write_splats(cloud, tmp_path / "a.ply")
    assert torch.allclose(read_splats(tmp_path / "a.ply").scales, scales, rtol=1e-4, atol=0)


STANDARD = [
    "x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45)), "opacity",
    *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4)),
]  # fmt: skip


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_plain_file_has_the_62_properties_of_inrias_files_and_its_classes_are_found_again(tmp_path, degree):
    cloud, path = _cloud(degree=degree), tmp_path / "a.ply"
    classes, extra = ("a", "b", "c", "d", "e", "f"), {"id": np.arange(7)}
    scores = np.linspace(0, 1, 7)
    written = write_splats(cloud.replace(scores=scores, extra=extra, names=classes), path, plain=True)
    columns = read_ply(path)
    assert list(columns) == STANDARD
    assert {values.dtype.str for values in columns.values()} == {"<f4"}
    assert [one.name for one in written.paths] == ["a.ply", "a.ply.labels.npz", "a.ply.classes.json"]
    assert [word.split(":")[0] for word in written.lost] == ["9 features per Gaussian", "the columns id"]
    back = read_splats(path)
    assert back.names == classes
    assert torch.equal(back.labels, cloud.labels)
    np.testing.assert_allclose(back.scores, scores, rtol=1e-6)
    K = cloud.sh.shape[1]
    assert torch.equal(back.sh[:, :K], cloud.sh)
    assert not back.sh[:, K:].any()


def test_a_full_file_at_the_place_of_a_plain_one_leaves_nothing_beside_it(tmp_path):
    path = tmp_path / "a.ply"
    write_splats(_cloud(), path, plain=True)
    write_splats(_cloud(), path)
    assert [one.name for one in tmp_path.iterdir()] == ["a.ply"]
    assert torch.equal(read_splats(path).labels, _cloud().labels)


def test_plain_is_for_ply_files_with_colours(tmp_path):
    refused(lambda: write_splats(_cloud(), tmp_path / "a.spz", plain=True), "plain:", "ends in .ply", "a.spz")
    with pytest.raises(ValueError, match=tells("gaussians:", "colours", "a plain PLY")):
        write_splats(_cloud().replace(sh=None), tmp_path / "a.ply", plain=True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("high", "kind"), [(2**24, "float"), (2**24 + 1, "int"), (2**31 - 1, "int")])
def test_labels_are_float_where_float_holds_them_and_files_with_int_are_read(tmp_path, high, kind):
    """An importer that knows the size of `float` alone finds every property of a labelled splat."""
    cloud = _cloud()
    labels = torch.arange(len(cloud)) - 1
    labels[-1] = high
    score = np.linspace(0, 1, len(cloud), dtype=np.float32)
    write_splats(cloud.replace(labels=labels).replace(scores=score), tmp_path / "a.ply")
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0].decode()
    kinds = dict(reversed(line.split()[1:]) for line in header.splitlines() if line.startswith("property"))
    assert kinds.pop("class_id") == kind
    assert kinds.pop("score") == "float"
    assert set(kinds.values()) == {"float"}
    assert torch.equal(read_splats(tmp_path / "a.ply").labels, labels)
    write_ply(tmp_path / "old.ply", columns_from_gaussians(cloud) | {"class_id": labels.numpy().astype(np.int32)})
    assert torch.equal(read_splats(tmp_path / "old.ply").labels, labels)
