"""CF3 (ICCV 2025): features lifted to a colour cloud, squeezed to 3 numbers, and the cloud merged to a twentieth.

From the paper's description; its code was not seen, and the rounds of merging are ours. Lift; drop the 0.01 % of the Gaussians
whose views disagree most; fit an autoencoder of the Gaussians' features to 3 latents. Then, in rounds: prune what shows little,
merge neighbours with like features by moments, and train against renderings of the latents before merging.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import mse_loss

from kfgs._rows import row_norms, unit_rows
from kfgs.cameras import Camera
from kfgs.fields import Training, UpliftConfig, fit_field, uplift_maps
from kfgs.gaussians import Gaussians
from kfgs.metrics import semantic_storage_bytes
from kfgs.quant.autoencoder import quick_on_a_cpu
from kfgs.splat import rasterize
from kfgs.splat.covariance import covariance_3d
from kfgs.splat.views import sum_pixels

from .common import Clock, Fitted, Task, seeded, within
from .langsplat import Autoencoder
from .methods import RenderedMethod

WIDTHS = 128, 64, 32, 16, 3
VARIANCE_SHARE = 1e-4  # of the Gaussians, dropped for the variance of their features over the views
CHI_SQUARE = 7.81  # 95 % quantile for 3 dimensions
NEIGHBOURS = 8


@dataclass(frozen=True)
class CF3Config:
    """3,000 steps after the colours, or fewer."""

    epochs: int = 30
    """Of the autoencoder, over the Gaussians' features."""
    batch: int = 1_024
    rate: float = 1e-3
    rounds: int = 6
    """Of pruning and merging; each can halve the cloud."""
    steps: int = 3_000
    """Of training, in all rounds together."""
    like: float = 0.9
    """Least cosine of two features that may merge (tau)."""
    faint: float = 0.002
    """Share of all contribution that the Gaussians hold which a round prunes."""
    pixels: int | None = None

    @staticmethod
    def published() -> CF3Config:
        """3,000 steps at the pictures' size."""
        return CF3Config()

    @staticmethod
    def short() -> CF3Config:
        """For two cores: 12 epochs, 480 steps of 40,000 pixels."""
        return CF3Config(epochs=12, steps=480, pixels=40_000)

    @staticmethod
    def medium() -> CF3Config:
        """For an hour: all 30 epochs, 2,400 steps of 80,000 pixels."""
        return CF3Config(steps=2_400, pixels=80_000)


def structure_loss(latents: Tensor, features: Tensor) -> Tensor:  # [n, 3], [n, D] unit rows -> []
    """Cosines between pairs of latents follow those between their features: the mean squared difference."""
    return mse_loss(latents @ latents.T, features @ features.T)


def fit_autoencoder(rows: Tensor, config: CF3Config, seed: int) -> Autoencoder:  # [n, D] unit rows
    """Mean squared error, cosine and structure, on the features of Gaussians."""
    generator = torch.Generator().manual_seed(seed)
    with seeded(seed):
        network = Autoencoder(rows.shape[1], WIDTHS, WIDTHS[-2::-1])
    optimizer = torch.optim.Adam(network.parameters(), lr=config.rate)
    for _ in range(config.epochs):
        for batch in torch.randperm(len(rows), generator=generator).split(config.batch):
            if len(batch) == 1:
                continue  # batch normalisation needs two rows
            wanted = rows[batch]
            latents = network.encode(wanted)
            out = network.features(latents)
            loss = mse_loss(out, wanted) + 1 - (out * wanted).sum(1).mean() + structure_loss(latents, wanted)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
    return network.eval().requires_grad_(False)


def merge_pairs(cloud: Gaussians, weights: Tensor, pairs: Tensor) -> Gaussians:  # [N], [P, 2] int64, no index twice
    """Each pair becomes one Gaussian with its mean and covariance, by weight; all others stay as they are.

    Opacity and features are weighted means. The merged ones come last.
    """
    assert cloud.features is not None
    rest = torch.ones(len(cloud), dtype=torch.bool)
    rest[pairs.flatten()] = False
    share = weights[pairs].double()  # [P, 2]
    share = share / share.sum(dim=1, keepdim=True)
    places = cloud.means.double()[pairs]  # [P, 2, 3]
    means = (share[..., None] * places).sum(1)
    away = places - means[:, None]
    own = covariance_3d(cloud.quats, cloud.scales).double()[pairs]
    covariances = (share[..., None, None] * (own + away[..., :, None] * away[..., None, :])).sum(1)
    variances, axes = torch.linalg.eigh(covariances)
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]  # a rotation, not a reflection
    smallest = torch.finfo(torch.float32).eps * variances[:, 2:]
    merged = Gaussians(
        means.to(cloud.means),
        rotation_matrix_to_quaternion(axes.contiguous()).to(cloud.means),
        torch.maximum(variances, smallest).sqrt().to(cloud.means),
        (share * cloud.opacities.double()[pairs]).sum(1).to(cloud.means),
        features=(share[..., None] * cloud.features.double()[pairs]).sum(1).to(cloud.means),
    )
    return Gaussians.cat([cloud.select(rest), merged])


def find_pairs(cloud: Gaussians, like: float, allowed: Tensor) -> Tensor:  # [N] bool -> [P, 2] int64
    """Neighbours that may merge, no Gaussian twice: like features, and one centre within the 95 % ellipsoid of the other.

    Of all candidates the nearest pairs are taken first; two of one pair must find each other.
    """
    assert cloud.features is not None
    places = cloud.means.double().numpy()
    count = min(NEIGHBOURS, len(places) - 1)
    if count < 1:
        return torch.zeros(0, 2, dtype=torch.int64)
    near = torch.from_numpy(np.asarray(cKDTree(places).query(places, k=[*range(2, count + 2)], workers=-1)[1]))
    first = torch.arange(len(places))[:, None].expand_as(near)
    unit = unit_rows(cloud.features)
    inverse = torch.linalg.inv(covariance_3d(cloud.quats, cloud.scales).double() + 1e-12 * torch.eye(3).double())
    away = cloud.means.double()[near] - cloud.means.double()[:, None]  # [N, k, 3]
    squares = [torch.einsum("nki,nkij,nkj->nk", away, inverse[index], away) for index in (first, near)]
    fits = (unit[first] * unit[near]).sum(-1) > like
    fits &= torch.minimum(*squares) < CHI_SQUARE
    fits &= allowed[first] & allowed[near]
    cost = torch.where(fits, away.square().sum(-1), torch.inf)
    best, column = cost.min(dim=1)
    partner = near.gather(1, column[:, None])[:, 0]
    mutual = (
        (best < torch.inf) & (partner[partner] == torch.arange(len(partner))) & (partner > torch.arange(len(partner)))
    )
    one = mutual.nonzero()[:, 0]
    return torch.stack([one, partner[one]], dim=1)


def contributions(cloud: Gaussians, cameras: list[Camera]) -> Tensor:  # [N]
    """The sum of T alpha over the pixels of all views."""
    total = torch.zeros(len(cloud))
    for camera in cameras:
        index, _, weight = sum_pixels(cloud, camera, torch.ones(camera.height, camera.width, 1))
        total.index_add_(0, index, weight)
    return total


def positional_gradient(cloud: Gaussians, cameras: list[Camera], targets: list[Tensor]) -> Tensor:  # [N]
    """The length of the gradient of the L1 loss by each mean, over some views."""
    means = cloud.means.clone().requires_grad_()
    for camera, target in zip(cameras, targets, strict=True):
        (rasterize(cloud.replace(means=means), camera).map - target).abs().mean().backward()
    return torch.linalg.vector_norm(means.grad, dim=1)


def brightest(total: Tensor, faint: float) -> Tensor:  # [N] -> [N] bool
    """All but the faintest, which together hold a share of the whole."""
    order = total.argsort()
    below = torch.zeros_like(total, dtype=torch.bool)
    below[order] = total[order].double().cumsum(0) <= faint * total.double().sum()
    return ~below


def fit(task: Task, config: CF3Config) -> Fitted:
    """Lift, squeeze, merge and train; the result has Gaussians of its own."""
    clock, options = Clock(), UpliftConfig(corrections=0)
    cameras = [within(camera, config.pixels) for camera in task.cameras]
    with clock.stage("lift"):
        found = uplift_maps(task.frozen, task.cameras, task.maps, options, generator=task.generator())
        seen = found.known
        agreement = row_norms(found.latents).where(seen, 2.0)  # the length of a mean of unit features
        dropped = agreement.argsort()[: int(VARIANCE_SHARE * int(seen.sum()))]
        seen[dropped] = False
        lifted = found.gaussians.select(seen)
    with clock.stage("autoencoder"):
        assert lifted.features is not None
        rows = unit_rows(found.decoder.decode(lifted.features))
        with quick_on_a_cpu():
            network = fit_autoencoder(rows, config, task.seed)
        with torch.no_grad():
            latents = torch.cat([network.encode(part) for part in rows.split(16_384)])
        cloud = lifted.replace(features=latents)
        with torch.no_grad():
            targets = [rasterize(cloud, camera).map for camera in cameras]
        extent = float((cloud.means - cloud.means.mean(0)).norm(dim=1).quantile(0.9))
    history = []
    for turn in range(config.rounds):
        with clock.stage("merge"):
            total = contributions(cloud, cameras)
            bright = brightest(total, config.faint)
            cloud, total = cloud.select(bright), total[bright]
            some = slice(turn % 4, None, 4)
            moved = positional_gradient(cloud, cameras[some], targets[some])
            allowed = moved <= moved.quantile(0.8) if len(moved) < 2**24 else moved <= moved.median()
            cloud = merge_pairs(cloud, total, find_pairs(cloud, config.like, allowed))
        with clock.stage("train"):
            fitted = fit_field(
                cloud, cameras, targets,
                Training(steps=max(1, config.steps // config.rounds), densify=None, extent=extent),
                generator=torch.Generator().manual_seed(task.seed + turn), progress=task.progress,
            )  # fmt: skip
            cloud = fitted.gaussians
        history.append(fitted.history[-1] | {"round": turn + 1, "count": len(cloud)})
    parameters = network.decoder_parameters
    tensors = {name: getattr(cloud, name) for name in ("means", "quats", "scales", "opacities", "features")}
    tensors |= {f"decoder.{name}": value for name, value in network.decoder.state_dict().items()}
    storage = semantic_storage_bytes(len(cloud), 3, parameters)
    method = RenderedMethod("CF3", cloud, network, torch.ones(len(cloud), dtype=torch.bool))
    return Fitted(method, "3", storage, tensors, clock.seconds, history, network.forward, own_geometry=True)
