"""Join two clouds, which may differ in colour degree, classes and columns."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from torch import Tensor

from ..._typed import typed
from ...formats.splat_file import SplatFile
from ...gaussians import Gaussians

_ALWAYS = ("means", "quats", "scales", "opacities")


@typed
def join(first: SplatFile, second: SplatFile) -> SplatFile:
    """The Gaussians of two clouds, the first before the second; dtype, device, `info` and rendering are those of the first.

    - Spherical harmonics: the lower degree is padded with zeros, which changes no colour.
    - Labels: classes with the same name are the same class. If the first cloud has the name twice, the lowest label is
      used. New names that occur are added after those of the first. A class without a name is called `class 7` if the
      other cloud has names; if neither has names, indices are kept.
    - If one cloud lacks them: labels become -1 (none), features 0, extra columns 0.

    Raises:
        ValueError: if one has colours and the other has none, or their features have different channels.
    """
    a, b = first.gaussians, second.gaussians.with_origin(first.gaussians.origin)
    sh = _joined_sh(a.sh, b.sh)
    features = _joined_features(a, b)
    labels, classes = _joined_labels(first, second)
    rows = {name: torch.cat([getattr(a, name), getattr(b, name).to(a.means)]) for name in _ALWAYS}
    extra = {}
    for name in first.extra | second.extra:
        columns = [splats.extra.get(name) for splats in (first, second)]
        dtype = np.result_type(*[column for column in columns if column is not None])
        filled = [
            np.zeros(len(splats), dtype) if column is None else column
            for splats, column in zip((first, second), columns, strict=True)
        ]
        extra[name] = np.concatenate(filled)
    if a.antialiased != b.antialiased:
        how = ("fainter", "with") if a.antialiased else ("more opaque", "without")
        warnings.warn(
            f"insert: what is smaller than a pixel looks {how[0]} than in its own file: all is drawn {how[1]} antialiasing, as "
            "the scene is",
            stacklevel=2,
        )
    gaussians = a.replace(**rows, sh=sh, features=features, labels=labels)
    return SplatFile(gaussians, extra, classes, first.info)


def _joined_sh(a: Tensor | None, b: Tensor | None) -> Tensor | None:
    if a is None and b is None:
        return None
    if a is None or b is None:
        which = "the scene" if a is None else "what is inserted"
        raise ValueError(
            f"sh: expected colours in both clouds, got none in {which}; choose one with colours (in Python: or add them with "
            "gaussians.replace())"
        )
    count = max(a.shape[1], b.shape[1])
    return torch.cat([torch.nn.functional.pad(sh.to(a), (0, 0, 0, count - sh.shape[1])) for sh in (a, b)])


def _joined_features(a: Gaussians, b: Gaussians) -> Tensor | None:
    given = [cloud.features for cloud in (a, b) if cloud.features is not None]
    if not given:
        return None
    channels = {features.shape[1] for features in given}
    if len(channels) > 1:
        raise ValueError(
            f"features: expected as many channels in both clouds, got {given[0].shape[1]} and {given[1].shape[1]}; "
            "insert a splat without features (in Python: drop one side's with gaussians.replace(features=None))"
        )
    width = channels.pop()
    parts = [a.means.new_zeros(len(c), width) if c.features is None else c.features.to(a.means) for c in (a, b)]
    return torch.cat(parts)


def _joined_labels(first: SplatFile, second: SplatFile) -> tuple[Tensor | None, tuple[str, ...]]:
    a, b = first.gaussians.labels, second.gaussians.labels
    if a is None and b is None:
        return None, first.classes
    device = first.gaussians.means.device
    old = torch.full((len(first),), -1, device=device) if a is None else a
    new = torch.full((len(second),), -1, device=device) if b is None else b.to(device)
    if not first.classes and not second.classes:
        return torch.cat([old, new]), ()
    highest = int(old.max()) if len(old) else -1
    classes = [class_name(first.classes, i) for i in range(max(len(first.classes), highest + 1))]
    renamed = new.clone()
    for label in torch.unique(new[new >= 0]).tolist():
        name = class_name(second.classes, label)
        if name not in classes:
            classes.append(name)
        renamed[new == label] = classes.index(name)
    return torch.cat([old, renamed]), tuple(classes)


def class_name(classes: tuple[str, ...], index: int) -> str:
    """The name of a class; one without a name is called `class 7`."""
    return classes[index] if index < len(classes) else f"class {index}"
