"""The toy room's surface as a field that knows the truth, and as a colour splat: no training, for the command line's tests."""

from pathlib import Path

import numpy as np
import torch
from cases_clouds import balls

from kfgs.fields import Identity, SemanticField
from kfgs.formats import write_splats
from kfgs.labels import load_label_set
from kfgs.scenes import load_scene
from kfgs.viz import palette

SH0 = 0.28209479177387814  # of the constant spherical harmonic


def surface(room: Path):
    """Gaussians on the room's surface, and the true class of each."""
    data = np.load(room / "surface.npz")
    return balls(data["points"], scale=0.06, opacity=0.95), torch.from_numpy(data["labels"].astype(np.int64))


def make_field(room: Path, folder: Path) -> Path:
    """A semantic field whose features are the class embeddings."""
    cloud, labels = surface(room)
    classes, scene = load_label_set(room / "classes.json", room / "text.npy"), load_scene(room)
    views = [scene.cameras[i].name for i in scene.views("train")]
    decoder, info = Identity(classes.dim), {"views": views}
    SemanticField(cloud.replace(features=classes.embeddings[labels].float()), decoder, info=info).save(folder)
    return folder


def make_splat(room: Path, path: Path) -> Path:
    """A colour splat: a colour for each class, in shades."""
    cloud, labels = surface(room)
    shade = 1 - 0.3 * torch.rand(len(labels), 1, generator=torch.Generator().manual_seed(0))
    rgb = torch.from_numpy(palette(labels)).float() / 255 * shade
    write_splats(cloud.replace(sh=((rgb - 0.5) / SH0)[:, None]), path)
    return path
