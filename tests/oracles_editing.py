"""Surface clouds of the toy room from its own ground truth, and densities by brute force."""

import numpy as np
import torch
from cases_clouds import balls
from PIL import Image

from kfgs.gaussians import Gaussians


def paint_room(folder, scene, *, voxel: float = 0.04, stride: int = 1) -> Gaussians:
    """A colour cloud with true labels: the pixels of the training views, put where the exact depth says they are.

    One small ball per cell of `voxel` metres, with the colour and the class of the nearest pixel that saw it.
    """
    points, colors, labels, sizes = [], [], [], []
    for i in scene.views("train"):
        camera, stem = scene.cameras[i], scene.stem(i)
        depth = np.load(folder / "depth" / f"{stem}.npy").astype(np.float64)
        height, width = depth.shape
        K, E = camera.K.double().numpy(), camera.viewmat.double().numpy()
        for row in range(0, height, stride):
            z = depth[row, ::stride]
            column = np.arange(0, width, stride)
            x, y = (column + 0.5 - K[0, 2]) / K[0, 0] * z, np.full_like(z, (row + 0.5 - K[1, 2]) / K[1, 1]) * z
            points.append((np.stack([x, y, z], 1) - E[:3, 3]) @ E[:3, :3])  # R^T (p - t)
            sizes.append(z / K[0, 0])
        labels.append(np.array(Image.open(folder / "labels" / f"{stem}.png"))[::stride, ::stride].ravel())
        colors.append(np.array(Image.open(folder / "images" / f"{stem}.png"))[::stride, ::stride].reshape(-1, 3) / 255)
    points, colors, labels, sizes = (np.concatenate(part) for part in (points, colors, labels, sizes))
    order = np.argsort(sizes, kind="stable")
    cells = np.floor(points[order] / voxel).astype(np.int64)
    first = order[np.unique(cells, axis=0, return_index=True)[1]]
    sh = torch.from_numpy((colors[first] - 0.5) / 0.28209479177387814).float()[:, None]
    return balls(points[first], labels[first], scale=0.45 * voxel, opacity=0.95, sh=sh)
