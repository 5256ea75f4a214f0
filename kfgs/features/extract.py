"""Write a teacher's maps of a scene to a folder, one picture at a time, and delete them when no longer needed."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from statistics import median

from torch import Tensor
from tqdm import tqdm

from .._check import one_line
from .._files import (
    as_path,
    bytes_in_words,
    digest_file,
    locked,
    seconds_in_words,
)
from ..scenes import Scene
from ..teachers.protocol import Teacher, as_teacher, identify
from .layouts import map_file, write_npy_map
from .manifest import MANIFEST, Manifest, MapRecord, latest_records, part_manifests, read_manifest
from .pictures import Picture, Split, as_pictures
from .writer import LOCK, MapWriter, check_maps, encode_half


def extract_features(
    teacher: Teacher | Callable[[Tensor], Tensor],
    pictures: Scene | Sequence[Picture],
    folder: str | Path,
    split: Split = "train",
    *,
    overwrite: bool = False,
    part: str | None = None,
    progress: bool = False,
    report: Callable[[str], None] | None = None,
) -> Manifest:
    """Write a teacher's map of each picture to a folder that `FeatureFolder` reads. After a killed call, call it again.

    A map is `<stem>.npy`, float16 [h, w, D]. `features.json` records which teacher made it from which picture, and is
    written after every picture. A map is made again if it is missing or damaged, or if its picture has changed. Memory
    holds one picture and its map at a time.

    In a folder with `features.json`, a `<stem>.npy` without a record is overwritten, because a killed process may have left
    it. Keep maps of other programs in other folders.

    Args:
        teacher: sees each picture, [3, H, W] RGB in [0, 1]; a teacher, or a function to [D, h, w] (see `as_teacher`).
        pictures: a scene, whose pictures are taken as they are on disk, or a list, see `pictures_of`.
        folder: for the maps; made if it does not exist.
        split: of a scene: the name of a split, `all`, or a list of view names or indices.
        overwrite: replace maps that kfgs made by another teacher (or with other weights or options). Maps of the same
            teacher are kept, and maps of other programs are an error.
        part: a word of letters and digits, if several processes fill the folder at the same time, each with other pictures
            and another word. The maps are recorded in `features.part-<word>.json` until `join_features` joins all parts.
            Maps that another part has recorded are kept, so a later call may divide the pictures in another way.
        progress: show a progress bar.
        report: receives one line about what will be done, and one per map that is made again.

    Returns:
        The manifest, with a record of every map in the folder (or of the part).

    Raises:
        TypeError: if `teacher` is no teacher, it returns no tensor, or JSON cannot hold its identity.
        ValueError: if `part` is no such word, or given with `overwrite`; if there are no pictures, two have the same stem, a
            map is not finite in float16, maps differ in channels, or in size for pictures of equal size; if the folder
            holds maps of another teacher (without `overwrite`) or of another program, or another process is writing to it.
        OSError: if the folder cannot be written to, or the disk has no space for the maps.
    """
    folder, teacher, chosen = as_path(folder), as_teacher(teacher), as_pictures(pictures, split, exist=True)
    if part is not None and (overwrite or not (part.isascii() and part.isalnum())):
        raise ValueError(
            f"part: expected letters and digits, and no overwrite, which would delete the maps of other parts, got {part!r}, "
            f"overwrite={overwrite}; use another word, or another folder"
        )
    identity = identify(teacher)
    if folder.is_dir():  # one that is refused stays as it is, without a lock file
        check_maps(folder, identity, chosen, overwrite=overwrite, part=part)
    with locked(folder, LOCK if part is None else f".features.part-{part}.lock"):
        writer = MapWriter(folder, identity, chosen, overwrite=overwrite, part=part)
        digests = {picture.stem: digest_file(picture.path) for picture in chosen}
        doubts = {stem: writer.doubt(stem, digest) for stem, digest in digests.items()}
        todo = [picture for picture in chosen if doubts[picture.stem] is not None]
        done = next((picture for picture in chosen if doubts[picture.stem] is None), None)
        records = list(writer.manifest.maps.values())
        if todo and records:
            writer.check_space(len(todo), records[-1].bytes)
        if report is not None:
            report(_outlook(len(chosen) - len(todo), len(todo), teacher.name, records))
            for stem, doubt in doubts.items():
                if doubt not in (None, "new"):
                    report(f"features: {stem}: {doubt}; making it again")
        shapes: dict[tuple[int, ...], tuple[int, ...]] = {}  # size of a picture -> shape of its map
        if todo and done:
            shapes[tuple(done.read().shape[:2])] = writer.manifest.maps[done.stem].shape
        with tqdm(total=len(chosen), initial=len(chosen) - len(todo), desc="features", disable=not progress) as bar:
            for picture in todo:
                bar.set_postfix_str(picture.stem)
                start, image = time.perf_counter(), picture.read()
                half = encode_half(teacher, image, picture.path)
                seconds = time.perf_counter() - start
                h, w, D = map(int, half.shape)
                size = tuple(image.shape[:2])
                _check_shape(teacher.name, picture, (h, w, D), shapes.setdefault(size, (h, w, D)), records[-1:])
                if not records:
                    writer.check_space(len(todo), half.nbytes)
                file = write_npy_map(map_file(folder, picture.stem), half)
                records.append(writer.add(picture, digests[picture.stem], file, (h, w, D), seconds))
                bar.update()
        return writer.manifest


def join_features(folder: str | Path, stems: Sequence[str]) -> Manifest:
    """Join the parts that several calls of `extract_features` made into one `features.json`, as one call would have left it.

    Only the records are joined: every map has its final name already. A killed call can be repeated.

    Args:
        folder: the folder of maps; no call for one of its parts may be at work.
        stems: the views that must have a record, in their order.

    Raises:
        ValueError: if one has none, parts were made by different teachers, or another process is writing to the folder.
    """
    folder = as_path(folder)
    with locked(folder, LOCK):
        parts, whole = part_manifests(folder), read_manifest(folder)
        manifests = [*([] if whole is None else [whole]), *parts.values()]
        known, teachers = latest_records(manifests), [one.teacher for one in manifests]
        missing = [stem for stem in stems if stem not in known]
        if missing or any(teacher != teachers[0] for teacher in teachers):
            got = f"none of {missing[0]!r} ({len(missing)} in all)" if missing else "those of different teachers"
            raise ValueError(
                f"stems: expected a record of one teacher for each view in {folder}, got {got}; encode it again"
            )
        order = known if whole is not None else {**{stem: known[stem] for stem in stems}, **known}
        made = {stem for one in parts.values() for stem in one.maps}
        discarded = whole is not None and whole.discarded and not set(whole.maps) <= made
        joined = Manifest(teachers[0], order, discarded)
        joined.save(folder)
        for file in (*parts, *folder.glob(".features.part-*.lock")):
            file.unlink()
        return joined


def discard_maps(folder: str | Path, stems: Sequence[str] | None = None, *, dry_run: bool = False) -> int:
    """Delete maps that `extract_features` wrote, once index maps have been made from them.

    The manifest stays, so that finished stages of a run are still found; `extract_features` makes the maps again. Maps that
    were copied or touched since they were written are read first, to check that they are unchanged.

    Args:
        folder: the folder of maps.
        stems: the views whose maps to delete; all maps of the folder if None.
        dry_run: delete nothing. Call it so before a long run whose last step deletes the maps.

    Returns:
        The number of bytes that are (or would be) freed.

    Raises:
        ValueError: if the folder has no manifest, or one without a record of a view or with another file than exists; if
            another process is writing to it. Then nothing is deleted.
        TypeError: if `stems` is a text.
    """
    folder = as_path(folder)
    manifest = read_manifest(folder)
    if manifest is None:  # an error before there is a lock file in a folder of another program
        raise ValueError(
            f"{folder}: expected maps that kfgs made (with {MANIFEST}), got none; kfgs cannot make the maps of other "
            "programs again: delete them by hand"
        )
    with nullcontext() if dry_run else locked(folder, LOCK):
        manifest = read_manifest(folder) or manifest
        files = _discardable(folder, manifest, stems)
        freed = sum(file.stat().st_size for file in files)
        if not dry_run:
            replace(manifest, discarded=True).save(folder)  # first, so that a killed call can be repeated
            for file in files:
                file.unlink()
    return freed


def _discardable(folder: Path, manifest: Manifest, stems: Sequence[str] | None) -> list[Path]:
    """The existing map files of these views; an error if one has changed since kfgs wrote it."""
    if isinstance(stems, str):
        raise TypeError(f"stems: expected a list of image stems, got the text {stems!r}; put it into a list")
    wanted = list(manifest.maps) if stems is None else list(dict.fromkeys(stems))
    unknown = [stem for stem in wanted if stem not in manifest.maps]
    if unknown:
        raise ValueError(
            f"stems: expected views whose maps kfgs made, got {unknown[0]!r}, of which {folder / MANIFEST} has no record "
            f"({len(unknown)} of {len(wanted)}); delete these maps by hand"
        )
    records = {folder / manifest.maps[stem].file: (stem, manifest.maps[stem]) for stem in wanted}
    for file, (stem, record) in records.items():
        if file != map_file(folder, stem) or (file.is_file() and record.doubt(file) is not None):
            raise ValueError(f"{file}: expected the map that kfgs wrote, got another file; move it away")
    return [file for file in records if file.is_file()]


def _check_shape(
    name: str, picture: Picture, shape: tuple[int, ...], expected: tuple[int, ...], before: list[MapRecord]
) -> None:
    """Raise if a map's channels differ from the map before, or its shape from maps of pictures of this size."""
    if before and before[0].shape[2] != shape[2]:
        what, where, got = f"{before[0].shape[2]} channels", f"in {one_line(before[0].file, 200)}", str(shape[2])
    elif expected != shape:
        what, where, got = f"a map of (h, w, D) = {expected}", "for other pictures of its size", str(shape)
    else:
        return
    raise ValueError(
        f"teacher {name!r}: expected {what} for {picture.path} as {where}, got {got}; use one teacher with the same options "
        "for all pictures"
    )


def _outlook(found: int, left: int, name: str, records: list[MapRecord]) -> str:
    """One line: maps found, maps to make, and the space and time they take, estimated from those found."""
    text = f"features: {found} maps found, {left} to make by {name}"
    if not left or not records:
        return text
    seconds = left * median(record.seconds for record in records[-10:])
    return f"{text} ({bytes_in_words(left * records[-1].bytes)}, about {seconds_in_words(seconds)} left)"
