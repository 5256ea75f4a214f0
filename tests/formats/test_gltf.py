"""glTF against closed forms, and against pygltflib as a reader and writer of its own."""

import json

import numpy as np
import pygltflib
import pytest
import torch
from cases_gltf import KHR, bent_gltf, random_cloud
from messages import refused, tells
from scipy.spatial.transform import Rotation

from kfgs.formats import read_splats, write_splats
from kfgs.splat.sh import evaluate_sh


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


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_survive_exactly(tmp_path, name, degree):
    cloud = random_cloud(degree=degree)
    assert write_splats(cloud, tmp_path / name).lost == ()
    back = read_splats(tmp_path / name)
    for key in ("means", "sh", "opacities"):
        assert torch.equal(getattr(back, key), getattr(cloud, key)), key
    torch.testing.assert_close(back.scales, cloud.scales, rtol=1e-6, atol=0)
    turn = (back.quats * cloud.quats).sum(1).abs()
    torch.testing.assert_close(turn, torch.ones(7), rtol=0, atol=1e-6)


def test_pygltflib_reads_what_the_extension_asks_for(tmp_path):
    cloud = random_cloud()
    write_splats(cloud, tmp_path / "a.glb")
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
    np.testing.assert_allclose(_values(document, f"{KHR}:SCALE"), cloud.scales.numpy(), rtol=1e-6)  # linear
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
    cloud = random_cloud(6)
    write_splats(cloud, tmp_path / "a.glb")
    document = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    names = [(d, n) for d in range(4) for n in range(2 * d + 1)]
    stored = torch.from_numpy(np.stack([_values(document, f"{KHR}:SH_DEGREE_{d}_COEF_{n}") for d, n in names], 1))
    directions = torch.randn(6, 3, generator=torch.Generator().manual_seed(1))
    turned = directions * torch.tensor([1.0, -1.0, -1.0])
    torch.testing.assert_close(evaluate_sh(stored, turned), evaluate_sh(cloud.sh, directions))


def test_labels_scores_and_names_travel(tmp_path):
    cloud = random_cloud().replace(labels=torch.tensor([-1, 0, 1, 2, 0, 2, 1]), names=("wall", "Stuhl ä", "plant"))
    cloud = cloud.replace(scores=np.linspace(0, 1, 7, dtype=np.float32), extra={"id": np.arange(7)})
    assert write_splats(cloud, tmp_path / "a.glb").lost == ("the columns id: .glb has no place for them",)
    back = read_splats(tmp_path / "a.glb")
    assert back.labels.tolist() == cloud.labels.tolist()
    assert back.names == cloud.names
    np.testing.assert_array_equal(back.scores, cloud.scores)
    large = random_cloud(2).replace(labels=torch.tensor([300, 1 << 24]))
    write_splats(large, tmp_path / "b.glb")
    assert read_splats(tmp_path / "b.glb").labels.tolist() == [300, 1 << 24]


def test_primitives_join(tmp_path):
    path = bent_gltf(tmp_path, random_cloud(5, 1))
    root = json.loads(path.read_text())
    primitive = root["meshes"][0]["primitives"][0]
    plain = json.loads(json.dumps(primitive))
    for key in [key for key in plain["attributes"] if "DEGREE_1" in key]:
        del plain["attributes"][key]
    mesh = {"mode": 4, "attributes": {"POSITION": 0}}
    root["meshes"][0]["primitives"] = [primitive, plain, mesh]
    path.write_text(json.dumps(root))
    splats = read_splats(path)
    assert len(splats) == 10
    assert bool((splats.sh[5:, 1:] == 0).all())
    assert bool((splats.sh[:5, 1:] != 0).all())


def test_what_cannot_be_written_is_named(tmp_path):
    refused(lambda: write_splats(random_cloud().replace(sh=None), tmp_path / "a.glb"), "gaussians:", "colours", ".glb")
    refused(lambda: write_splats(random_cloud(0), tmp_path / "a.glb"), "gaussians:", "got none", ".ply")
    with pytest.raises(ValueError, match=tells("labels:", "expected -1 to 16777216", "glTF", "got 99999999")):
        write_splats(random_cloud(2).replace(labels=torch.tensor([0, 99_999_999])), tmp_path / "a.glb")
    assert list(tmp_path.iterdir()) == []


def test_a_colour_space_that_is_not_drawn_is_told(tmp_path, notes):
    place = f"meshes/0/primitives/0/extensions/{KHR}/colorSpace"
    read_splats(bent_gltf(tmp_path, **{place: "lin_rec709_display"}))
    note = "the file says colorSpace 'lin_rec709_display': drawn as if it were 'srgb_rec709_display'"
    assert note in notes[0]
