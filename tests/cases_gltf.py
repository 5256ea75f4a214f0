"""Documents that the glTF tests share: a random cloud, its .gltf with parts exchanged, and JSON read by hand."""

import json
import struct

import numpy as np
import torch

from kfgs import Gaussians
from kfgs.formats import write_splats

KHR = "KHR_gaussian_splatting"


def random_cloud(n: int = 7, degree: int = 3, seed: int = 3, **changes) -> Gaussians:
    """Random Gaussians of unit quaternions."""
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=g),
        quats=torch.nn.functional.normalize(torch.randn(n, 4, generator=g), dim=1),
        scales=torch.rand(n, 3, generator=g) + 0.1,
        opacities=torch.rand(n, generator=g) * 0.9 + 0.05,
        sh=torch.randn(n, (degree + 1) ** 2, 3, generator=g),
    ).replace(**changes)


def json_of_glb(path) -> dict:
    """The JSON of a .glb, read by hand."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size])


def bent_gltf(tmp_path, cloud=None, **changes):
    """A .gltf of ours with parts of its JSON exchanged: `changes` maps a dotted path to a value (None deletes)."""
    path = tmp_path / "bent.gltf"
    write_splats(random_cloud(5, 1) if cloud is None else cloud, path)
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


def ply_columns(count, degree=0, base="f_dc_"):
    """Random values of a PLY of 3DGS, in the order of its columns."""
    names = [*"xyz", *(f"{base}{i}" for i in range(3) if base)]
    names += [*(f"f_rest_{i}" for i in range(3 * (degree + 1) ** 2 - 3)), "opacity"]
    names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    rng = np.random.default_rng(5)
    return {name: (rng.normal(size=count) - 3 * name.startswith("scale")).astype("f4") for name in names}
