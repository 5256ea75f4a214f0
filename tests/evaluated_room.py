"""A toy room with what `kfgs evaluate` scores: a field, a splat with features, and a colour splat before and after edits."""

import numpy as np
import torch

from kfgs import Gaussians
from kfgs._files import read_json
from kfgs.formats import write_splats
from kfgs.labels import load_label_set
from kfgs.splat.sh import SH_C0

REMOVED = "plant"


def surface_splat(room, *, every=1):
    """Gaussians on the surfaces, with grey levels by class and the class in `labels`."""
    with np.load(room / "surface.npz") as file:
        points, labels = (
            torch.from_numpy(file["points"])[::every],
            torch.from_numpy(file["labels"].astype(np.int64))[::every],
        )
    N = len(points)
    shades = torch.linspace(0.2, 0.9, len(read_json(room / "classes.json")))[labels]
    sh = ((shades[:, None].expand(N, 3) - 0.5) / SH_C0)[:, None, :].contiguous()
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(N, 1)
    return Gaussians(points.float(), quats, torch.full((N, 3), 0.06), torch.full((N,), 0.95), sh=sh, labels=labels)


def save_splats(room, folder):
    """`before.ply`, `removed.ply`, `painted.ply`; and `features.npy`, the text row of each Gaussian's class."""
    cloud, names = surface_splat(room), read_json(room / "classes.json")
    label = names.index(REMOVED)
    mine = cloud.labels == label
    red = ((torch.tensor([0.9, 0.1, 0.1]) - 0.5) / SH_C0).expand_as(cloud.sh)
    painted = cloud.replace(sh=torch.where(mine[:, None, None], red, cloud.sh))
    for name, one in (("before", cloud), ("removed", cloud.select(~mine)), ("painted", painted)):
        write_splats(one.replace(labels=None), folder / f"{name}.ply")
    text = load_label_set(room / "classes.json", room / "text.npy").embeddings
    np.save(folder / "features.npy", text[cloud.labels].numpy())
    return folder
