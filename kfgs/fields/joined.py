"""A part of a field, and several fields with the same latents as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from .._typed import typed
from ..gaussians import Gaussians
from .answers import Seen
from .semantic_field import SemanticField


@typed
def select_gaussians(field: SemanticField, which: Tensor) -> SemanticField:  # which: [N] bool or [n] int64
    """A field of some of its Gaussians, with all that is known about them."""
    answers = None if field.answers is None else field.answers[which]
    seen = None if field.seen is None else Seen(*(values[which] for values in field.seen))
    return replace(field, gaussians=field.gaussians.select(which), answers=answers, seen=seen)


@typed
def join_fields(fields: Sequence[SemanticField]) -> SemanticField:
    """Fused fields with the same linear latents as one field; views that several fields have are kept once.

    Raises:
        ValueError: if there is no field, or one was not fused, or has other latents than the first.
    """
    if not fields:
        raise ValueError("fields: expected at least one, got none")
    first = fields[0]
    for i, field in enumerate(fields):
        if field.method != "fused" or field.linear is None or first.linear is None or field.seen is None:
            raise ValueError(f"fields[{i}]: expected a fused field, got {field.method!r}; fit it with method 'fuse'")
        if not torch.equal(field.linear.basis, first.linear.basis):
            raise ValueError(
                f"fields[{i}]: expected the latents of fields[0], got others; fit both with the same ones (`sample_latents`)"
            )
    cameras = {camera.name: camera for field in fields for camera in field.cameras}
    seen = Seen(*(torch.cat(values) for values in zip(*(field.seen for field in fields if field.seen), strict=True)))
    views = list(dict.fromkeys(name for field in fields for name in field.info.get("views", ())))
    return replace(
        first,
        gaussians=Gaussians.cat([field.gaussians.with_origin(first.gaussians.origin) for field in fields]),
        seen=seen,
        cameras=tuple(cameras.values()),
        info=first.info | {"views": views},
    )
