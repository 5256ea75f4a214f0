"""glTF documents bent by hand: buffers elsewhere, promises that the bytes do not keep, values that mean nothing."""

import base64
import json
import struct
import tracemalloc

import numpy as np
import pytest
import torch
from cases_gltf import KHR, bent_gltf, json_of_glb, random_cloud

from kfgs.formats import read_splats, write_splats


def test_a_buffer_beside_the_document_is_read(tmp_path):
    cloud = random_cloud(5, 1)
    path = bent_gltf(tmp_path, cloud)
    root = json.loads(path.read_text())
    blob = base64.b64decode(root["buffers"][0]["uri"].partition(",")[2])
    (tmp_path / "my data.bin").write_bytes(blob)
    root["buffers"][0]["uri"] = "my%20data.bin"
    path.write_text(json.dumps(root))
    assert torch.equal(read_splats(path).gaussians.means, cloud.means)
    (tmp_path / "my data.bin").write_bytes(blob[:-9])
    with pytest.raises(ValueError, match=r"bent.gltf: buffers\[0\]: expected \d+ bytes, got .* the file is damaged"):
        read_splats(path)
    (tmp_path / "my data.bin").unlink()
    with pytest.raises(ValueError, match="expected the file 'my data.bin' beside it, got none; copy it there"):
        read_splats(path)


@pytest.mark.parametrize(
    "uri",
    ["../secret.bin", "/etc/passwd", "http://host/a.bin", "file:///etc/passwd", "a/../../b", "%2e%2e/secret.bin",
     "C:/windows/a.bin", "..\\secret.bin", "\\\\host\\share", "a%00b"],
)  # fmt: skip
def test_uris_that_lead_elsewhere_are_refused(tmp_path, uri):
    (tmp_path / "secret.bin").write_bytes(b"\0" * 4096)
    (tmp_path / "scene").mkdir()
    path = bent_gltf(tmp_path / "scene", **{"buffers/0/uri": uri})
    with pytest.raises(ValueError, match=r"bent.gltf: buffers\[0\]: expected a file beside it, got the uri"):
        read_splats(path)


def test_links_that_lead_elsewhere_are_refused(tmp_path):
    (tmp_path / "secret.bin").write_bytes(b"\0" * 4096)
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "a.bin").symlink_to(tmp_path / "secret.bin")
    path = bent_gltf(tmp_path / "scene", **{"buffers/0/uri": "a.bin"})
    with pytest.raises(ValueError, match="expected a file beside it, got a link to .*; copy it there"):
        read_splats(path)


A = "meshes/0/primitives/0/attributes"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"asset": None}, r"expected glTF 2.0 \(asset.version\), got None"),
        ({"asset/version": "1.0"}, r"expected glTF 2.0 \(asset.version\), got '1.0'"),
        ({"extensionsRequired": [KHR, "KHR_gaussian_splatting_compression_spz_2"]}, "without compression"),
        ({"meshes/0/primitives/0/extensions": {}}, "got 1 primitives without; it holds no splats"),
        ({"meshes/0/primitives/0/extensions/KHR_gaussian_splatting/kernel": "box"}, "kernel 'ellipse'.*got 'box'"),
        ({"meshes/0/primitives/0/mode": 4}, r"mode: expected 0 \(points\), got 4"),
        ({"meshes/0/primitives": 3}, "primitives: expected a list, got 3"),
        ({"meshes": None}, "meshes: expected an index below 0, got 0"),
        ({f"{A}/POSITION": 99}, r"accessors: expected an index below \d+, got 99"),
        ({f"{A}/{KHR}:SCALE": None}, "expected POSITION, ROTATION, SCALE, OPACITY and SH_DEGREE_0"),
        ({f"{A}/{KHR}:SH_DEGREE_1_COEF_1": None}, "expected whole degrees of harmonics"),
        ({"accessors/0/count": 10**12}, "accessors.*the file is damaged"),
        ({"accessors/0/count": 6}, "the file is damaged"),
        ({"accessors/1/count": 4}, "expected 5, as many as POSITION has, got 4"),
        ({"accessors/0/count": -1}, "count: expected a whole number of 0 or more, got -1"),
        ({"accessors/0/count": True}, "count: expected a whole number of 0 or more, got True"),
        ({"accessors/0/componentType": 5124}, "componentType: expected one of 5120"),
        ({"accessors/0/type": "MAT4"}, "type: expected a type of 3 numbers, got 'MAT4'"),
        ({"accessors/0/type": ["VEC3"]}, "type: expected a type of 3 numbers"),
        ({"accessors/0/sparse": {}}, "and not sparse"),
        ({"accessors/0/byteOffset": 8}, "expected 5 elements in 60 bytes, got '68 bytes"),
        ({"bufferViews/0/byteOffset": 10**9}, r"bufferViews\[0\]: expected bytes below"),
        ({"bufferViews/0/byteStride": 8}, "elements in 60 bytes, got '44 bytes, 8 apart'"),
        ({"bufferViews/0/byteStride": 300}, "byteStride: expected 4 to 252 bytes, got 300"),
        ({"buffers/0/byteLength": 10**15}, r"buffers\[0\]: expected 10+ bytes"),
        ({"buffers/0/uri": None}, "expected a uri, or the binary chunk"),
        ({"buffers/0/uri": "data:text/plain,hello"}, "expected data:...;base64"),
        ({"buffers/0/uri": "data:;base64,*"}, "uri: expected base64"),
        ({"buffers/0/uri": 7}, "uri: expected a text, got 7"),
        ({"nodes/0/children": [0]}, "expected a tree of nodes"),
        ({"nodes/0/scale": [1, 2, 1]}, "one scale for all axes and a translation"),
        ({"nodes/0/scale": [0, 0, 0]}, "one scale for all axes and a translation"),
        ({"nodes/0/scale": [-1, 1, 1]}, "one scale for all axes and a translation"),
        ({"nodes/0/matrix": [1, 0, 0, 0, 0.5, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, "one scale for all axes .* apply the node"),
        ({"nodes/0/rotation": [0, 0, 0, 0]}, "expected a unit quaternion x, y, z, w"),
        ({"nodes/0/matrix": [1] * 15}, "matrix: expected 16 finite numbers"),
        ({"nodes/0/translation": ["a", 0, 0]}, "translation: expected 3 finite numbers"),
    ],
)  # fmt: skip
def test_bent_documents_are_named(tmp_path, changes, message):
    path = bent_gltf(tmp_path, **changes)
    with pytest.raises(ValueError, match=f"bent.gltf: .*{message}"):
        read_splats(path)


def test_one_buffer_shown_a_thousand_times_is_refused(tmp_path):
    path = bent_gltf(tmp_path, random_cloud(400, 0))
    root = json.loads(path.read_text())
    root["meshes"][0]["primitives"] *= 1000
    path.write_text(json.dumps(root))
    with pytest.raises(ValueError, match="one buffer is shown too many times"):
        read_splats(path)


def test_json_of_millions_of_values_is_not_parsed(tmp_path):
    text = b'{"asset": {"version": "2.0"}, "accessors": [' + b"[]," * (1 << 20) + b"0]}"
    (tmp_path / "a.gltf").write_bytes(text)
    tracemalloc.start()
    with pytest.raises(
        ValueError, match="a.gltf: expected at most 1048576 values in its JSON, got 20971.*split the scene"
    ):
        read_splats(tmp_path / "a.gltf")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * len(text)


@pytest.mark.parametrize(
    ("attribute", "values", "message"),
    [
        ("POSITION", np.full(15, np.nan), "expected finite positions, got .* at Gaussian 0"),
        (f"{KHR}:OPACITY", np.full(5, 1.5), r"OPACITY: expected values in \[0, 1\]"),
        (f"{KHR}:SH_DEGREE_1_COEF_0", np.full(15, np.inf), "expected finite colours"),
        ("_CLASS_ID", np.full(5, 0.5), "_CLASS_ID: expected whole numbers of -1 or more"),
    ],
)
def test_bad_values_are_named(tmp_path, attribute, values, message):
    path = tmp_path / "bad.glb"
    write_splats(path, random_cloud(5, 1).replace(labels=torch.arange(5)))
    root = json_of_glb(path)
    view = root["bufferViews"][root["meshes"][0]["primitives"][0]["attributes"][attribute]]
    data = bytearray(path.read_bytes())
    start = 20 + struct.unpack_from("<I", data, 12)[0] + 8 + view["byteOffset"]
    data[start : start + view["byteLength"]] = values.astype("<f4").tobytes()
    path.write_bytes(data)
    with pytest.raises(ValueError, match=f"bad.glb: .*{message}"):
        read_splats(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"glTF", "expected a .glb of version 2, got 0"),
        (struct.pack("<4sII", b"glTF", 1, 12), "expected a .glb of version 2, got 1"),
        (struct.pack("<4sII", b"glTF", 2, 1 << 31), "expected 2147483648 bytes, got 12; the file is truncated"),
        (struct.pack("<4sII", b"glTF", 2, 12), "expected a JSON chunk of at most .* got none"),
        (struct.pack("<4sIIII", b"glTF", 2, 20, 1 << 30, 0x4E4F534A), "expected a chunk of .* the file is truncated"),
        (b'{"accessors": [', "expected glTF, but its JSON cannot be parsed"),
        (b'{"accessors": ' + b"[" * 100_000, "expected glTF, but its JSON cannot be parsed"),
        (b"hello", "expected glTF, but its JSON cannot be parsed"),
    ],
)
def test_bad_containers_are_named(tmp_path, content, message):
    (tmp_path / "bad.glb").write_bytes(content)
    with pytest.raises(ValueError, match=f"bad.glb: {message}"):
        read_splats(tmp_path / "bad.glb")
