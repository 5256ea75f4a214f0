"""glTF documents bent by hand: buffers elsewhere, promises that the bytes do not keep, values that mean nothing."""

import base64
import json
import struct
import tracemalloc
import unicodedata

import numpy as np
import pytest
import torch
from cases_gltf import KHR, bent_gltf, json_of_glb, random_cloud
from messages import refused

from kfgs.formats import read_splats, write_splats


def test_a_buffer_beside_the_document_is_read(tmp_path):
    cloud = random_cloud(5, 1)
    path = bent_gltf(tmp_path, cloud)
    root = json.loads(path.read_text())
    blob = base64.b64decode(root["buffers"][0]["uri"].partition(",")[2])
    (tmp_path / "my data.bin").write_bytes(blob)
    root["buffers"][0]["uri"] = "my%20data.bin"
    path.write_text(json.dumps(root))
    assert torch.equal(read_splats(path).means, cloud.means)
    (tmp_path / "my data.bin").write_bytes(blob[:-9])
    refused(lambda: read_splats(path), "bent.gltf:", "buffers[0]", "bytes")
    (tmp_path / "my data.bin").unlink()
    refused(lambda: read_splats(path), "bent.gltf:", "my%20data.bin")


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_a_buffer_is_found_under_other_slashes_and_in_another_unicode_form(tmp_path, form):
    cloud = random_cloud(5, 1)
    path = bent_gltf(tmp_path, cloud)
    root = json.loads(path.read_text())
    blob = base64.b64decode(root["buffers"][0]["uri"].partition(",")[2])
    file = tmp_path / unicodedata.normalize(form, "K\u00fcche/data.bin")
    file.parent.mkdir()
    file.write_bytes(blob)
    for uri in ("K\u00fcche/data.bin", "Ku\u0308che/data.bin", "K%C3%BCche/data.bin", "K\u00fcche\\data.bin"):
        root["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(root))
        assert torch.equal(read_splats(path).means, cloud.means), uri


@pytest.mark.parametrize(
    "uri",
    ["../secret.bin", "/etc/passwd", "http://host/a.bin", "file:///etc/passwd", "a/../../b", "%2e%2e/secret.bin",
     "C:/windows/a.bin", "..\\secret.bin", "\\\\host\\share", "a%00b"],
)  # fmt: skip
def test_uris_that_lead_elsewhere_are_refused(tmp_path, uri):
    (tmp_path / "secret.bin").write_bytes(b"\0" * 4096)
    (tmp_path / "scene").mkdir()
    path = bent_gltf(tmp_path / "scene", **{"buffers/0/uri": uri})
    refused(lambda: read_splats(path), "bent.gltf:", "uri")


def test_links_that_lead_elsewhere_are_refused(tmp_path):
    (tmp_path / "secret.bin").write_bytes(b"\0" * 4096)
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "a.bin").symlink_to(tmp_path / "secret.bin")
    path = bent_gltf(tmp_path / "scene", **{"buffers/0/uri": "a.bin"})
    refused(lambda: read_splats(path), "bent.gltf:", "a.bin")


A = "meshes/0/primitives/0/attributes"


@pytest.mark.parametrize(
    "changes",
    [
        {"asset/version": "1.0"},
        {"extensionsRequired": [KHR, "KHR_gaussian_splatting_compression_spz_2"]},
        {"meshes/0/primitives/0/extensions": {}},
        {"meshes/0/primitives/0/extensions/KHR_gaussian_splatting/kernel": "box"},
        {"meshes/0/primitives/0/mode": 4},
        {"meshes": None},
        {f"{A}/POSITION": 99},
        {f"{A}/{KHR}:SCALE": None},
        {f"{A}/{KHR}:SH_DEGREE_1_COEF_1": None},
        {"accessors/0/count": 10**12},
        {"accessors/1/count": 4},
        {"accessors/0/count": -1},
        {"accessors/0/componentType": 5124},
        {"accessors/0/type": "MAT4"},
        {"accessors/0/sparse": {}},
        {"accessors/0/byteOffset": -12},
        {"accessors/0/byteOffset": 4},
        {"bufferViews/0/byteOffset": -4},
        {"bufferViews/0/byteStride": 8},
        {"bufferViews/0/byteStride": 300},
        {"buffers/0/byteLength": 10**15},
        {"buffers/0/uri": None},
        {"buffers/0/uri": "data:text/plain,hello"},
        {"nodes/0/children": [0]},
        {"nodes/0/scale": [-1, 1, 1]},
        {"nodes/0/matrix": [1, 0, 0, 0, 0.5, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
        {"nodes/0/rotation": [0, 0, 0, 0]},
    ],
)
def test_bent_documents_are_named(tmp_path, changes):
    path = bent_gltf(tmp_path, **changes)
    refused(lambda: read_splats(path), "bent.gltf: expected")


def test_one_buffer_shown_a_thousand_times_is_refused(tmp_path):
    path = bent_gltf(tmp_path, random_cloud(400, 0))
    root = json.loads(path.read_text())
    root["meshes"][0]["primitives"] *= 1000
    path.write_text(json.dumps(root))
    refused(lambda: read_splats(path), "bent.gltf:", "56800 Gaussians", "buffer")


def test_json_of_millions_of_values_is_not_parsed(tmp_path):
    text = b'{"asset": {"version": "2.0"}, "accessors": [' + b"[]," * (1 << 20) + b"0]}"
    (tmp_path / "a.gltf").write_bytes(text)
    tracemalloc.start()
    refused(lambda: read_splats(tmp_path / "a.gltf"), "a.gltf:", "1048576", "20971")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * len(text)


@pytest.mark.parametrize(
    ("attribute", "values"),
    [
        ("POSITION", np.full(15, np.nan)),
        (f"{KHR}:OPACITY", np.full(5, 1.5)),
        (f"{KHR}:SH_DEGREE_1_COEF_0", np.full(15, np.inf)),
        ("_CLASS_ID", np.full(5, 0.5)),
        ("_CLASS_ID", np.full(5, -2)),
    ],
)
def test_bad_values_are_named(tmp_path, attribute, values):
    path = tmp_path / "bad.glb"
    write_splats(random_cloud(5, 1).replace(labels=torch.arange(5)), path)
    root = json_of_glb(path)
    view = root["bufferViews"][root["meshes"][0]["primitives"][0]["attributes"][attribute]]
    data = bytearray(path.read_bytes())
    start = 20 + struct.unpack_from("<I", data, 12)[0] + 8 + view["byteOffset"]
    data[start : start + view["byteLength"]] = values.astype("<f4").tobytes()
    path.write_bytes(data)
    refused(lambda: read_splats(path), "bad.glb: expected")


@pytest.mark.parametrize(
    "content",
    [
        b"glTF",
        struct.pack("<4sII", b"glTF", 1, 12),
        struct.pack("<4sII", b"glTF", 2, 1 << 31),
        struct.pack("<4sII", b"glTF", 2, 12),
        struct.pack("<4sIIII", b"glTF", 2, 20, 1 << 30, 0x4E4F534A),
        b'{"accessors": [',
        b'{"accessors": ' + b"[" * 100_000,
        b"hello",
    ],
)
def test_bad_containers_are_named(tmp_path, content):
    (tmp_path / "bad.glb").write_bytes(content)
    refused(lambda: read_splats(tmp_path / "bad.glb"), "bad.glb: expected")
