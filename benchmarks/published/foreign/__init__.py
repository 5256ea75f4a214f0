"""Fields of other programs, read as data and scored by the same protocols. Nothing in their files is run.

No sample of these programs could be had. What a value means (its length, its activation, how it is decoded) is from
baselines.md, read in their code. Where it lies in a file is mostly our reading; each module says which is which.
"""

from .feature3dgs import load_feature3dgs
from .find import load_foreign
from .langsplat import load_langsplat, load_langsplat_v2, load_occam
from .legaussians import load_legaussians_field
from .splat_features import load_splat_features
from .splatted import Level, SplattedMethod

__all__ = [
    "Level",
    "SplattedMethod",
    "load_feature3dgs",
    "load_foreign",
    "load_langsplat",
    "load_langsplat_v2",
    "load_legaussians_field",
    "load_occam",
    "load_splat_features",
]
