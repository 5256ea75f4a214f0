"""Find the newest splat in the output folder of a training program.

Inria's 3DGS and its descendants write `point_cloud/iteration_30000/point_cloud.ply`, gsplat's trainer
`ckpts/ckpt_29999_rank0.pt`, nerfstudio `nerfstudio_models/step-000029999.ckpt`.
"""

from __future__ import annotations

import re
from pathlib import Path

from .._files import as_path

PATTERNS = (  # * is the step
    "point_cloud/iteration_*/point_cloud.ply",
    "ckpts/ckpt_*_rank0.pt",
    "nerfstudio_models/step-*.ckpt",
)


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """The files of a pattern with one `*`, by the whole number in its place."""
    before, after = pattern.split("*")
    found = {}
    for file in folder.glob(pattern) if folder.is_dir() else ():
        match = re.fullmatch(re.escape(before) + r"(\d{1,18})" + re.escape(after), file.relative_to(folder).as_posix())
        if match and file.is_file():
            found[int(match[1])] = file
    return found


def newest_splat(folder: Path) -> Path | None:
    """The splat of the highest step in the output folder of a training program; None if this is no such folder."""
    for pattern in PATTERNS:
        files = numbered_files(folder, pattern)
        if files:
            return files[max(files)]
    return None


def splat_file_of(path: str | Path) -> Path:
    """The path itself; of the output folder of a training program, its newest splat."""
    path = as_path(path)
    return newest_splat(path) or path if path.is_dir() else path
