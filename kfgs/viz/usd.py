"""Clouds as USD scenes, with an object for each class."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .._check import as_array
from .._files import as_path, atomic_path
from .._typed import typed
from ..formats.splat_file import SplatFile
from ..gaussians import Gaussians
from ..splat.sh import sh0_to_rgb

SUFFIXES = (".usdc", ".usda", ".usd")


@typed
def save_usd(path: str | Path, cloud: Gaussians | SplatFile, *, points: bool = False) -> None:
    """Write a cloud as a USD scene: below `/splat` one object for each class, so that classes can be hidden or moved.

    The objects are `ParticleField3DGaussianSplat`, which OpenUSD knows since 26.03; or, for programs that do not know it,
    `Points` in their base colour, as wide as two mean standard deviations. Each object has the primvar `class_id` (a number
    per Gaussian) and the attribute `kfgs:class`, the name of its class. Axes and units stay those of the scene.

    Args:
        path: the file: .usdc (binary), .usda (text) or .usd (binary).
        cloud: Gaussians or a splat with colours.
        points: write points instead of Gaussians.

    Raises:
        ImportError: if usd-core is not installed.
        ValueError: if the name has another ending, or the cloud has no colours.
    """
    try:
        from pxr import Sdf, Usd, UsdGeom
    except ImportError as error:
        raise ImportError(f"save_usd: expected usd-core ({error}); run: pip install 'usd-core>=26.3'") from error
    path, splats = as_path(path), SplatFile(cloud) if isinstance(cloud, Gaussians) else cloud
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"path: expected a name that ends in {', '.join(SUFFIXES)}, got {path.name!r}; rename it")
    if splats.gaussians.sh is None:
        raise ValueError(f"cloud: expected colours (sh [N, K, 3]), got {splats!r}; pass a colour splat")
    stage = Usd.Stage.CreateInMemory()
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/splat").GetPrim())
    for label, part in ({-1: splats} if splats.gaussians.labels is None else splats.by_class()).items():
        place = f"/splat/class_{label}" if label >= 0 else "/splat/no_class"
        shape = (_add_points if points else _add_gaussians)(stage, place, part.gaussians.detach())
        name = splats.classes[label] if 0 <= label < len(splats.classes) else ""
        shape.GetPrim().CreateAttribute("kfgs:class", Sdf.ValueTypeNames.String).Set(name)
        primvar = UsdGeom.PrimvarsAPI(shape).CreatePrimvar(
            "class_id", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.vertex
        )
        primvar.Set(np.full(len(part), label, np.int32))
    with atomic_path(path) as temporary:
        stage.GetRootLayer().Export(str(temporary))


def _add_points(stage: Any, place: str, g: Gaussians) -> Any:
    from pxr import UsdGeom

    assert g.sh is not None
    shape = UsdGeom.Points.Define(stage, place)
    shape.CreatePointsAttr(_floats(g.means))
    shape.CreateWidthsAttr(2 * _floats(g.scales).mean(axis=1))
    shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(_floats(sh0_to_rgb(g.sh[:, 0]).clamp(0, 1)))
    return shape


def _add_gaussians(stage: Any, place: str, g: Gaussians) -> Any:
    from pxr import UsdVol, Vt

    assert g.sh is not None
    quats = _floats(g.quats / g.quats.norm(dim=1, keepdim=True))
    shape = UsdVol.ParticleField3DGaussianSplat.Define(stage, place)
    shape.CreatePositionsAttr(_floats(g.means))
    shape.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(quats[:, [1, 2, 3, 0]].copy()))  # from x, y, z, w
    shape.CreateScalesAttr(_floats(g.scales))
    shape.CreateOpacitiesAttr(_floats(g.opacities))
    shape.CreateRadianceSphericalHarmonicsDegreeAttr(int(g.sh.shape[1] ** 0.5) - 1)
    shape.CreateRadianceSphericalHarmonicsCoefficientsAttr(_floats(g.sh.flatten(0, 1)))  # Gaussian by Gaussian
    return shape


def _floats(values: Any) -> Any:  # float32
    return np.ascontiguousarray(as_array(values), dtype=np.float32)
