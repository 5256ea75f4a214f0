"""glTF against closed forms, against pygltflib as a reader and writer of its own, and against documents bent by hand."""

import base64
import json
import struct
import tracemalloc

import numpy as np
import pygltflib
import pytest
import torch
from scipy.spatial.transform import Rotation

from kfgs.cameras import Camera, Similarity
from kfgs.formats import SplatFile, read_splats, write_splats
from kfgs.formats import gltf as format_gltf
from kfgs.gaussians import Gaussians
from kfgs.splat import evaluate_sh, rasterize

KHR = "KHR_gaussian_splatting"


def _cloud(n: int = 7, degree: int = 3, seed: int = 3) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=g),
        quats=torch.nn.functional.normalize(torch.randn(n, 4, generator=g), dim=1),
        scales=torch.rand(n, 3, generator=g) + 0.1,
        opacities=torch.rand(n, generator=g) * 0.9 + 0.05,
        sh=torch.randn(n, (degree + 1) ** 2, 3, generator=g),
    )


def _json(path) -> dict:
    """The JSON of a .glb, read by hand."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size])


def _values(document: pygltflib.GLTF2, attribute: str) -> np.ndarray:
    """An attribute as pygltflib finds it."""
    index = dict(vars(document.meshes[0].primitives[0].attributes))[attribute]
    accessor = document.accessors[index]
    view = document.bufferViews[accessor.bufferView]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
    code = {5126: "<f4", 5121: "u1"}[accessor.componentType]
    blob = document.binary_blob()
    assert blob is not None
    return np.frombuffer(blob, code, accessor.count * width, view.byteOffset).reshape(accessor.count, width)


def _gltf(tmp_path, cloud=None, **changes):
    """A .gltf of ours with parts of its JSON exchanged: `changes` maps a dotted path to a value (None deletes)."""
    path = tmp_path / "bent.gltf"
    write_splats(path, _cloud(5, 1) if cloud is None else cloud)
    root = json.loads(path.read_text())
    for dotted, value in changes.items():
        *above, last = [int(word) if word.isdigit() else word for word in dotted.split("/")]
        holder = root
        for word in above:
            holder = holder[word]
        if value is None:
            del holder[last]
        else:
            holder[last] = value
    path.write_text(json.dumps(root))
    return path


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_survive_exactly(tmp_path, name, degree):
    cloud = _cloud(degree=degree)
    assert write_splats(tmp_path / name, cloud).lost == ()
    back = read_splats(tmp_path / name)
    assert back.info["format"] == "gltf"
    for key in ("means", "sh", "opacities"):
        assert torch.equal(getattr(back.gaussians, key), getattr(cloud, key)), key
    torch.testing.assert_close(back.gaussians.scales, cloud.scales, rtol=1e-6, atol=0)
    turn = (back.gaussians.quats * cloud.quats).sum(1).abs()
    torch.testing.assert_close(turn, torch.ones(7), rtol=0, atol=1e-6)


def test_pygltflib_reads_what_the_extension_asks_for(tmp_path):
    cloud = _cloud()
    write_splats(tmp_path / "a.glb", cloud)
    document = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    primitive = document.meshes[0].primitives[0]
    assert (document.asset.version, primitive.mode, document.extensionsUsed) == ("2.0", 0, [KHR])
    assert primitive.extensions[KHR]["kernel"] == "ellipse"
    assert primitive.extensions[KHR]["colorSpace"] == "srgb_rec709_display"
    up = cloud.means.numpy() * [1, -1, -1]  # +Y up against y down
    np.testing.assert_array_equal(_values(document, "POSITION"), up.astype(np.float32))
    accessor = document.accessors[primitive.attributes.POSITION]
    np.testing.assert_allclose(accessor.min, up.min(0), rtol=1e-6)
    np.testing.assert_allclose(accessor.max, up.max(0), rtol=1e-6)
    np.testing.assert_allclose(
        _values(document, f"{KHR}:SCALE"), cloud.scales.numpy(), rtol=1e-6
    )  # linear, no logarithm
    np.testing.assert_allclose(_values(document, f"{KHR}:OPACITY")[:, 0], cloud.opacities.numpy(), rtol=1e-6)
    xyzw = _values(document, f"{KHR}:ROTATION")
    wxyz = cloud.quats.double().numpy()
    S = np.diag([1.0, -1.0, -1.0])
    for i in range(7):  # the covariance seen in the turned axes
        old = Rotation.from_quat(wxyz[i, [1, 2, 3, 0]]).as_matrix() * cloud.scales[i].double().numpy()
        new = Rotation.from_quat(xyzw[i]).as_matrix() * cloud.scales[i].double().numpy()
        np.testing.assert_allclose(new @ new.T, S @ old @ old.T @ S, atol=1e-6)
    color = np.clip(0.5 + 0.28209479177387814 * cloud.sh[:, 0].numpy(), 0, 1) * 255
    assert np.abs(_values(document, "COLOR_0")[:, :3] - color).max() <= 0.51


def test_harmonics_turn_with_the_axes(tmp_path):
    cloud = _cloud(6)
    write_splats(tmp_path / "a.glb", cloud)
    document = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    names = [(d, n) for d in range(4) for n in range(2 * d + 1)]
    stored = torch.from_numpy(np.stack([_values(document, f"{KHR}:SH_DEGREE_{d}_COEF_{n}") for d, n in names], 1))
    directions = torch.randn(6, 3, generator=torch.Generator().manual_seed(1))
    turned = directions * torch.tensor([1.0, -1.0, -1.0])
    torch.testing.assert_close(evaluate_sh(stored, turned), evaluate_sh(cloud.sh, directions))


def test_a_file_that_pygltflib_wrote_opens(tmp_path):
    n = 4
    rng = np.random.default_rng(0)
    arrays = {
        "POSITION": rng.normal(size=(n, 3)).astype("<f4"),
        f"{KHR}:ROTATION": np.tile([0, 0, 32767, 0], (n, 1)).astype("<i2"),  # normalised: half a turn around z
        f"{KHR}:SCALE": rng.uniform(0.1, 1, (n, 3)).astype("<f4"),
        f"{KHR}:OPACITY": np.array(
            [[0, 0, 0, 0], [255, 0, 0, 0], [51, 0, 0, 0], [102, 0, 0, 0]], "u1"
        ),  # 4 bytes apart
        f"{KHR}:SH_DEGREE_0_COEF_0": rng.normal(size=(n, 3)).astype("<f4"),
    }
    blob, views, accessors, attributes = b"", [], [], pygltflib.Attributes()
    kinds = {"ROTATION": (5122, "VEC4", True), "OPACITY": (5121, "SCALAR", True)}
    for i, (name, values) in enumerate(arrays.items()):
        code, kind, normalized = kinds.get(name.split(":")[-1], (5126, "VEC3", False))
        stride = 4 if code == 5121 else None
        views.append(pygltflib.BufferView(buffer=0, byteOffset=len(blob), byteLength=values.nbytes, byteStride=stride))
        accessors.append(
            pygltflib.Accessor(
                bufferView=i, byteOffset=0, componentType=code, normalized=normalized, count=n, type=kind
            )
        )
        setattr(attributes, name, i)
        blob += values.tobytes()
    primitive = pygltflib.Primitive(attributes=attributes, mode=0)
    primitive.extensions = {KHR: {"kernel": "ellipse", "colorSpace": "lin_rec709_display"}}
    document = pygltflib.GLTF2(
        scene=0,
        scenes=[pygltflib.Scene(nodes=[0])],
        nodes=[pygltflib.Node(mesh=0)],
        meshes=[pygltflib.Mesh(primitives=[primitive])],
        accessors=accessors,
        bufferViews=views,
        buffers=[pygltflib.Buffer(byteLength=len(blob))],
        extensionsUsed=[KHR],
    )
    document.set_binary_blob(blob)
    document.save(str(tmp_path / "theirs.glb"))
    splats = read_splats(tmp_path / "theirs.glb")
    g = splats.gaussians
    np.testing.assert_array_equal(g.means.numpy(), arrays["POSITION"] * np.float32([1, -1, -1]))
    np.testing.assert_allclose(g.opacities.numpy(), [0, 1, 0.2, 0.4], atol=1e-7)
    assert g.quats.abs().argmax(1).tolist() == [3] * n  # z of w, x, y, z: the axis stays, its sense may turn
    assert g.sh.shape == (n, 1, 3)
    assert splats.info["color_space"] == "lin_rec709_display"


def test_labels_names_and_columns_travel(tmp_path):
    cloud = _cloud().replace(labels=torch.tensor([-1, 0, 1, 2, 0, 2, 1]))
    extra = {"score": np.linspace(0, 1, 7, dtype=np.float32), "filter 3D": np.arange(7, dtype=np.uint8)}
    extra["huge"] = np.full(7, 2**31 - 1, np.int64)
    classes = ("wall", "Stuhl ä", "plant")
    written = write_splats(tmp_path / "a.glb", SplatFile(cloud, extra, classes))
    assert written.lost == ("the columns huge: .glb has no place for them",)
    back = read_splats(tmp_path / "a.glb")
    assert back.gaussians.labels.tolist() == cloud.labels.tolist()
    assert back.classes == classes
    assert set(back.extra) == {"score", "filter 3D"}
    np.testing.assert_array_equal(back.extra["score"], extra["score"])
    np.testing.assert_array_equal(back.extra["filter 3D"], np.arange(7))
    assert {"_CLASS_ID", "_SCORE", "_FILTER_3D"} < set(
        _json(tmp_path / "a.glb")["meshes"][0]["primitives"][0]["attributes"]
    )


def test_labels_without_names_may_be_large(tmp_path):
    cloud = _cloud(2).replace(labels=torch.tensor([300, 1 << 24]))
    write_splats(tmp_path / "a.glb", cloud)
    assert read_splats(tmp_path / "a.glb").gaussians.labels.tolist() == [300, 1 << 24]


def test_a_node_moves_resizes_and_turns(tmp_path):
    cloud = _cloud(5, 0)
    R = Rotation.from_euler("xyz", [20, -50, 100], degrees=True)
    node = {"mesh": 0, "rotation": R.as_quat().tolist(), "scale": [2, 2, 2], "translation": [1, 2, 3]}
    above = {"children": [1], "translation": [10, 0, 0]}
    path = _gltf(tmp_path, cloud, **{"nodes": [above, node]})
    g = read_splats(path).gaussians
    S = np.array([1.0, -1.0, -1.0])
    expected = (2 * R.apply(cloud.means.double().numpy() * S) + [11, 2, 3]) * S
    np.testing.assert_allclose(g.means.numpy(), expected, atol=1e-5)
    torch.testing.assert_close(g.scales, 2 * cloud.scales)
    for i in range(5):
        old = Rotation.from_quat(cloud.quats[i, [1, 2, 3, 0]].numpy()).as_matrix()
        expected_axes = np.diag(S) @ R.as_matrix() @ np.diag(S) @ old
        axes = Rotation.from_quat(g.quats[i, [1, 2, 3, 0]].numpy()).as_matrix()
        np.testing.assert_allclose(np.abs(np.sum(axes * expected_axes, 0)), 1, atol=1e-5)  # same axes up to sign


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_turned_node_looks_the_same_from_a_moved_camera(tmp_path, degree):
    cloud = _cloud(30, degree)
    R = Rotation.from_euler("xyz", [25, -65, 110], degrees=True).as_matrix()
    node = {
        "mesh": 0,
        "translation": [1, 2, 3],
        "scale": [1.5] * 3,
        "rotation": Rotation.from_matrix(R).as_quat().tolist(),
    }
    moved = read_splats(_gltf(tmp_path, cloud, **{"nodes": [node]})).gaussians
    S = np.diag([1.0, -1.0, -1.0])  # glTF's axes against ours
    motion = Similarity(1.5, torch.from_numpy(S @ R @ S), torch.tensor([1.0, -2.0, -3.0]))
    viewmat = torch.eye(4)
    viewmat[2, 3] = 6.0
    camera = Camera(viewmat, torch.tensor([[40.0, 0, 20], [0, 44, 14], [0, 0, 1]]), 36, 30)
    before, after = rasterize(cloud, camera).map, rasterize(moved, motion.apply_to_camera(camera)).map
    assert before.std() > 0.1
    torch.testing.assert_close(after, before, rtol=0, atol=2e-4)  # float32 all the way, up to 30 Gaussians a pixel


def test_a_node_that_moves_beyond_float32_is_named(tmp_path):
    path = _gltf(tmp_path, _cloud(5, 0), **{"nodes/0/scale": [1e25] * 3, "nodes/0/translation": [1e29, 0, 0]})
    assert read_splats(path).gaussians.means.isfinite().all()
    root = json.loads(path.read_text())
    root["nodes"] = [{"children": [1], "scale": [1e25] * 3}, root["nodes"][0]]
    root["scenes"][0]["nodes"] = [0]
    path.write_text(json.dumps(root))
    with pytest.raises(ValueError, match=r"bent.gltf: expected finite positions, got .*inf"):
        read_splats(path)


def test_half_turns_take_all_degrees_along(tmp_path):
    cloud = _cloud(5, 3)
    matrix = np.diag([-1.0, 1.0, -1.0, 1.0])
    matrix[:3, 3] = [1, 2, 3]
    path = _gltf(tmp_path, cloud, **{"nodes/0/matrix": matrix.T.ravel().tolist()})
    g = read_splats(path).gaussians
    turn = torch.tensor([-1.0, 1.0, -1.0])
    torch.testing.assert_close(g.means, cloud.means * turn + torch.tensor([1.0, -2.0, -3.0]))
    directions = torch.randn(5, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(evaluate_sh(g.sh, directions * turn), evaluate_sh(cloud.sh, directions))


def test_primitives_join(tmp_path):
    path = _gltf(tmp_path, _cloud(5, 1))
    root = json.loads(path.read_text())
    primitive = root["meshes"][0]["primitives"][0]
    plain = json.loads(json.dumps(primitive))
    for key in [key for key in plain["attributes"] if "DEGREE_1" in key]:
        del plain["attributes"][key]
    mesh = {"mode": 4, "attributes": {"POSITION": 0}}
    root["meshes"][0]["primitives"] = [primitive, plain, mesh]
    path.write_text(json.dumps(root))
    splats = read_splats(path)
    assert (splats.info["primitives"], splats.info["ignored"], len(splats)) == (2, 1, 10)
    assert bool((splats.gaussians.sh[5:, 1:] == 0).all())
    assert bool((splats.gaussians.sh[:5, 1:] != 0).all())


def test_drafts_are_read(tmp_path):
    """Logarithms as scales; names with an underscore; colour and opacity from COLOR_0."""
    cloud = _cloud(5, 0)
    path = _gltf(tmp_path, cloud)
    root = json.loads(path.read_text())
    attributes = root["meshes"][0]["primitives"][0]["attributes"]
    attributes["_ROTATION"] = attributes.pop(f"{KHR}:ROTATION")
    index = attributes.pop(f"{KHR}:SCALE")
    attributes["_SCALE"] = index
    del attributes[f"{KHR}:OPACITY"], attributes[f"{KHR}:SH_DEGREE_0_COEF_0"]
    blob = bytearray(base64.b64decode(root["buffers"][0]["uri"].partition(",")[2]))
    start = root["bufferViews"][index]["byteOffset"]
    blob[start : start + 60] = (cloud.scales * 0.3).log().numpy().astype("<f4").tobytes()
    root["buffers"][0]["uri"] = "data:;base64," + base64.b64encode(blob).decode()
    path.write_text(json.dumps(root))
    g = read_splats(path).gaussians
    torch.testing.assert_close(g.scales, cloud.scales * 0.3)
    torch.testing.assert_close(g.opacities, cloud.opacities, rtol=0, atol=0.5 / 255 + 1e-6)
    rgb = (cloud.sh[:, 0] * 0.28209479 + 0.5).clamp(0, 1)
    torch.testing.assert_close(g.sh[:, 0] * 0.28209479 + 0.5, rgb, rtol=0, atol=0.5 / 255 + 1e-6)


def test_a_buffer_beside_the_document_is_read(tmp_path):
    cloud = _cloud(5, 1)
    path = _gltf(tmp_path, cloud)
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
    path = _gltf(tmp_path / "scene", **{"buffers/0/uri": uri})
    with pytest.raises(ValueError, match=r"bent.gltf: buffers\[0\]: expected a file beside it, got the uri"):
        read_splats(path)


def test_links_that_lead_elsewhere_are_refused(tmp_path):
    (tmp_path / "secret.bin").write_bytes(b"\0" * 4096)
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "a.bin").symlink_to(tmp_path / "secret.bin")
    path = _gltf(tmp_path / "scene", **{"buffers/0/uri": "a.bin"})
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
    path = _gltf(tmp_path, **changes)
    with pytest.raises(ValueError, match=f"bent.gltf: .*{message}"):
        read_splats(path)


def test_one_buffer_shown_a_thousand_times_is_refused(tmp_path):
    path = _gltf(tmp_path, _cloud(400, 0))
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
    write_splats(path, _cloud(5, 1).replace(labels=torch.arange(5)))
    root = _json(path)
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


def test_what_cannot_be_written_is_named(tmp_path):
    with pytest.raises(ValueError, match="expected a cloud with colours .* for .glb"):
        write_splats(tmp_path / "a.glb", _cloud().replace(sh=None))
    with pytest.raises(ValueError, match="expected at least one Gaussian, got none; .* write .ply"):
        write_splats(tmp_path / "a.glb", _cloud(0))
    with pytest.raises(ValueError, match="labels: expected -1 to 16777216 for glTF, got 99999999; number"):
        write_splats(tmp_path / "a.glb", _cloud(2).replace(labels=torch.tensor([0, 99_999_999])))
    assert list(tmp_path.iterdir()) == []


def test_its_precision_is_that_of_float32():
    stated = format_gltf.precision(_cloud())
    assert (stated.means, stated.sh0, stated.sh_rest, stated.degree) == (0.0, 0.0, 0.0, 3)
