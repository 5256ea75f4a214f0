"""Files of other programs' fields, written in the layouts of those programs, and what their methods must answer."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import nn

from kfgs.cameras import Camera
from kfgs.evaluation import Method, View
from kfgs.formats.ply import write_ply
from kfgs.gaussians import Gaussians
from kfgs.splat import rasterize

N, H, W, K = 12, 9, 11, 3
VIEW = View("a", Camera(torch.eye(4), torch.tensor([[10.0, 0, 5.5], [0, 10, 4.5], [0, 0, 1]]), W, H, "a.png"))


def random_rows(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed + 17 * len(shape) + shape[-1]))


def raw_values() -> dict[str, torch.Tensor]:
    return {
        "xyz": torch.cat([random_rows(N, 2) * 0.5, 2 + random_rows(N, 1).abs()], 1),
        "dc": random_rows(N, 1, 3),
        "rest": random_rows(N, 3, 3),
        "scales": -2 + 0.3 * random_rows(N, 3),
        "quats": random_rows(N, 4),
        "opacity": random_rows(N, 1),
    }


def splats_of(values: torch.Tensor, raw: dict[str, torch.Tensor] | None = None) -> Gaussians:
    """The Gaussians of `raw_values`, activated here by the definitions."""
    raw = raw or raw_values()
    return Gaussians(raw["xyz"], raw["quats"], raw["scales"].exp(), raw["opacity"][:, 0].sigmoid(), features=values)


def save_capture(path: Path, features: list[torch.Tensor], *, place: int = 6, raw: dict | None = None) -> Path:
    """A tuple in the order of the training scripts: SH degree, parameters, features, statistics, optimiser, extent."""
    raw = raw or raw_values()
    optimizer = torch.optim.Adam([nn.Parameter(torch.zeros(3))])
    values = [1, *(nn.Parameter(value) for value in raw.values())]
    values[place + 1 : place + 1] = [nn.Parameter(value) for value in features]
    values += [torch.zeros(N), torch.zeros(N, 1), torch.zeros(N, 1), optimizer.state_dict(), 5.0]
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save((tuple(values), 30000), path)
    return path


def cosines_of(features: np.ndarray, text: np.ndarray) -> np.ndarray:
    """Cosines by the definition, one by one; NaN for zeros."""
    flat, found = features.reshape(-1, features.shape[-1]).astype(np.float64), []
    for row in flat:
        length = np.sqrt(np.sum(row * row))
        found.append([np.nan if length == 0 else np.sum(row * t) / length / np.sqrt(np.sum(t * t)) for t in text])
    return np.array(found).reshape(*features.shape[:-1], len(text))


def rendered(values: torch.Tensor, raw: dict[str, torch.Tensor] | None = None) -> tuple[np.ndarray, np.ndarray]:
    rendering = rasterize(splats_of(values, raw), VIEW.camera, engine="reference")
    return rendering.map.double().numpy(), rendering.alpha.numpy() > 0


def check_method(
    method: Method, text: torch.Tensor, level: int, features: np.ndarray, seen: np.ndarray, own: np.ndarray
) -> None:
    """Against features [H, W, D] of pixels and `own` [N, D] of Gaussians."""
    expected = np.where(seen[..., None], cosines_of(features, text.double().numpy()), np.nan)
    np.testing.assert_allclose(method.cosines(VIEW, text)[level].numpy(), expected, atol=2e-5)
    expected = cosines_of(own, text.double().numpy())
    np.testing.assert_allclose(method.gaussian_cosines(text)[level].numpy(), expected, atol=2e-5)


def save_ply(path: Path, columns: dict[str, torch.Tensor], raw: dict[str, torch.Tensor] | None = None) -> Path:
    raw = raw or raw_values()
    table = {name: raw["xyz"][:, i] for i, name in enumerate("xyz")}
    table |= {name: torch.zeros(N) for name in ("nx", "ny", "nz")}
    table |= {f"f_dc_{i}": raw["dc"][:, 0, i] for i in range(3)}
    table |= {f"f_rest_{i}": raw["rest"].transpose(1, 2).flatten(1)[:, i] for i in range(9)}
    table |= {"opacity": raw["opacity"][:, 0]}
    table |= {f"scale_{i}": raw["scales"][:, i] for i in range(3)} | {f"rot_{i}": raw["quats"][:, i] for i in range(4)}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ply(path, {name: values.contiguous().numpy() for name, values in (table | columns).items()})
    return path


def columns_of(values: torch.Tensor, column: str = "semantic_") -> dict[str, torch.Tensor]:
    return {f"{column}{i}": values[:, i] for i in range(values.shape[1])}


def decoder_of(sizes: tuple[int, ...]) -> nn.Module:
    torch.manual_seed(1)
    layers: list[nn.Module] = []
    for i, (a, b) in enumerate(pairwise(sizes)):
        layers += [nn.ReLU()] * (i > 0) + [nn.Linear(a, b)]
    return nn.ModuleDict(
        {"encoder": nn.ModuleList([nn.Linear(9, 5), nn.BatchNorm1d(5)]), "decoder": nn.ModuleList(layers)}
    )


def save_legaussians(folder: Path) -> tuple[nn.ModuleDict, torch.Tensor]:
    torch.manual_seed(2)
    network = nn.ModuleDict({"conv1": nn.Conv2d(8, 6, 1), "conv2": nn.Conv2d(6, 7, 1), "conv3": nn.Conv2d(7, 5, 1)})
    codes = random_rows(5, 14)
    folder.mkdir(parents=True, exist_ok=True)
    torch.save(network.state_dict(), folder / "index_decoder_chkpnt30000.pth")
    torch.save({"embedding.weight": codes}, folder / "codebook.pt")
    return network, codes
