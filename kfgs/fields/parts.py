"""Helpers of `SemanticField`: check that its parts fit together, and label views."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from .._check import as_tensor, check_shapes
from ..cameras import Camera
from ..gaussians import Gaussians
from ..labels import LOGIT_SCALES, CodewordLabels, label_pixels
from ..labels.questions import Classes
from ..quant import Autoencoder, Codebook, LinearLatents
from ..splat import Rendering, rasterize

CHUNK = 8192  # latents decoded at once: the decoder's widest layer then holds 32 MB


def check_parts(
    gaussians: Gaussians,
    codebook: Codebook | None,
    autoencoder: Autoencoder | None,
    linear: LinearLatents | None,
    answers: Tensor | None,  # [N, e]
) -> None:
    """Raise a ValueError unless these parts fit together; they are those of `SemanticField`."""
    features = gaussians.features
    if features is None:
        raise ValueError("gaussians: expected features [N, d], got None; fit them with fit_field")
    if autoencoder is not None and codebook is None:
        raise ValueError("codebook: expected the one that the autoencoder was fitted to, got None; pass it as well")
    if linear is None and answers is not None:
        raise ValueError("linear: expected what the answers stand for, got None; pass it as well")
    if linear is not None:
        name, own = ("gaussians.features", features) if answers is None else ("answers", answers)
        check_shapes(("gaussians.means", gaussians.means, "N 3"), (name, own, ("N", linear.latent)))
        if answers is None and codebook is not None:
            raise ValueError("codebook: expected none for linear latents, got one; pass answers, or leave linear out")
    if codebook is None:
        return
    if autoencoder is not None and autoencoder.dim != codebook.dim:
        raise ValueError(
            f"autoencoder: expected {codebook.dim} decoded channels (from codebook), got {autoencoder.dim}; "
            "pass the autoencoder that was fitted to this codebook"
        )
    expected, channels = codebook.dim if autoencoder is None else autoencoder.latent, features.shape[1]
    if expected != channels:
        raise ValueError(
            f"gaussians: expected {expected} features each (from the codebook's latents), got {channels}; "
            "pass the codebook and autoencoder that this field was fitted with"
        )


def checked_classes(classes: Classes) -> Classes:
    """Return classes unchanged, an array or a list of rows as a tensor; a single name is an error."""
    if isinstance(classes, str):
        raise TypeError(
            f"classes: expected a LabelSet or embeddings [C, D], got the name {classes!r}; query({classes!r}) finds the "
            "Gaussians of one class"
        )
    rows = isinstance(classes, list | tuple) and not any(
        isinstance(one, str) for one in classes
    )  # names: see class_rows
    return as_tensor("classes", classes, floating=True) if rows or isinstance(classes, np.ndarray) else classes


def teacher_name(info: dict[str, Any]) -> str | None:
    """The name of the teacher in a field's `info`; None if unknown."""
    teacher = info.get("teacher")
    return str(teacher.get("name")) if isinstance(teacher, dict) else None


def info_lines(info: dict[str, Any]) -> list[str]:
    """A field's `info` for people, a line per entry; lists and dictionaries are left out."""
    teacher = teacher_name(info)
    lines = [] if teacher is None else [f"  teacher: {teacher}"]
    return [*lines, *(f"  {name}: {value}" for name, value in info.items() if not isinstance(value, list | dict))]


def blend_votes(
    gaussians: Gaussians,
    camera: Camera,
    cosines: Tensor,  # [N, C]
    known: Tensor,  # [N] bool
) -> Tensor:  # [H, W] int64
    """The class with most votes at each pixel: each Gaussian divides one vote, and votes are blended like colours."""
    with torch.no_grad():
        winners = cosines.argmax(dim=1)[known].unique()  # a class that no Gaussian prefers wins no pixel
        if len(winners) == 0:
            return torch.full(camera.size, -1, dtype=torch.int64, device=cosines.device)
        votes = torch.softmax(LOGIT_SCALES["clip"] * cosines[:, winners], dim=1) * known[:, None]
        blended = rasterize(gaussians.replace(features=votes.contiguous(), sh=None), camera).map
        most, index = blended.max(dim=-1)
        return winners[index].masked_fill(most <= 0, -1)


def label_rendered(
    rendering: Rendering,
    decode: Callable[[Tensor], Tensor],
    unit: Tensor,  # [C, D] unit rows
) -> Tensor:  # [H, W] int64
    """The class that is most similar to each pixel's decoded feature; -1 for empty pixels."""
    pixels = [decode(part) for part in rendering.map.flatten(0, 1).split(CHUNK)]
    found = torch.cat([(part @ unit.T).max(dim=1).indices.masked_fill(~part.any(dim=1), -1) for part in pixels])
    return found.view(rendering.alpha.shape).masked_fill(rendering.alpha <= 0, -1)


def label_latents(
    rendering: Rendering,
    codebook: Codebook,
    labels: CodewordLabels,
    autoencoder: Autoencoder | None,
    *,
    exact: bool,
) -> Tensor:  # [H, W] int64
    """The class of each pixel's codeword: of the decoded latent (`exact`), or the codeword with the nearest latent."""
    decode: Literal["exact", "latent"] = "exact" if exact else "latent"
    covered = rendering.alpha > 0
    return label_pixels(rendering.map, codebook, labels, autoencoder, decode=decode, covered=covered)
