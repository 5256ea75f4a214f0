"""Protocols that papers published, ground truth of their data sets, and results of other programs. No part of the package.

`PROTOCOLS` has kfgs's own and these; each has the members that `kfgs.evaluation.protocols` describes.
"""

from typing import Any

from kfgs.evaluation.protocols import PROTOCOLS as OWN

from .legaussians_masks import LEGaussiansMasks
from .lerf_2d import LerfOvs2D
from .lerf_3d import LerfOvs3D
from .ovs3d import OVS3DClosed, OVS3DStability, OVS3DThreshold
from .scannet_points import ScanNetPoints
from .scannet_volume import ScanNetVolume
from .scenesplat import SceneSplatBench

_TYPES: tuple[Any, ...] = (
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
PROTOCOLS: dict[str, Any] = OWN | {protocol.name: protocol for protocol in _TYPES}
"""Frozen dataclasses by `name`; their fields are options, with the published behaviour as default. `docs/protocols.md`."""
