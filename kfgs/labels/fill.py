"""What stood behind a removed thing: flat surfaces around it continue through the hole, as new Gaussians.

Opacities behind a thing were never needed, so they were never learnt: black holes and tufts remain. Planes are found in what
stays near it, and drawn from far above. Where a plane is thin, the more so the nearer the thing was, discs with the colours
of the surface around replace its Gaussians. Whatever is not flat stays as it is, and so do shadows of the thing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
from scipy.ndimage import binary_erosion, binary_opening, gaussian_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from skimage.measure import label as connected_pixels
from skimage.morphology import convex_hull_image
from torch import Tensor

from .._arrays import Array
from .._check import ORIGIN
from .._notes import tell
from ..cameras import Camera
from ..cameras.projection import camera_to_pixel, unproject_depth, world_to_camera
from ..gaussians import Gaussians
from ..splat.rasterize import rasterize
from ..splat.sh import rgb_to_sh0
from .components import number_parts
from .transfer import positions

NEAR = 0.5  # planes are looked for within half the size of the thing
PLANES, SHARE = 8, 0.02  # at most 8 planes, each with 2 % of what is near, by area and opacity
GUESSES, DRAWN, NEIGHBOURS = 500, 2_000, 16  # a guess is the plane through a point and two of its neighbours
SEEN, SURE = 0.5, 0.8  # opacity of a surface's pixels, and of those whose colours are taken
FLAT = 0.3  # a class lies on a surface if its share there is at least this much of the largest; feet only touch it
EDGE = 4  # pixels at the edge of a surface, where it is mixed with others
DENSE = 0.5  # a surface covers half of its convex hull
CELLS = 400  # pixels of a plane's picture, at most
FAR = 200  # heights of the picture between the plane and its camera: nearly parallel rays
SCALES = (1, 2, 4, 8, 16, 32)  # pixels over which colours are averaged; a scale counts by 1 / square


def fill_holes(gaussians: Gaussians, mask: Tensor) -> Gaussians:  # mask: [N] bool, of some Gaussians
    """Remove the Gaussians under the mask and close the surfaces behind; a note has the number of new Gaussians.

    They come last, each with the label and other columns of the nearest Gaussian of its surface. Colours are weighted means
    of the surface around (normalised convolution): at these ragged borders 1.1 dB better than
    `skimage.restoration.inpaint_biharmonic`, which continues slopes. A ValueError if the cloud has no colours.
    """
    if gaussians.sh is None:
        raise ValueError("fill: expected colours (sh) to continue, got none; edit the colour splat, or leave out fill")
    cloud, mask, like = gaussians.detach().to("cpu").replace(origin=ORIGIN), mask.cpu(), gaussians.means
    zero = cloud.means[mask].double().nanmedian(0).values  # float32 counts from the thing
    cloud = cloud.replace(means=cloud.means.double() - zero).to(torch.float32)
    apart = 4 * float(cloud.scales.amax(1).nanmedian())  # scattered Gaussians are no thing: their size is 0
    kept, part = cloud.select(~mask), number_parts(cloud, mask, apart)[mask].numpy()
    points, thing = positions("gaussians.means", kept.means), positions("gaussians.means", cloud.means[mask])
    edges = [np.quantile(thing[part == i], (0.05, 0.95), axis=0) for i in range(part.max() + 1)]
    size = float(np.median(np.ptp(edges, axis=1).max(1)[part]))  # most parts may be specks: the median over Gaussians
    tree = cKDTree(thing)
    near = np.isfinite(tree.query(points, distance_upper_bound=NEAR * size)[0])
    new, hidden = [], np.zeros(len(points), bool)
    if near.any():
        cell = float(np.nanmedian(kept.scales.amax(1).numpy()[near]))
        weights = np.nan_to_num((kept.opacities * kept.scales.topk(2).values.prod(1)).double().numpy()[near], posinf=0)
        weights = np.minimum(weights, np.quantile(weights, 0.95))  # a single large one is no plane
        for normal, place in _planes(points[near], weights, 2 * cell):
            discs, rows = _continue(kept, points, tree, normal, place, cell, size)
            hidden[rows] = True
            new.append(discs)
    count = f"{sum(map(len, new)):,} new Gaussians, in place of {hidden.sum():,},"
    tell(f"fill: {count} continue the surfaces around what is removed; nobody saw them")
    new = [discs.replace(means=discs.means.double() + zero, origin=gaussians.origin) for discs in new]
    rest = gaussians.select(np.flatnonzero(~mask.numpy())[~hidden])  # as they were, to the last bit
    return Gaussians.cat([rest, *(discs.to(like.device, like.dtype) for discs in new)])


def _planes(points: Array, weights: Array, reach: float) -> Iterator[tuple[Array, Array]]:  # [3], [3]
    """Planes (normal and point), the heaviest first: RANSAC within `reach` (scikit-image's has no planes), then least squares."""
    rng, least = np.random.default_rng(0), SHARE * weights.sum()
    for _ in range(PLANES):
        drawn = points[rng.choice(len(points), DRAWN, p=weights / weights.sum())] if weights.sum() > 0 else points[:0]
        if len(places := np.unique(drawn, axis=0)) <= NEIGHBOURS:
            return
        a = places[rng.integers(len(places), size=GUESSES)]
        around = places[cKDTree(places).query(a, k=NEIGHBOURS + 1)[1]]  # neighbours are more often on one plane
        b, c = (around[np.arange(GUESSES), rng.integers(1, NEIGHBOURS + 1, GUESSES)] for _ in range(2))
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        best = ((np.abs(drawn @ normals.T - (a * normals).sum(1)) < reach).sum(0) * normals.any(1)).argmax()
        normal, place = normals[best], a[best]
        for _ in range(5):
            on = np.abs((points - place) @ normal) < reach
            place = np.average(points[on], axis=0, weights=weights[on])
            normal = np.linalg.eigh(np.cov(points[on].T, aweights=weights[on]))[1][:, 0]
        away = np.abs((points - place) @ normal)
        if weights[away < reach].sum() < least:
            return
        yield normal, place
        points, weights = points[away > 3 * reach], weights[away > 3 * reach]


def _continue(
    kept: Gaussians, points: Array, tree: cKDTree, normal: Array, place: Array, cell: float, size: float
) -> tuple[Gaussians, Array]:  # the discs; the indices of the Gaussians that they replace
    """Close a surface where it is thin near the thing, whose Gaussians are in the `tree`."""
    low, high = np.quantile(tree.data, (0.01, 0.99), axis=0)
    middle, extent = (low + high) / 2, float(np.linalg.norm(high - low)) + 2 * size
    normal = normal if (middle - place) @ normal > 0 else -normal  # towards the thing
    middle -= (middle - place) @ normal * normal
    side, far, fov = min(math.ceil(extent / cell) + 1, CELLS), FAR * extent, 2 * math.degrees(math.atan(0.5 / FAR))
    cell, eye, up = extent / side, torch.from_numpy(middle + far * normal), np.eye(3)[np.abs(normal).argmin()].tolist()
    lens = {"fov_degrees": fov, "width": side, "height": side, "near": far / 2}
    camera = Camera.look_at(eye, torch.from_numpy(middle), up=up, **lens)  # type: ignore[arg-type]
    local, rough = world_to_camera(camera, torch.from_numpy(points)), camera.to(torch.float32)
    above, (column, row) = far - local[:, 2].numpy(), camera_to_pixel(camera, local).floor().long().numpy().T
    inside = (column >= 0) & (column < side) & (row >= 0) & (row < side)
    layer, beyond = np.flatnonzero(inside & (np.abs(above) < 2 * cell)), np.flatnonzero(above < -4 * cell)
    surface, behind = kept.select(torch.from_numpy(layer)), kept.select(torch.from_numpy(beyond))
    shown = rasterize(surface.replace(features=None, sh=surface.sh[:, :1]), rough)  # type: ignore[index]
    color, alpha = shown.map.numpy(), shown.alpha.numpy()
    through = (alpha < SEEN) & (rasterize(behind.replace(features=None), rough).alpha.numpy() > SEEN)
    parts = connected_pixels(binary_opening(alpha > SEEN, iterations=EDGE), connectivity=1)
    part = parts == np.bincount(parts[parts > 0], minlength=2).argmax()
    hull = convex_hull_image(part) if parts.any() else np.zeros_like(part)
    centres = unproject_depth(camera, torch.full((side, side), far, dtype=torch.float64)).numpy()
    distance = np.reshape(tree.query(centres.reshape(-1, 3))[0], (side, side)) / size
    thin = binary_erosion(hull, iterations=EDGE) & (alpha < 1.1 - 2 * distance) & ~through
    sure = binary_erosion(alpha > SURE, iterations=EDGE)
    if part.sum() < DENSE * hull.sum() or not sure.any():
        thin[:] = False
    known = np.dstack([color / np.maximum(alpha, 1e-6)[..., None], np.ones_like(alpha)]) * sure[..., None]
    blurred = np.sum([gaussian_filter(known, (scale, scale, 0))[thin] / scale**2 for scale in SCALES], axis=0)
    color, means = (blurred[:, :3] / np.maximum(blurred[:, 3:], 1e-12)).clip(0, 1), centres[thin]
    if kept.labels is not None:  # what stands on a surface, and touches it, gives nothing and stays
        by_class = kept.labels.numpy() + 1
        total, flat = np.bincount(by_class[inside & (np.abs(above) < size)]), np.bincount(by_class[layer])
        share = flat / np.maximum(total[: len(flat)], 1)
        layer = layer[(share >= FLAT * share.max(initial=0))[by_class[layer]]]
    discs = kept.select(torch.from_numpy(layer[cKDTree(points[layer]).query(means)[1]]))
    quat = Rotation.from_matrix(camera.R.numpy().T).as_quat(scalar_first=True)
    rows = {"means": means, "quats": [quat], "scales": [(cell, cell, 0.1 * cell)]}
    shape = {name: torch.tensor(np.array(values)).float().expand(len(means), -1) for name, values in rows.items()}
    sh = torch.zeros_like(discs.sh)  # type: ignore[arg-type]
    sh[:, 0] = rgb_to_sh0(torch.from_numpy(color).float())
    discs = discs.replace(**shape, sh=sh, opacities=torch.full_like(discs.opacities, 0.99))
    return discs, layer[thin[row[layer], column[layer]]]
