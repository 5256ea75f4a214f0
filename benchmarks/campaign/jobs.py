"""What is killed: every command of kfgs that writes, on a tiny scene, over older results and among files of the user."""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from .processes import Process, Work, command

NOTES = "mine: not of kfgs\n"


@dataclass(frozen=True)
class Job:
    """One command. Its current folder has `in/` (read only by it) and `work/`, where all its outputs are."""

    name: str
    work: Work
    prepare: Callable[[Path, Path], None]
    """Fill `work/` (second argument) from the fixture (first argument)."""
    fields: tuple[str, ...] = ()
    """Field folders in `work/`, which are compared by their reader: their files may be between old and new."""
    shown: tuple[str, ...] = ()
    """Files that may be missing between the old ones and the new ones: they show one field and are gone while it changes."""
    loose: tuple[str, ...] = ()
    """Endings of files whose bytes differ between two undisturbed runs, because they tell the time."""
    idle: bool = False
    """Whether a run that finds its result finished writes nothing."""
    resumed: bool = False
    """Whether a killed run goes on, so that files of its stages are reused."""


def make_fixture(folder: Path) -> None:
    """A room, a labelled splat, a field and a run, made by kfgs itself; raises if a command fails."""
    from kfgs.formats import write_splats

    from .corpus_scenes import ROOM
    from .corpus_splats import cloud

    folder.mkdir(parents=True)

    def toy() -> None:
        from kfgs.toy import make_toy_room

        make_toy_room("room", ROOM)
        write_splats(cloud(40), "labelled.ply")
        write_splats(cloud(30), "other.ply")
        Path("clicks.json").write_text(json.dumps({"chair": [{"gaussians": [3, 4]}], "wall": [{"gaussians": [7]}]}))

    steps = [
        toy,
        command("fit", "room", "--splat", "labelled.ply", "--max-gaussians", "0", "--out", "run"),
        command("fit", "room", "--splat", "other.ply", "--max-gaussians", "0", "--out", "two"),
        command("convert", "two/field.kfgs", "older.kfgs", "--precision", "lossless"),
        command("convert", "run/field.kfgs", "packed.kfgs"),
    ]
    for step in steps:
        ended = Process(step, folder).wait()
        if ended.code:
            raise RuntimeError(f"the fixture cannot be made: {ended.said}")


def grey_teacher(picture: torch.Tensor) -> torch.Tensor:
    """Features [16, h, w] of a picture [3, H, W]: its colours, smaller, and their powers."""
    small = torch.nn.functional.avg_pool2d(picture[None], 4)[0]
    return torch.cat([small**power for power in range(1, 6)] + [torch.ones_like(small[:1])])


def _with(
    *, files: dict[str, str] | None = None, notes: tuple[str, ...] = ("notes.txt",)
) -> Callable[[Path, Path], None]:
    """Copies of the fixture's files and folders by their names in `work/`, and the user's notes."""

    def prepare(fixture: Path, work: Path) -> None:
        for name, source in (files or {}).items():
            target = work / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if (fixture / source).is_dir():
                shutil.copytree(fixture / source, target)
            else:
                shutil.copy2(fixture / source, target)
        for name in notes:
            (work / name).parent.mkdir(parents=True, exist_ok=True)
            (work / name).write_text(NOTES)

    return prepare


def _in_python(function: Callable[[], int | None]) -> Work:
    """A function of Python, whose refusals and KeyboardInterrupt are exceptions, as one that ends like a command."""

    def work() -> int:
        try:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            return function() or 0
        except KeyboardInterrupt:
            print("interrupted")
            return 130
        except (ValueError, OSError) as error:
            print(f"error: {error}")
            return 1

    return work


@_in_python
def _save_html() -> None:
    from kfgs import explore, read_splats

    explore(read_splats("in/labelled.ply"), where="notebook").save_html("work/page.html")


@_in_python
def _save_edits() -> None:
    from kfgs.labels import EditList, Recolor, Remove

    EditList().then(Recolor("plant", "#c04040")).then(Remove("chair")).save("work/a.edits.json")


@_in_python
def _toy_room() -> None:
    from kfgs.toy import make_toy_room

    from .corpus_scenes import ROOM

    make_toy_room("work/room", ROOM)


def all_jobs() -> list[Job]:
    """Every job, the quick ones first."""
    field, room = "in/run/field.kfgs", ("--scene", "in/room")
    images, times = (".html", ".png"), (".json", ".html", ".png")
    return [
        Job("convert", command("convert", "in/labelled.ply", "work/a.spz"), _with(files={"a.spz": "other.ply"})),
        Job("convert with labels beside", command("convert", "in/labelled.ply", "work/a.splat"), _with()),
        Job("convert to sog", command("convert", "in/labelled.ply", "work/a.sog"), _with()),
        Job("convert to gltf", command("convert", "in/labelled.ply", "work/a.gltf"), _with()),
        Job(
            "edit",
            command("edit", "in/labelled.ply", "--out", "work/a.ply", "--remove", "chair"),
            _with(files={"a.ply": "other.ply"}),
        ),
        Job("save edits", _save_edits, _with()),
        Job("toy room", _toy_room, _with(), idle=True),
        Job(
            "pack",
            command("convert", field, "work/a.kfgs"),
            _with(files={"a.kfgs": "packed.kfgs"}),
        ),
        Job(
            "unpack",
            command("convert", "in/packed.kfgs", "work/field.kfgs"),
            _with(),
            fields=("field.kfgs",),
        ),
        Job(
            "select",
            command("select", "chair", field, "--out", "work/chairs", *room),
            _with(notes=("chairs/notes.txt",)),
        ),
        Job(
            "select in a splat",
            command("select", "chair", "in/labelled.ply", "--out", "work/chairs"),
            _with(notes=("chairs/a.txt",)),
        ),
        Job(
            "segment",
            command("segment", field, "--out", "work/seen", *room),
            _with(notes=("seen/notes.txt",)),
            loose=images,
        ),
        Job(
            "text of examples",
            command("features", field, "--examples", "in/clicks.json", "--out", "work/t.safetensors"),
            _with(),
        ),
        Job(
            "attach",
            command("attach", field, "in/labelled.ply", "--out", "work/a.ply", *room),
            _with(files={"a.ply": "other.ply"}),
        ),
        Job("save html", _save_html, _with()),
        Job(
            "features",
            command("features", "in/room", "--teacher", "campaign.jobs:grey_teacher", "--out", "work/maps"),
            _with(notes=("maps/notes.txt",)),
            loose=("features.json",),
            resumed=True,
        ),
        Job(
            "fit",
            command("fit", "in/room", "--splat", "in/labelled.ply", "--out", "work/run"),
            _with(files={"run/field.kfgs": "older.kfgs"}, notes=("run/field/mine.ply", "run/notes.txt")),
            fields=("run/field.kfgs",),
            loose=times,
            resumed=True,
        ),
        Job(
            "fit with other options",
            command("fit", "in/room", "--splat", "in/other.ply", "--out", "work/run"),
            _with(files={"run": "two"}, notes=("run/field/mine.ply",)),
            fields=("run/field.kfgs",),
            loose=times,
            resumed=True,
            shown=("run/report.html", "run/preview.png"),
        ),
        Job(
            "fit by the paper",
            command(
                "fit",
                "in/room",
                "--method",
                "adc",
                "--steps",
                "12",
                "--max-gaussians",
                "100",
                "--out",
                "work/run",
            ),
            _with(notes=("run/notes.txt",)),
            fields=("run/field.kfgs",),
            loose=times,
            resumed=True,
        ),
        Job(
            "color",
            command("color", "in/room", "--out", "work/run", "--preset", "quick", "--steps", "12"),
            _with(notes=("run/notes.txt",)),
            loose=times,
            resumed=True,
        ),
    ]
