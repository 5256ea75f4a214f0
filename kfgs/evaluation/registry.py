"""All protocols by name."""

from __future__ import annotations

import difflib
from dataclasses import fields
from typing import Any

from .legaussians_masks import LEGaussiansMasks
from .lerf_2d import LerfOvs2D
from .lerf_3d import LerfOvs3D
from .ovs3d import OVS3DClosed, OVS3DStability, OVS3DThreshold
from .own import KfgsColor, KfgsPooled, KfgsRecolor, KfgsRemoval, KfgsSurface
from .scannet_points import ScanNetPoints
from .scannet_volume import ScanNetVolume
from .scenesplat import SceneSplatBench
from .teacher_agreement import TeacherAgreement

_TYPES: tuple[Any, ...] = (
    KfgsPooled,
    KfgsSurface,
    KfgsColor,
    KfgsRemoval,
    KfgsRecolor,
    TeacherAgreement,
    LerfOvs2D,
    LerfOvs3D,
    LEGaussiansMasks,
    ScanNetPoints,
    ScanNetVolume,
    OVS3DClosed,
    OVS3DThreshold,
    OVS3DStability,
    SceneSplatBench,
)
PROTOCOLS: dict[str, type] = {protocol.name: protocol for protocol in _TYPES}
"""Frozen dataclasses by `name`; their fields are options, with the published behaviour as default. `docs/protocols.md`."""


def get_protocol(name: str, **options: Any) -> Any:
    """A protocol by its name, with or without its version: "lerf-ovs-2d/1", "lerf-ovs-2d".

    Args:
        name: one of `PROTOCOLS`.
        options: of that protocol; what is left out is as published.

    Raises:
        ValueError: if there is no such protocol or version; the message names the nearest ones.
        TypeError: if the protocol has no such option; the message names those it has.

    Example:
        >>> get_protocol("lerf-ovs-2d", threshold=0.5).threshold
        0.5
    """
    named = (one for key, one in PROTOCOLS.items() if name in (key, key.partition("/")[0]))
    found: Any = next(named, None)
    if found is None:
        near = difflib.get_close_matches(name, PROTOCOLS, n=3, cutoff=0.4)
        hint = f"; did you mean {' or '.join(near)}?" if near else ""
        raise ValueError(f"protocol: expected one of {', '.join(PROTOCOLS)}, got {name!r}{hint}")
    known = [option.name for option in fields(found)]
    if unknown := [option for option in options if option not in known]:
        raise TypeError(
            f"protocol {name!r}: expected options among {', '.join(known)}, got {', '.join(unknown)}; leave them out"
        )
    return found(**options)
