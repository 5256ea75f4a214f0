"""The kind of rendering that a cloud was trained for: antialiased, or as flat surfels. The Gaussians do not show it.

`info["antialiased"]` (true or false): trained with the filter of Mip-Splatting, so a renderer that widens a Gaussian on the
screen must lower its opacity in proportion; otherwise small Gaussians are too opaque. `info["surfels"]` (true): trained as
2D Gaussians. If the file does not say, `info` has neither.

- PLY and compressed PLY, in comments: `SplatRenderMode: default`, `mip` or `2dgs` (Brush), `antialiased 1` or `0` and
  `postshot.anti_aliasing=1` or `0` (Postshot);
- SOG, in `meta.json`: `"antialias": true` (the specification), `"model": "antialiased"` or `"2dgs"` (splat-transform);
- SPZ: a flag for antialiased, no place for surfels.

Other formats store neither.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

ANTIALIASED, SURFELS = "antialiased", "surfels"
_MODES: dict[str, dict[str, bool]] = {
    "default": {ANTIALIASED: False},
    "mip": {ANTIALIASED: True},
    "2dgs": {SURFELS: True},
}
_FLAGS = {"0": "default", "1": "mip"}
_MODELS = {"default": "default", "antialiased": "mip", "2dgs": "2dgs"}
_WORDS = {ANTIALIASED: "antialiased rendering", SURFELS: "rendering as surfels (2DGS)"}


def mode_from_comments(comments: Iterable[str]) -> dict[str, bool]:
    """Read the mode from the comments of a PLY header, for `info`. The last one counts, as in Brush."""
    said: dict[str, bool] = {}
    for comment in comments:
        words = comment.lower().replace("=", " ").split()
        if len(words) != 2:
            continue
        key, value = words
        if key in ("antialiased", "postshot.anti_aliasing"):
            value = _FLAGS.get(value, "")
        elif key != "splatrendermode:":
            continue
        said = _MODES.get(value, said)
    return dict(said)


def comments_of_mode(info: Mapping[str, Any]) -> tuple[str, ...]:
    """Comments for a PLY header, in the words of Brush and of Postshot; none if `info` does not say."""
    if info.get(SURFELS):
        return ("SplatRenderMode: 2dgs",)
    if info.get(ANTIALIASED) is None:
        return ()
    return (
        ("SplatRenderMode: mip", "antialiased 1")
        if info[ANTIALIASED]
        else ("SplatRenderMode: default", "antialiased 0")
    )


def mode_from_meta(meta: Mapping[str, Any]) -> dict[str, bool]:
    """Read the mode from the `meta.json` of a SOG scene, for `info`; `model` has priority over `antialias`."""
    model = meta.get("model")
    if isinstance(model, str) and model in _MODELS:
        return dict(_MODES[_MODELS[model]])
    antialias = meta.get("antialias")
    return {ANTIALIASED: antialias} if isinstance(antialias, bool) else {}


def meta_of_mode(info: Mapping[str, Any]) -> dict[str, Any]:
    """Keys for the `meta.json` of a SOG scene; none if `info` does not say."""
    if info.get(SURFELS):
        return {"model": "2dgs"}
    if info.get(ANTIALIASED) is None:
        return {}
    return {"antialias": True, "model": "antialiased"} if info[ANTIALIASED] else {"antialias": False}


def describe_lost_mode(info: Mapping[str, Any], name: str, holds: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Describe the parts of the mode that a format cannot store."""
    return tuple(
        f"{words}: {name} has no place for it" for key, words in _WORDS.items() if info.get(key) and key not in holds
    )
