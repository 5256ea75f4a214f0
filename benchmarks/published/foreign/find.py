"""Find out which program made a result, and read it."""

from __future__ import annotations

from pathlib import Path

from kfgs._files import as_path

from .feature3dgs import load_feature3dgs
from .langsplat import has_levels, level_runs, load_langsplat, load_langsplat_v2, load_occam
from .legaussians import load_legaussians_field
from .splat_features import load_splat_features
from .splatted import SplattedMethod

LAYOUTS = (
    "point_cloud/iteration_N/point_cloud.ply (Feature 3DGS), index_decoder_chkpntN.pth (LEGaussians), chkpntN_langfeat_1.pth "
    "(Occam's LGS), chkpntN.pth (LangSplat; LangSplatV2), or a splat file with features"
)


def load_foreign(path: str | Path, with_file: str | Path | None = None) -> SplattedMethod:
    """Read a result of another program; its files say which one it is.

    LangSplat and LangSplatV2 have checkpoints of one name: with an autoencoder it is LangSplat, without it LangSplatV2.

    Args:
        path: the folder of a run, what three runs have in common (`output/figurines` for `figurines_1`, `_2`, `_3`), a
            checkpoint, or a splat file.
        with_file: LangSplat's autoencoder, LEGaussians' codebook, Feature 3DGS's decoder, or features of a splat.

    Raises:
        FileNotFoundError: if there is nothing, or a second file is needed and missing.
        ValueError: if no program is recognised, or a file is damaged.
    """
    path = as_path(path)
    run = path if path.exists() else level_runs(path)[0]
    if not run.exists():
        raise FileNotFoundError(f"{path}: no such file or folder; expected a result: {LAYOUTS}")
    if path.is_file() and path.suffix not in (".pth", ".pt"):
        return _read_splats(path, with_file)
    if _has(path, "index_decoder_chkpnt*.pth"):
        if with_file is None:
            raise FileNotFoundError(
                f"with_file: expected the codebook of {path} (LEGaussians), got none; name the file"
            )
        return load_legaussians_field(path, with_file)
    if _has(path, "chkpnt*_langfeat_*.pth") or (path.is_file() and "_langfeat_" in path.name):
        _refuse(with_file, "Occam's LGS")
        return load_occam(path)
    if _has(path, "point_cloud/iteration_*/point_cloud.ply"):
        try:
            return load_feature3dgs(path, decoder=with_file)
        except ValueError as error:  # other programs write such a PLY too, without these columns
            if "semantic_0" not in str(error) or not (_has(path, "chkpnt*.pth") or has_levels(path)):
                raise
    if path.is_file() or _has(run, "chkpnt*.pth") or run != path or has_levels(path):
        return _read_langsplat(path, with_file)
    raise ValueError(f"{path}: expected a result of a known program, got a folder without one; known are {LAYOUTS}")


def _read_splats(path: Path, with_file: str | Path | None) -> SplattedMethod:
    try:
        return load_splat_features(path, with_file)
    except ValueError as error:
        if with_file is not None or "expected columns" not in str(error):
            raise
        message, _, _ = str(error).partition("; ")
        raise ValueError(f"{message}; name the file with its features as with_file, or give a field") from error


def _read_langsplat(path: Path, with_file: str | Path | None) -> SplattedMethod:
    if with_file is not None:
        return load_langsplat(path, with_file)
    try:
        return load_langsplat_v2(path)
    except ValueError as error:
        raise ValueError(f"{error}; if it is LangSplat's, name its autoencoder (best_ckpt.pth) as with_file") from error


def _has(folder: Path, pattern: str) -> bool:
    return folder.is_dir() and next(folder.glob(pattern), None) is not None


def _refuse(with_file: str | Path | None, program: str) -> None:
    if with_file is not None:
        raise ValueError(f"with_file: expected none with {program}, got {with_file}; leave it out")
