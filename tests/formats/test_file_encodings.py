"""The same splat in the encodings that programs really write: each opens as the same Gaussians."""

import base64
import json
from itertools import product

import numpy as np
import pytest
from cases_gltf import ply_columns

from kfgs.formats import read_splats

N = 5
LAYOUTS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
WORDS = {"f4": ("float", "float32"), "f8": ("double", "float64")}


def _write(path, columns, layout, kind, spelling, newline, normals, backwards):
    """A PLY written by hand, row by row."""
    if normals:
        columns = columns | {name: np.zeros(N, "f4") for name in ("nx", "ny", "nz")}
    if backwards:
        columns = dict(reversed(columns.items()))
    head = ["ply", f"format {layout} 1.0", "comment by hand", f"element vertex {N}"]
    head += [f"property {WORDS[kind][spelling]} {name}" for name in columns] + ["end_header"]
    body = b""
    for i in range(N):
        row = [values[i] for values in columns.values()]
        if layout == "ascii":
            body += (" ".join(repr(float(value)) for value in row) + newline).encode()
        else:
            body += b"".join(np.array(value, LAYOUTS[layout] + kind).tobytes() for value in row)
    path.write_bytes((newline.join(head) + newline).encode() + body)


@pytest.mark.parametrize(
    ("layout", "kind", "spelling", "newline", "normals"),
    list(product(LAYOUTS, WORDS, (0, 1), ("\n", "\r\n"), (False, True))),
)
def test_48_encodings_of_ply_are_one_splat(tmp_path, layout, kind, spelling, newline, normals):
    columns = ply_columns(N, degree=1)
    _write(tmp_path / "a.ply", columns, layout, kind, spelling, newline, normals, backwards=normals and spelling == 1)
    cloud = read_splats(tmp_path / "a.ply")
    wide = {name: values.astype(float) for name, values in columns.items()}

    def stacked(*names: str) -> np.ndarray:
        return np.stack([wide[name] for name in names], -1)

    rest = stacked(*(f"f_rest_{i}" for i in range(9))).reshape(N, 3, 3)  # channel-major
    expected = {
        "means": stacked(*"xyz"),
        "scales": np.exp(stacked("scale_0", "scale_1", "scale_2")),
        "quats": stacked("rot_0", "rot_1", "rot_2", "rot_3"),
        "opacities": 1 / (1 + np.exp(-wide["opacity"])),
        "sh": np.concatenate([stacked("f_dc_0", "f_dc_1", "f_dc_2")[:, None], rest.transpose(0, 2, 1)], 1),
    }
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(cloud, name).numpy(), values, rtol=1e-6, atol=1e-7, err_msg=name)


@pytest.mark.parametrize("bits", [8, 16])
def test_quantised_gltf_is_read_to_half_a_step(tmp_path, bits):
    """KHR_gaussian_splatting with normalised whole numbers for rotation and opacity (KHR_mesh_quantization's rule)."""
    rng = np.random.default_rng(2)
    turns = rng.normal(size=(N, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)  # x y z w
    opacity = rng.uniform(0.1, 0.9, N)
    most, all_ones = 2 ** (bits - 1) - 1, 2**bits - 1
    code = {8: (5120, 5121), 16: (5122, 5123)}[bits]
    extension = "KHR_gaussian_splatting"
    data = {
        "POSITION": (5126, "VEC3", False, rng.normal(size=(N, 3)).astype("<f4")),
        f"{extension}:ROTATION": (code[0], "VEC4", True, (turns * most).round().astype(f"<i{bits // 8}")),
        f"{extension}:SCALE": (5126, "VEC3", False, np.full((N, 3), 0.1, "<f4")),
        f"{extension}:OPACITY": (code[1], "SCALAR", True, (opacity * all_ones).round().astype(f"<u{bits // 8}")),
        f"{extension}:SH_DEGREE_0_COEF_0": (5126, "VEC3", False, rng.normal(size=(N, 3)).astype("<f4")),
    }
    blob, views, accessors = b"", [], []
    for i, (component, kind, normalized, values) in enumerate(data.values()):
        stride = -(-values[0].nbytes // 4) * 4  # attributes lie at multiples of four bytes
        padded = b"".join(row.tobytes().ljust(stride, b"\0") for row in values)
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(padded), "byteStride": stride})
        about = {"componentType": component, "normalized": normalized, "count": N, "type": kind}
        accessors.append({"bufferView": i, **about})
        blob += padded
    places = data["POSITION"][3]
    accessors[0] |= {"min": places.min(0).tolist(), "max": places.max(0).tolist()}
    primitive = {"mode": 0, "attributes": {name: i for i, name in enumerate(data)}}
    primitive["extensions"] = {extension: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    root = {"asset": {"version": "2.0"}, "extensionsUsed": [extension], "meshes": [{"primitives": [primitive]}]}
    root |= {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "accessors": accessors}
    uri = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
    root |= {"bufferViews": views, "buffers": [{"byteLength": len(blob), "uri": uri}]}
    (tmp_path / "a.gltf").write_text(json.dumps(root))
    cloud = read_splats(tmp_path / "a.gltf")
    np.testing.assert_allclose(cloud.opacities.numpy(), opacity, atol=0.51 / all_ones)
    quats = cloud.quats.numpy() / np.linalg.norm(cloud.quats.numpy(), axis=1, keepdims=True)
    wanted = turns[:, [3, 0, 1, 2]] * [1, 1, -1, -1]  # w x y z, with y and z flipped as the axes are
    sign = np.sign((quats * wanted).sum(1, keepdims=True))
    np.testing.assert_allclose(quats * sign, wanted, atol=1.5 / most)
