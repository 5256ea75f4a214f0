"""Clouds as USD scenes, with an object for each class."""

from __future__ import annotations

import errno
import os
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from .._check import as_array
from .._files import as_path, atomic_path
from .._typed import typed
from ..formats.render_mode import describe_lost_mode
from ..formats.splat_file import SCORE, SplatFile, Written
from ..formats.table import USD
from ..formats.values import check_splats, describe_loss
from ..gaussians import Gaussians
from ..splat.sh import sh0_to_rgb


def check_usd_core(path: Path) -> None:
    """Raise an ImportError, which names the file to write, unless usd-core is installed."""
    try:
        import_module("pxr")
    except ImportError as error:
        raise ImportError(
            f"{path}: expected usd-core to write USD ({error}); run: pip install 'usd-core>=26.3'"
        ) from error


@typed
def save_usd(path: str | Path, cloud: Gaussians | SplatFile, *, points: bool = False) -> Written:
    """Write a cloud as a USD scene: below `/splat` one object for each class, so that classes can be hidden or moved.

    The objects are `ParticleField3DGaussianSplat`, which OpenUSD knows since 26.03; or, for programs that do not know it,
    `Points` in their base colour, as wide as two mean standard deviations. Each object has the primvars `class_id` and, if
    known, `score` (a number per Gaussian), and the attribute `kfgs:class`, the name of its class; it is called after that, with
    `_` for what USD does not allow (`office_chair`), or `unlabelled`.

    **Convention**: coordinates stay as they are; the origin of a cloud far from zero is the translation of `/splat`. The file
    says that a unit is a metre (`metersPerUnit` 1) and that z is up (`upAxis`), as kfgs assumes if no cameras tell; without
    these, USD means centimetres and y.

    Args:
        path: the file: .usdc (binary), .usda (text), .usd (binary) or .usdz (a .usdc in an uncompressed zip file).
        cloud: Gaussians or a splat with colours.
        points: write points instead of Gaussians.

    Returns:
        The file, and what it could not store.

    Raises:
        ImportError: if usd-core is not installed.
        ValueError: if the name has another ending, the cloud has no colours, or a value cannot be stored (see
            `write_splats`). Nothing is written then.
    """
    path, splats = as_path(path), SplatFile(cloud) if isinstance(cloud, Gaussians) else cloud
    check_usd_core(path)
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdUtils

    if path.suffix.lower() not in USD:
        raise ValueError(f"path: expected a name that ends in {', '.join(USD)}, got {path.name!r}; rename it")
    if splats.gaussians.sh is None:
        raise ValueError(f"cloud: expected colours (sh [N, K, 3]), got {splats!r}; pass a colour splat")
    check_splats(splats)
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    whole = UsdGeom.Xform.Define(stage, "/splat")
    if any(splats.gaussians.origin):
        whole.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*splats.gaussians.origin))
    stage.SetDefaultPrim(whole.GetPrim())
    for label, part in ({-1: splats} if splats.gaussians.labels is None else splats.by_class()).items():
        name = splats.classes[label] if 0 <= label < len(splats.classes) else ""
        place = _place(stage, label, name)
        shape = (_add_points if points else _add_gaussians)(stage, place, part.gaussians.detach())
        shape.GetPrim().CreateAttribute("kfgs:class", Sdf.ValueTypeNames.String).Set(name)
        numbers = {"class_id": (Sdf.ValueTypeNames.IntArray, np.full(len(part), label, np.int32))}
        if SCORE in part.extra:
            numbers[SCORE] = (Sdf.ValueTypeNames.FloatArray, _floats(part.extra[SCORE]))
        for key, (kind, values) in numbers.items():
            UsdGeom.PrimvarsAPI(shape).CreatePrimvar(key, kind, UsdGeom.Tokens.vertex).Set(values)
    with atomic_path(path) as temporary:
        packed = path.suffix.lower() == ".usdz"
        layer = temporary.with_suffix(".usdc") if packed else temporary
        try:
            stage.GetRootLayer().Export(str(layer))
            if packed:
                UsdUtils.CreateNewUsdzPackage(str(layer), str(temporary))
        except RuntimeError as error:  # of USD: the system's words are somewhere in several lines
            code = next(
                (
                    code
                    for code in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
                    if os.strerror(code) in str(error)
                ),
                errno.EIO,
            )
            raise OSError(code, os.strerror(code)) from error
    lost = describe_loss(splats, path.suffix, 3) + describe_lost_mode(splats, path.suffix)
    flat = ("shapes, opacities and harmonics of the Gaussians: points are round and opaque",) if points else ()
    return Written([path], lost + flat, None)


def _place(stage: Any, label: int, name: str) -> str:
    """A free path with the name of a class (`office_chair`); its number follows if the path is taken or no letter is left."""
    from pxr import Tf

    word = Tf.MakeValidIdentifier(name) if label >= 0 else "unlabelled"
    nameless = not word.strip("_")
    word = "class" if nameless else word
    endings = (f"_{label}" * times for times in count(int(nameless)))
    return next(place for ending in endings if not stage.GetPrimAtPath(place := f"/splat/{word}{ending}"))


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
