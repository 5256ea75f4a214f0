"""Carry features of 2-D maps, or what views show of a trained field, to Gaussians: average in 3-D, correct, then compress.

Each Gaussian takes the mean of the pixels that show it, weighted by its rendering weight w = T alpha, less at the picture's
border. Every rendered pixel is a blend, so near the edge of a thing the mean contains some of the neighbours. A few passes of the
simultaneous iterative reconstruction technique (SIRT, Gilbert 1972) remove that: render, compare, carry the difference back.

*Sums* are [2, N, d + 1]: over the even and over the odd views, of d channels and, last, of the weight.

Training constrains only blends of Gaussians, so the latent of a single one may decode to something that no view shows. The mean
over its pixels (`fuse_views`), computed once when a field is finished, does not have this problem.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from tqdm import tqdm

from .._check import as_bar, check_range, check_whole
from .._rows import EPS, row_norms, unit_rows
from ..cameras import Camera, as_cameras, resize_map
from ..formats.values import check_splats
from ..gaussians import Gaussians
from ..quant.grow import cap
from ..quant.linear import LinearLatents, fit_linear_latents
from ..quant.maps import FeatureMaps
from ..splat import accumulate_pixels, average_views, bin_tiles, composite, project, rasterize
from ..splat.views import divide_sums, sum_pixels
from .decoders import Autoencoded, Codewords, Linear
from .merge import merge_gaussians
from .semantic_field import SemanticField
from .working_maps import WorkingMaps, sample_latents, shrink_map

LEFT_OUT = 8  # at most this many views judge a field
SPARSE = 0.3  # share of the views' pixels: a splat of the scene fills nearly all of them
NEIGHBOURS = 17  # a Gaussian and its 16 nearest, whose corrections are judged together
KEEP, MOST = 0.999, 64  # share of the codewords' variation to keep, with at most this many latents
PIXELS = 80_000  # most pixels of a view that are rendered
BORDER = 0.25  # of a picture's size: nearer to its border pixels count less; networks err where things are cut off
LEAST = 0.05  # what a pixel at the border counts


@dataclass(frozen=True)
class UpliftConfig:
    """Options of `uplift_maps`. The defaults keep every Gaussian; `UpliftConfig.field()` makes a small field."""

    max_gaussians: int | None = None
    """Prune and merge to at most this many (`merge_gaussians`). None keeps every Gaussian unchanged."""
    keep: float = 0.995
    """Share of the fused features' variation around their main direction that latents keep; it decides their number."""
    max_latents: int = 32
    """Most latents of a Gaussian."""
    corrections: int = 1
    """Passes of SIRT over all views; if there is any, one more follows after merging. A second pass helps a little for blurred
    maps, and harms as much for sharp and noisy ones."""
    pixels: int = 80_000
    """Most pixels of a working view. Views are rendered at the largest whole multiple of the map's size within it; larger maps
    are shrunk by a whole factor."""

    def __post_init__(self) -> None:
        check_whole("max_gaussians", 1 if self.max_gaussians is None else self.max_gaussians, 1)
        check_range("keep", self.keep, 0, 1, closed=(False, True))
        for name, least in {"max_latents": 1, "corrections": 0, "pixels": 64}.items():
            check_whole(name, getattr(self, name), least)

    @staticmethod
    def field(**changes: Any) -> UpliftConfig:
        """At most 50,000 Gaussians; `changes` are other options. With 30,000, room_0 loses 0.2 to 0.5 mIoU, the toy room 1.3."""
        return UpliftConfig(**({"max_gaussians": 50_000} | changes))


def uplift_maps(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    maps: FeatureMaps,  # C maps [h, w, D]
    config: UpliftConfig | None = None,
    *,
    latents: LinearLatents | None = None,
    generator: torch.Generator | None = None,
    scratch: Path | None = None,
    progress: bool = False,
) -> SemanticField:
    """Average feature maps onto Gaussians by rendering weight, correct for blending, and keep few linear latents.

    Only the directions of features matter. No classes are used, so the result answers any text. Each map is read once for
    the average and, for at most 32 views, once before to find the working directions. Memory holds 2 x [N, 65] numbers; the
    maps in the working directions, at most 20 MB each, are in files.

    Args:
        gaussians: any cloud in the cameras' frame; its colours and features are not used.
        cameras: C posed cameras without distortion.
        maps: one per camera, covering its picture at any size; all-zero features mean "unknown".
        config: see `UpliftConfig`.
        latents: those of other fields (`sample_latents`), with which these shall agree; None: fitted to this scene.
        generator: draws the first centres of merging; None: seed 0.
        scratch: a folder for these files, used for these maps only; files of a killed process are used again. The caller
            deletes it. None: a temporary folder.
        progress: show a bar.

    Returns:
        A field with a `Linear` decoder. Latents are all-zero where no view shows the Gaussian. `info["explained"]` has
        two shares of the maps' variation: what fields of half of the views explain in views of the other half, and in their
        own. `info["note"]` warns if the Gaussians fill little of the views.

    Raises:
        ValueError: if counts or shapes disagree, `write_splats` would refuse the Gaussians, a map is not finite, no map has
            features, or no view shows any Gaussian.
    """
    config, progress, cameras = config or UpliftConfig(), as_bar(progress), as_cameras(cameras)
    if (count := len(cameras)) == 0 or count != len(maps):
        got = f"{len(maps)}; pass the views that have maps"
        raise ValueError(f"maps: expected one per camera ({count}, at least one), got {got}")
    if len(gaussians) == 0:
        raise ValueError("gaussians: expected at least one, got none; there is nothing to carry features to")
    cloud = gaussians.replace(sh=None, features=None, labels=None, scores=None, names=(), extra={}).detach()
    check_splats(cloud)
    cloud = cloud.to(torch.promote_types(cloud.means.dtype, torch.float32))
    passes = 1 + config.corrections + (config.max_gaussians is not None and config.corrections > 0)
    bar = tqdm(total=count * passes, desc="uplift", unit="view", disable=not progress)
    with torch.no_grad(), bar, tempfile.TemporaryDirectory(prefix="kfgs_") as temporary:
        directions = (sample_latents(maps) if latents is None else latents).basis.to(cloud.means)
        views = WorkingMaps(cameras, maps, directions, config.pixels, scratch or Path(temporary))
        sums, shown = sum_views(cloud, views, bar)
        filled = float(shown.sum()) / sum(camera.width * camera.height for camera in cameras)
        if filled == 0:
            raise ValueError("cameras: expected views that show the Gaussians, got none; do both share one frame?")
        if latents is None:
            rows, weights = unit_rows(per_weight(sums.sum(0))), cap(shown, shown[shown > 0])
            fitted = fit_linear_latents(rows, weights, keep=config.keep, maximum=config.max_latents).basis
            views.basis = fitted
            sums = torch.cat([sums[..., :-1] @ fitted, sums[..., -1:]], dim=-1)
            latents = LinearLatents((directions.double() @ fitted.double()).to(directions))
        for _ in range(config.corrections):
            sums = correct(cloud, sums, views, bar)
        if config.max_gaussians is not None:
            cloud = cloud.replace(features=per_weight(sums.sum(0)))
            merged = merge_gaussians(cloud, shown, config.max_gaussians, generator=generator)
            cloud, sums = merged.gaussians, torch.stack([merged.pool(half) for half in sums])
            if config.corrections:
                sums = correct(cloud, sums, views, bar)
        info: dict[str, Any] = {"explained": explained_shares(cloud, sums, views)}
    note = f"the Gaussians fill {filled:.0%} of the views; are they in the cameras' frame?"
    info |= {"note": note} if filled < SPARSE else {}
    fused = cloud.replace(features=per_weight(sums.sum(0)))
    return SemanticField(fused, Linear(latents.basis), tuple(cameras), info=info)


def sum_views(cloud: Gaussians, views: WorkingMaps, bar: Any) -> tuple[Tensor, Tensor]:  # [2, N, d' + 1], [N]
    """The sums of features, and the number of pixels that each Gaussian fills."""
    channels, shown = views.directions.shape[1], torch.zeros_like(cloud.opacities)
    sums = cloud.means.new_zeros(2, len(cloud), channels + 1)
    for i in range(len(views)):
        view, half = views[i], sums[i % 2]
        index, total, filled = sum_pixels(cloud, view.camera, _known(view.map, view.camera.size))
        half.index_add_(0, index, total)
        shown.index_add_(0, index, view.scale * filled * (total[:, -1] > 0))  # not where nothing is known
        bar.update()
    return sums, shown


def correct(cloud: Gaussians, sums: Tensor, views: WorkingMaps, bar: Any) -> Tensor:  # sums: [2, N, d + 1]
    """One pass of SIRT: correct each Gaussian's feature by the weighted mean of the difference at its pixels, without noise.

    The even and the odd views make one reconstruction each. Signal is the part of the two corrections that agrees among
    neighbours (`reliability`); both take the reliable share. Returns the corrected sums.
    """
    halves, lacking = per_weight(sums), torch.zeros_like(sums)
    for i in range(len(views)):
        view = views[i]
        projected = project(cloud, view.camera)
        tiles = bin_tiles(projected, view.camera.width, view.camera.height)
        splats = projected.means2d, projected.conics, projected.opacities
        rendered, alpha = composite(*splats, halves[i % 2], tiles, index=projected.index)
        covered = shrink_map(alpha[..., None], view.factor)  # the rest of the pixel is empty: no Gaussian explains it
        difference = covered * view.map - shrink_map(rendered, view.factor)
        total, _ = accumulate_pixels(*splats, _known(difference, view.camera.size), tiles)
        lacking[i % 2].index_add_(0, projected.index, total)
        bar.update()
    corrections, weights = per_weight(lacking), sums[..., -1:]
    places = cloud.means.cpu().double().numpy()
    near = cKDTree(places).query(places, k=[*range(1, min(NEIGHBOURS, len(places)) + 1)], workers=-1)[1]
    nearest = torch.from_numpy(np.asarray(near)).to(cloud.means.device)
    share = reliability(corrections[0], corrections[1], nearest)[:, None]
    return torch.cat([(halves + share * corrections) * weights, weights], dim=-1)


def explained_shares(cloud: Gaussians, sums: Tensor, views: WorkingMaps) -> list[float]:
    """Shares of some views' variation, as far as latents keep it, that the other half of the views explains, and their own."""
    halves, lost, whole = per_weight(sums), torch.zeros(2, dtype=torch.float64), EPS
    for i in range(0, len(views), -(-len(views) // LEFT_OUT) | 1):  # an odd step: of both halves
        view = views[i]
        rendering = rasterize(cloud.replace(features=torch.cat([halves[1 - i % 2], halves[i % 2]], 1)), view.camera)
        known, covered = ~view.map[..., 0].isnan(), shrink_map(rendering.alpha[..., None], view.factor)
        shown, said = shrink_map(rendering.map, view.factor)[known], (covered * view.map)[known]
        whole += float((said - covered[known] * view.map[known].mean(0)).square().sum())
        lost += (shown.unflatten(1, (2, -1)) - said[:, None]).square().sum(dim=(0, 2)).double().cpu()
    return (1 - lost / whole).clamp(min=0).tolist()  # type: ignore[no-any-return]


def reliability(first: Tensor, second: Tensor, near: Tensor) -> Tensor:  # [N, d] x 2, [N, k] -> [N] in [0, 1]
    """The share of signal in the mean of two independent estimates: 2 r / (1 + r), the Spearman-Brown formula.

    r is the common part of the estimates, sum of products over mean sum of squares, over a Gaussian and its neighbours.
    Negative values become 0; so do those of Gaussians that one half of the views does not show.
    """
    products = (first * second).sum(1)[near].sum(1)
    squares = (first.square().sum(1) + second.square().sum(1))[near].sum(1) / 2
    r = divide_sums(products, squares).clamp(0, 1)
    return 2 * r / (1 + r)


def per_weight(sums: Tensor) -> Tensor:  # [..., d + 1] -> [..., d]
    """Means of sums whose last column is the weight; 0 without weight."""
    return divide_sums(sums[..., :-1], sums[..., -1:])


def _known(signal: Tensor, size: tuple[int, int]) -> Tensor:  # [h, w, c] -> [H, W, c + 1]
    """A map in a camera's size times how much each pixel counts, and this as the last channel: 0 if unknown, see `BORDER`."""
    known = ~signal[..., :1].isnan()
    down, across = (torch.minimum(at, 1 - at) for at in ((torch.arange(n) + 0.5) / n for n in size))
    trust = (torch.minimum(down[:, None], across) / BORDER).clamp(LEAST, 1)[..., None].to(signal)
    return (resize_map(torch.cat([torch.where(known, signal, 0), known.to(signal)], dim=-1), size) * trust).contiguous()


def fuse_views(field: SemanticField, cameras: Sequence[Camera]) -> SemanticField:
    """Render a trained field from its training cameras, quantise the pixels, and average them onto the Gaussians they show.

    The result is the field with these `cameras` and the averages as `fused`. A field with a `Linear` decoder is fused
    already, and gets the cameras alone. Without a codebook, rendered features are averaged without quantising.
    """
    cameras = as_cameras(cameras, "pass those that the field was trained with")
    decoder, gaussians = field.decoder, field.gaussians
    if isinstance(decoder, Linear):
        return replace(field, cameras=tuple(cameras))
    with torch.no_grad():
        book = decoder.codebook if isinstance(decoder, Codewords | Autoencoded) else None
        rows, weights = (unit_rows(field.latents), gaussians.opacities) if book is None else (book.unit, None)
        latents = fit_linear_latents(rows, weights, keep=KEEP, maximum=MOST)
        table = torch.nn.functional.pad(latents.encode(rows), (0, 0, 0, 1)).to(gaussians.means)  # nothing known: zeros

        def show(camera: Camera) -> tuple[Camera, Tensor]:  # [H, W, e]
            factor = min(1.0, (PIXELS / (camera.width * camera.height)) ** 0.5)
            small = camera.resized(max(1, round(camera.height * factor)), max(1, round(camera.width * factor)))
            pixels, alpha, _ = rasterize(gaussians, small)
            if isinstance(decoder, Codewords | Autoencoded):
                return small, table[decoder.codewords(pixels, alpha > 0)]
            return small, latents.encode(unit_rows(pixels)) * (row_norms(pixels) > EPS)[..., None]

        means = average_views(gaussians, map(show, cameras)).values
    fused = SemanticField(gaussians.replace(features=means), Linear(latents.basis))
    return replace(field, cameras=tuple(cameras), fused=fused)


def join_fields(fields: Sequence[SemanticField]) -> SemanticField:
    """Fused fields with the same linear latents (`sample_latents`) as one; views that several fields have are kept once."""
    first, bases = fields[0], [part.decoder.to_tensors()["linear.basis"] for part in fields]
    if not all(torch.equal(basis, bases[0]) for basis in bases):
        raise ValueError("fields: expected some with the same latents, got others; fit with one `sample_latents`")
    cameras = {camera.name: camera for part in fields for camera in part.cameras}
    views = list(dict.fromkeys(name for part in fields for name in part.info.get("views", ())))
    return replace(
        first,
        gaussians=Gaussians.cat([part.gaussians.with_origin(first.gaussians.origin) for part in fields]),
        cameras=tuple(cameras.values()),
        info={name: value for name, value in first.info.items() if name != "explained"} | {"views": views},
    )
