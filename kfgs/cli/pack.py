"""The command pack: a field folder to one small file, and back."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro

from .._files import check_output
from .files import check_alone, open_field
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
PLAIN = ("gaussians.opacities", "gaussians.features", "answers.latents", "seen.agreement")
Scores = Annotated[tuple[Path, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="FILE")]


def pack(
    field: Positional[Path],
    out: Positional[Path],
    *,
    precision: GivenPrecision = None,
    scores: Scores = (),
    classes: Classes,
) -> None:
    """Put a field into one small file with its classes and cameras, or such a file back into a folder.

    Every command that takes a field folder takes the file as well.

    Examples:
        kfgs pack run/field room.kfgs.safetensors
        kfgs pack run/field room.kfgs.safetensors --precision fine --scores scores.json
        kfgs pack run/field room.kfgs.safetensors --text words.safetensors    # other words than the scene's
        kfgs pack room.kfgs.safetensors field/

    Args:
        field: A field folder (RUN/field), or a field in one file.
        out: A file whose name ends in .kfgs.safetensors; any other name is a folder.
        precision: lossless; fine (labels hardly change); small (the default: 0.6 MB for 50,000 Gaussians); tiny. The
            errors of each are printed, and kept in the file. All but lossless sort the Gaussians.
        scores: What `kfgs evaluate --out` wrote about this field: its scores travel in the file. Can be given several times.
    """
    from ..fields.store import SUFFIX, check_place, describes_field, holds_field
    from ..labels.questions import class_rows

    classes.check_images()
    single = out.name.endswith(SUFFIX)
    check_output("out", out, "a file" if single else "a folder")
    check_place(out)
    if not single:
        check_alone("precision", precision, f"for a folder, which keeps every bit; a file ends in {SUFFIX}")
    opened = open_field("field", field)
    if any(given is not None for given in (classes.scene, classes.classes, classes.text)):
        words = classes.load_classes()
        class_rows(words, opened.dim, opened.info)  # of the field's teacher
        opened = dataclasses.replace(opened, words=words)
    if scores:
        kept = [*_listed(opened.info.get("scores")), *(_read_scores(path) for path in scores)]
        opened = dataclasses.replace(opened, info={**opened.info, "scores": kept})
    if (
        not single and describes_field(out) and not holds_field(out, vars(opened))
    ):  # of a run, perhaps: it may have cost hours
        raise ValueError(
            f"out: expected a new folder, got {out}, which holds another field; give another name, or rename that one"
        )
    opened.save(out, (precision or "small") if single else None)
    if single:
        _tell(out, opened)
    wrote([out])


def _tell(out: Path, before: Any) -> None:
    """The bytes and the error of each part of a packed field, read back from its file."""
    from ..fields import SemanticField
    from ..fields.container import stream_sizes

    after = SemanticField.load(out)
    noted = _listed(after.info.get("rounded"))
    new = len(noted) > len(_listed(before.info.get("rounded")))
    errors = noted[-1]["errors"] if new else {}
    for name, size in stream_sizes(out.read_bytes()).items():
        say(f"  {name:<32s} {size:>10,d} bytes  {_error_in_words(name, errors.get(name))}".rstrip())
    say(f"{len(after):,} Gaussians in {out.stat().st_size / 2**20:.2f} MiB")
    if new:
        say(
            "note: neighbours now lie side by side (Morton order), so indices into the old field do not fit the new one"
        )
    if before.has_classes and after.words is None:
        say("note: without classes, whose files are gone or have changed; pass --text or --scene to put them in")


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
