"""Checkpoints of gsplat (`ckpt_29999_rank0.pt`) and of nerfstudio's splatfacto (`step-000029999.ckpt`), read only.

Both hold raw values: scales are logarithms, opacities logits, quaternions (w, x, y, z). gsplat's are in `splats`: means,
scales, quats, opacities, sh0, shN. Nerfstudio's are in `pipeline`, under names that end in `gauss_params.means` (older ones:
`_model.means`) and so on; its colours are features_dc and features_rest, and without the latter logits of colours.

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

from .._arrays import FileError, plain_tensor, read_torch, reading
from .._files import read_json
from ..cameras.similarity import Similarity
from ..gaussians import Gaussians
from ..splat.transform import transform_gaussians
from .render_mode import Mode, with_mode
from .values import SH_C0, positive_scales, up_to_degree_3

NAME = "checkpoint"
SUFFIXES = (".pt", ".ckpt")
FRAME = "dataparser_transforms.json"
SETTINGS = ("config.yml", "cfg.yml")
_EXPECTED = "a checkpoint of gsplat (with 'splats') or of nerfstudio's splatfacto (with 'pipeline')"


def matches(head: bytes) -> bool:
    """A zip file whose first entry is a pickle, as torch writes them."""
    name = head[30 : 30 + int.from_bytes(head[26:28], "little")]
    return head.startswith(b"PK\x03\x04") and name.endswith(b"/data.pkl")


def read(path: Path) -> Gaussians:
    """Read the Gaussians of a checkpoint; optimisers and networks in it are skipped.

    Of gsplat, the files of all ranks of the step are joined.
    """
    top = read_torch(path, _EXPECTED)
    content = top if isinstance(top, dict) else {}
    if "splats" in content:
        parts = [_gsplat(file, content if file == path else read_torch(file, _EXPECTED)) for file in _ranks(path)]
        return with_mode(path, Gaussians.cat(parts), _mode(path))
    if "pipeline" in content:
        return with_mode(path, _undo_frame(path, _splatfacto(path, content["pipeline"])), _mode(path))
    got = f"one with {', '.join(map(str, list(content)[:5]))}" if content else type(top).__name__
    raise FileError(f"{path}: expected {_EXPECTED}, got {got:.200}; name another file")


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
        raise ValueError(f"expected the files of ranks 0 to {numbers[-1]} next to it, got {numbers}; copy them all")
    return [path.with_name(f"{match[1]}{number}{match[3]}") for number in numbers]


def _gsplat(path: Path, top: dict[str, Any]) -> Gaussians:
    splats = top["splats"]
    if "sh0" not in splats and "features" in splats:
        raise ValueError(
            "its colours are features for a network (app_opt), not harmonics (sh0, shN); export a PLY with gsplat "
            "(--save_ply), or train without app_opt"
        )
    return _cloud(path, splats, splats["sh0"], splats.get("shN"))


def _splatfacto(path: Path, state: dict[str, Any]) -> Gaussians:
    prefixes = {name.removesuffix("means") for name in state if re.search(r"(gauss_params|_model)\.means$", name)}
    if len(prefixes) != 1:
        raise ValueError(
            f"it has {len(prefixes)} sets of Gaussians of splatfacto (_model.gauss_params.means, ...), not one: is it of "
            "another method?"
        )
    (prefix,) = prefixes
    values = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
    dc, rest = values["features_dc"], values.get("features_rest")
    dc = dc if dc.ndim == 3 else dc[:, None]
    if rest is None or rest.shape[1] == 0:  # trained without harmonics
        dc, rest = (dc.sigmoid() - 0.5) / SH_C0, None
    return _cloud(path, values, dc, rest)


def _cloud(path: Path, values: dict[str, Any], dc: Tensor, rest: Tensor | None) -> Gaussians:
    """The Gaussians of raw values; broken ones stay until `read_splats`, and places may be far from zero."""
    raw = {name: values[name] for name in ("means", "quats", "scales", "opacities")} | {"sh0": dc}
    raw |= {} if rest is None else {"shN": rest}
    wide = {"means": torch.float64}
    raw = {name: plain_tensor(path, name, v, wide.get(name, torch.float32)) for name, v in raw.items()}
    N = len(raw["means"])
    if raw["opacities"].numel() != N:
        shapes = ", ".join(f"{name} {list(value.shape)}" for name, value in raw.items())
        raise ValueError(f"its {N} Gaussians (from means) have values of other shapes: {shapes}")
    return Gaussians(
        raw["means"],
        raw["quats"],
        positive_scales(raw["scales"].exp().numpy()),
        raw["opacities"].reshape(N).sigmoid(),
        sh=up_to_degree_3(path, torch.cat([raw[name] for name in ("sh0", "shN") if name in raw], 1)),
    )


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
