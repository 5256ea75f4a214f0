"""Documents that the glTF tests share: a random cloud, its .gltf with parts exchanged, and JSON read by hand."""

import json
import struct

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
