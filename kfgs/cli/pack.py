"""The command pack: a field in a small file."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro

from .._files import check_output
from .files import open_field
from .options import Classes, GivenPrecision, Positional
from .output import say, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

UNITS = {
    "gaussians.means": "world units a coordinate",
    "gaussians.quats": "degrees",
    "gaussians.scales": "of a scale, and as much of twice the error of a coordinate",
    "seen.pixels": "of a count, and as much of a pixel",
}
"""What the error of a tensor is measured in. Opacities, latents and agreement have their own numbers, the others shares."""
PLAIN = ("gaussians.opacities", "gaussians.features", "fused.latents", "seen.agreement")
Scores = Annotated[tuple[Path, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="FILE")]


def pack(
    field: Positional[Path],
    out: Positional[Path],
    *,
    precision: GivenPrecision = None,
    scores: Scores = (),
    classes: Classes,
) -> None:
    """Write a field again: small, with the errors that you allow, and with other words if you name some.

    Examples:
        kfgs pack run/ room.kfgs
        kfgs pack run/ room.kfgs --precision fine --scores scores.json
        kfgs pack run/ room.kfgs --text words.safetensors    # other words than the scene's

    Args:
        field: A field (RUN/field.kfgs, or the run folder).
        out: A file whose name ends in .kfgs.
        precision: lossless; fine (labels hardly change); small (the default: 0.6 MB for 50,000 Gaussians); tiny. The
            errors of each are printed, and kept in the file. All but lossless sort the Gaussians.
        scores: What `kfgs evaluate --out` wrote about this field: its scores travel in the file. Can be given several times.
    """
    from ..fields.store import check_place
    from ..labels.questions import class_rows

    classes.check_images()
    check_output("out", out, "a file")
    check_place(out)
    opened = open_field("field", field)
    if any(given is not None for given in (classes.scene, classes.classes, classes.text)):
        words = classes.load_classes()
        class_rows(words, opened.dim, opened.info)  # of the field's teacher
        opened = dataclasses.replace(opened, classes=words)
    if scores:
        kept = [*_listed(opened.info.get("scores")), *(_read_scores(path) for path in scores)]
        opened = dataclasses.replace(opened, info={**opened.info, "scores": kept})
    precision = precision or "small"
    opened.save(out, None if precision == "lossless" else precision)
    if precision != "lossless":
        _tell(out)
    wrote([out])


def _tell(out: Path) -> None:
    """The bytes and the error of each part of a packed field, read back from its file."""
    from ..fields.store import read_description, stream_sizes

    about = read_description(out)
    errors = about["info"]["rounded"][-1]["errors"]
    for name, size in stream_sizes(out).items():
        say(f"  {name:<32s} {size:>10,d} bytes  {_error_in_words(name, errors.get(name))}".rstrip())
    say(f"{about['gaussians']:,} Gaussians in {out.stat().st_size / 2**20:.2f} MiB")
    say("note: neighbours now lie side by side (Morton order), so indices into the old field do not fit the new one")


def _error_in_words(name: str, error: float | None) -> str:
    if error is None:
        return ""
    if name in PLAIN:
        return f"within {error:.3g}"
    return (
        f"within {error:.3g} {UNITS[name]}"
        if name in UNITS
        else f"within {100 * error:.2g} % of a row's typical number"
    )


def _read_scores(path: Path) -> dict[str, Any]:
    """A report's scores, protocol, options and machine, without its rows."""
    from .._files import read_json

    report = read_json(path)
    names = ("protocol", "scores", "options", "machine")
    if not isinstance(report, dict) or not all(name in report for name in names):
        raise ValueError(
            f"{path}: expected a report in JSON, got something else; give what `kfgs evaluate --out` wrote"
        )
    return {name: report[name] for name in names}


def _listed(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list) else []
