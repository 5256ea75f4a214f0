"""Checkpoints of gsplat (`ckpt_29999_rank0.pt`) and of nerfstudio's splatfacto (`step-000029999.ckpt`), read only.

Both hold raw values: scales are logarithms, opacities logits, quaternions (w, x, y, z). gsplat's are in `splats`: means,
scales, quats, opacities, sh0, shN. Nerfstudio's are in `pipeline`, under names that end in `gauss_params.means` (older ones:
`_model.means`) and so on. Its colours are features_dc and features_rest; without the latter they are logits of colours. This
is what the programs' own code writes; no file by the programs was at hand.

**Frame**: nerfstudio trains in a frame of its own, x' = scale (R x + t), and writes it to `dataparser_transforms.json` in the
folder above the checkpoint; it is undone here. The result is the frame of the data before its `applied_transform`, if
transforms.json has one: that of COLMAP. gsplat's trainer normalises the scene, too, and does not write the frame anywhere.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._arrays import reading
from .._files import read_json
from .._notes import tell
from .._torch_files import plain_tensor, read_torch
from ..cameras.similarity import Similarity
from ..gaussians import Gaussians
from ..splat.transform import transform_gaussians
from .render_mode import Mode, with_mode
from .values import NO_DEGREE_4, SH_C0, positive_scales

NAME = "checkpoint"
SUFFIXES = (".pt", ".ckpt")
HOLDS_LABELS = False
FRAME = "dataparser_transforms.json"
SETTINGS = ("config.yml", "cfg.yml")
_EXPECTED = "a checkpoint of gsplat (with 'splats') or of nerfstudio's splatfacto (with 'pipeline')"
_NAMES = ("means", "scales", "quats", "opacities")


def matches(head: bytes) -> bool:
    """A zip file whose first entry is a pickle, as torch writes them."""
    return head.startswith(b"PK\x03\x04") and head[30 : 30 + int.from_bytes(head[26:28], "little")].endswith(
        b"/data.pkl"
    )


def read(path: Path) -> Gaussians:
    """Read the Gaussians of a checkpoint; optimisers and networks in it are skipped.

    Of gsplat, the files of all ranks of the step are joined.

    Raises:
        ValueError: if it is something else, damaged, or its colours come from a network (gsplat's `app_opt`); or if
            `dataparser_transforms.json` is damaged.
    """
    top = read_torch(path, _EXPECTED)
    content = top if isinstance(top, dict) else {}
    if isinstance(content.get("splats"), dict):
        files = _ranks(path)
        parts = [_gsplat(file, content if file == path else read_torch(file, _EXPECTED)) for file in files]
        _tell_dropped(path, content["splats"])
        return with_mode(path, Gaussians.cat(parts), _mode(path))
    if isinstance(content.get("pipeline"), dict):
        _tell_dropped(path, content["pipeline"])
        return with_mode(path, _undo_frame(path, _splatfacto(path, content["pipeline"])), _mode(path))
    got = f"one with {', '.join(map(str, list(content)[:5]))}" if content else type(top).__name__
    raise ValueError(f"{path}: expected {_EXPECTED}, got {got:.200}; name another file")


def _mode(path: Path) -> Mode:
    """What the settings of the training say, which nerfstudio (config.yml) and gsplat (cfg.yml) keep above the checkpoints."""
    places = [path.parent.parent / name for name in SETTINGS] + [path.parent / name for name in SETTINGS]
    text = next((file.read_text("utf-8", "replace") for file in places if file.is_file()), "").lower()
    keys = "rasterize_mode|antialiased|model_type|with_ut|with_eval3d"
    said = dict(re.findall(rf"^ *({keys}): *'?([\w-]+)", text, re.MULTILINE))
    unknown = tuple(f"{key}: true" for key in ("with_ut", "with_eval3d") if said.get(key) == "true")  # 3DGUT
    antialiased = said.get("rasterize_mode") == "antialiased" or said.get("antialiased") == "true"
    return Mode(antialiased, said.get("model_type", "").startswith("2dgs"), unknown)


def _ranks(path: Path) -> list[Path]:
    """The files of all processes that trained together, in order of their numbers."""
    match = re.fullmatch(r"(.*_rank)(\d+)(\.pt)", path.name)
    if match is None:
        return [path]
    ranks = (re.fullmatch(re.escape(match[1]) + r"(\d+)\.pt", file.name) for file in path.parent.glob("*.pt"))
    numbers = sorted(int(rank[1]) for rank in ranks if rank)
    if numbers != list(range(len(numbers))):
        raise ValueError(
            f"{path}: expected the files of ranks 0 to {numbers[-1]} next to it, got {numbers}; copy them all"
        )
    return [path.with_name(f"{match[1]}{number}{match[3]}") for number in numbers]


def _gsplat(path: Path, top: Any) -> Gaussians:
    splats = top.get("splats") if isinstance(top, dict) else None
    if not isinstance(splats, dict):
        raise ValueError(f"{path}: expected {_EXPECTED}, got another file; copy the checkpoints again")
    if "sh0" not in splats and "features" in splats:
        raise ValueError(
            f"{path}: expected colours as spherical harmonics (sh0, shN), got features for a network (app_opt); export a PLY "
            "with gsplat (--save_ply), or train without app_opt"
        )
    raw = {name: _raw(path, name, splats.get(name)) for name in (*_NAMES, "sh0")}
    rest = _raw(path, "shN", splats["shN"]) if "shN" in splats else raw["sh0"][:, :0]
    return _cloud(path, raw, raw["sh0"], rest)


def _splatfacto(path: Path, state: dict[Any, Any]) -> Gaussians:
    prefixes = {
        str(name).removesuffix("means") for name in state if re.search(r"(gauss_params|_model)\.means$", str(name))
    }
    if len(prefixes) != 1:
        raise ValueError(
            f"{path}: expected the Gaussians of splatfacto (_model.gauss_params.means, ...), got {len(prefixes)} sets; "
            "is this a checkpoint of another method?"
        )
    (prefix,) = prefixes
    raw = {name: _raw(path, prefix + name, state.get(prefix + name)) for name in (*_NAMES, "features_dc")}
    dc = raw["features_dc"] if raw["features_dc"].ndim == 3 else raw["features_dc"][:, None]
    rest = (
        _raw(path, "features_rest", state[f"{prefix}features_rest"]) if f"{prefix}features_rest" in state else dc[:, :0]
    )
    if rest.ndim == 3 and rest.shape[1] == 0:  # trained without harmonics
        dc = (dc.sigmoid() - 0.5) / SH_C0
    return _cloud(path, raw, dc, rest)


def _raw(path: Path, name: str, value: object) -> Tensor:
    """A tensor of a file; broken Gaussians stay until `read_splats`, and places may be far from zero."""
    return plain_tensor(path, name, value, torch.float64 if name.endswith("means") else torch.float32, finite=False)


def _cloud(path: Path, raw: dict[str, Tensor], dc: Tensor, rest: Tensor) -> Gaussians:
    """The Gaussians of raw values; a ValueError if shapes disagree."""
    N = len(raw["means"])
    with reading(path, f"values of {N} Gaussians (from means)"):
        if list(dc.shape) != [N, 1, 3] or rest.shape[1] not in (0, 3, 8, 15, 24) or raw["opacities"].numel() != N:
            shapes = ", ".join(f"{name} {list(value.shape)}" for name, value in (raw | {"rest": rest}).items())
            raise ValueError(shapes)
        return Gaussians(
            raw["means"],
            raw["quats"],
            positive_scales(path, raw["scales"].exp().numpy()),
            raw["opacities"].reshape(N).sigmoid(),
            sh=torch.cat([dc, rest], 1)[:, :16],
        )


def _tell_dropped(path: Path, values: dict[Any, Any]) -> None:
    rest = [value for name, value in values.items() if str(name).endswith(("shN", "features_rest"))]
    if any(getattr(value, "shape", ())[1:] == (24, 3) for value in rest):
        tell(f"{path.name}: {NO_DEGREE_4}")


def _undo_frame(path: Path, cloud: Gaussians) -> Gaussians:
    """The Gaussians in the frame of the data, before its `applied_transform`; in nerfstudio's own if its file is missing."""
    file = next((place / FRAME for place in (path.parent.parent, path.parent) if (place / FRAME).is_file()), None)
    if file is None:
        warnings.warn(
            f"{path}: no {FRAME} in the folder above, so the Gaussians stay in nerfstudio's own frame, which is not that of the "
            "scene; copy that file from the run to its place",
            stacklevel=4,
        )
        return cloud
    with reading(file, "a rigid 'transform' [3][4] and a 'scale' above 0"):
        content = read_json(file)
        rows, scale = torch.tensor(content["transform"], dtype=torch.float64), float(content["scale"])
        if rows.shape not in ((3, 4), (4, 4)) or not scale > 0:
            raise ValueError(f"{list(rows.shape)} and {scale}")
        data_from_run = Similarity(scale, rows[:3, :3], scale * rows[:3, 3]).inverse()
    return transform_gaussians(cloud, data_from_run)
