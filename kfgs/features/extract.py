"""A teacher's maps written to a folder, one picture in memory at a time, so that a killed run goes on where it stopped."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from torch import Tensor
from tqdm import tqdm

from .._check import one_line
from .._files import bytes_in_words, digest_file, seconds_in_words
from ..scenes import Scene, read_image
from ..teachers.protocol import Teacher, as_teacher, identify
from .layouts import LAYOUTS, OWN, layout_of, write_npy_map
from .manifest import MANIFEST, Manifest, MapRecord, read_manifest
from .map_store import MapStore, check_space, doubt_file, encode_half, locked, map_file, plain_identity, sweep


@dataclass(frozen=True)
class Picture:
    """A picture that a teacher is to see: where it lies, and what its map is to be called."""

    stem: str
    """The view's name without its suffix."""
    path: Path

    def read(self) -> Tensor:  # [H, W, 3] float32 RGB in [0, 1]
        """Read the file; see `scenes.read_image` for what it raises."""
        return read_image(self.path)


def pictures_of(scene: Scene, views: Sequence[int] | None = None) -> list[Picture]:
    """The pictures of some views of a scene (all if None), as they lie on disk.

    A lens is not removed, also where the scene is undistorted: `fit_scene` removes it from the maps
    (`FitConfig.undistorted_features` is False).
    """
    chosen = range(len(scene)) if views is None else views
    return [Picture(scene.stem(i), scene.image_paths[i]) for i in chosen]


def extract_features(
    teacher: Teacher | Callable[[Tensor], Tensor],
    pictures: Sequence[Picture],
    folder: str | Path,
    *,
    overwrite: bool = False,
    progress: bool = False,
    report: Callable[[str], None] | None = None,
) -> Manifest:
    """Write a teacher's map of each picture to a folder that `FeatureFolder` reads, and that a later call completes.

    A map is `<stem>.npy`, float16 [h, w, D]. What was made of which picture by which teacher stands in `features.json`,
    which is written after every picture. A map is made again if it is gone or damaged, or if its picture has changed.
    One picture and its map are in memory at a time.

    Where there is a `features.json`, a `<stem>.npy` that it does not tell of is taken for what a killed process left, and
    is written over without asking; keep maps of other programs in folders of their own.

    Args:
        teacher: sees each picture, [3, H, W] RGB in [0, 1]; a teacher, or a function to [D, h, w] (see `as_teacher`).
        pictures: see `pictures_of`.
        folder: for the maps; made if there is none.
        overwrite: give up the maps of another teacher (or other weights, or options) that lie there, and maps of these
            names that other programs wrote (until all are written over, `FeatureFolder` refuses those that are left).
            Maps of the same teacher are kept all the same.
        progress: show a progress bar, with the time left.
        report: receives a line about what is to be done, and one per map that is made again.

    Returns:
        The manifest: a record per map, also of pictures that this call was not asked for.

    Raises:
        TypeError: if `teacher` is none, it returns no tensor, or its identity is no JSON.
        ValueError: if there are no pictures, two have one stem, a map is not finite in float16 or has another number of
            channels than the others, or another size than that of a picture of equal size; if the folder holds maps of
            another teacher, or is being written to by another process.
        OSError: if the folder cannot be written to, or the maps will not fit on the disk.
    """
    folder, teacher = Path(folder), as_teacher(teacher)
    check_pictures(pictures, folder)
    with locked(folder):
        identity = plain_identity(identify(teacher))
        _make_room(folder, pictures, identity, overwrite=overwrite)
        store = MapStore.open(folder, identity)
        sweep(folder, [map_file(folder, picture.stem) for picture in pictures])
        digests = {picture.stem: digest_file(picture.path) for picture in pictures}
        doubts = {picture.stem: store.doubt(picture.stem, digests[picture.stem]) for picture in pictures}
        todo = [picture for picture in pictures if doubts[picture.stem] is not None]
        maker = _Maker(teacher, store, digests, len(todo))
        if todo:
            maker.learn(pictures, todo)
        if report is not None:
            report(maker.outlook(len(pictures) - len(todo)))
            for picture in todo:
                if doubts[picture.stem] != "new":
                    report(f"features: {picture.stem}: {doubts[picture.stem]}; making it again")
        with tqdm(total=len(pictures), initial=len(pictures) - len(todo), desc="features", disable=not progress) as bar:
            for picture in todo:
                bar.set_postfix_str(f"{picture.stem}, {maker.time_left()}")
                maker.make(picture)
                bar.update()
            bar.set_postfix_str("")
        return store.manifest


def discard_maps(folder: str | Path, stems: Sequence[str] | None = None) -> int:
    """Delete maps of a folder that `extract_features` filled, once index maps have been made of them.

    The manifest stays, so that finished stages of a run are still found; `extract_features` makes the maps again.

    Args:
        folder: of the maps.
        stems: of the views whose maps are to go; all maps of the folder if None.

    Returns:
        Bytes that were freed.

    Raises:
        ValueError, TypeError: as `check_discardable`, or if the folder is in use; then nothing is deleted.
    """
    folder = Path(folder)
    _manifest_of(folder)  # before there is a lock file in a folder of other programs
    with locked(folder):
        manifest, files = _discardable(folder, stems)
        replace(manifest, discarded=True).save(folder)  # first, so that a killed call can be repeated
        freed = sum(path.stat().st_size for path in files)
        for path in files:
            path.unlink()
    return freed


def check_discardable(folder: str | Path, stems: Sequence[str] | None = None) -> None:
    """Do nothing if `discard_maps` could delete these maps: to be asked before the work that is to make them superfluous.

    Files are only read if they were copied or touched since.

    Raises:
        ValueError: if the folder has no manifest, or one that does not tell of a view, or of another file than is there.
        TypeError: if `stems` is a text.
    """
    _discardable(Path(folder), stems)


def _discardable(folder: Path, stems: Sequence[str] | None) -> tuple[Manifest, list[Path]]:
    """The manifest, and the files of these views' maps that are there."""
    manifest = _manifest_of(folder)
    if isinstance(stems, str):
        raise TypeError(f"stems: expected a list of image stems, got the text {stems!r}; put it into a list")
    wanted = list(manifest.maps) if stems is None else list(dict.fromkeys(stems))
    unknown = [stem for stem in wanted if stem not in manifest.maps]
    if unknown:
        raise ValueError(
            f"stems: expected views whose maps kfgs made, got {unknown[0]!r}, which {folder / MANIFEST} does not tell of "
            f"({len(unknown)} of {len(wanted)}); delete such maps by hand"
        )
    files = []
    for stem in wanted:
        record, path = manifest.maps[stem], map_file(folder, stem)
        if path != folder / record.file or (path.is_file() and doubt_file(path, record) is not None):
            raise ValueError(
                f"folder: expected maps as they were written, got another file in {folder / record.file}; move it away"
            )
        files += [path] if path.is_file() else []
    return manifest, files


def _manifest_of(folder: Path) -> Manifest:
    manifest = read_manifest(folder)
    if manifest is None:
        raise ValueError(
            f"folder: expected maps that kfgs made (with features.json), got none in {folder}; maps of other programs "
            "cannot be made again by kfgs: delete them by hand"
        )
    return manifest


class _Maker:
    """Makes maps one after the other, and knows how large they are and how long they take."""

    def __init__(self, teacher: Teacher, store: MapStore, digests: dict[str, str], count: int) -> None:
        self.teacher, self.store, self.digests, self.left = teacher, store, digests, count
        self.shapes: dict[tuple[int, int], tuple[int, int, int]] = {}  # of a picture: of its map
        records = list(store.manifest.maps.values())
        self.channels: MapRecord | None = records[-1] if records else None
        self.seconds = [record.seconds for record in records][-10:]
        self.checked_space = False

    def learn(self, pictures: Sequence[Picture], todo: list[Picture]) -> None:
        """Take the map's size from a map that is there, and see whether the others will fit."""
        waiting = {picture.stem for picture in todo}
        done = next((picture for picture in pictures if picture.stem not in waiting), None)
        if done is not None:
            H, W, _ = done.read().shape
            self.shapes[H, W] = self.store.manifest.maps[done.stem].shape
        if self.channels is not None:
            self._check_space(self.channels.bytes)

    def make(self, picture: Picture) -> None:
        """Read, encode, check, write, record."""
        start = time.perf_counter()
        image = picture.read()
        half = encode_half(self.teacher, image, picture.path)
        seconds = time.perf_counter() - start
        h, w, D = map(int, half.shape)
        self._check_shape(picture, (int(image.shape[0]), int(image.shape[1])), (h, w, D))
        if not self.checked_space:
            self._check_space(half.nbytes)
        file = write_npy_map(map_file(self.store.folder, picture.stem), half)
        self.channels = self.store.add(
            picture.stem,
            file,
            shape=(h, w, D),
            image=picture.path.name,
            image_digest=self.digests[picture.stem],
            seconds=round(seconds, 3),
        )
        self.seconds = [*self.seconds[-9:], time.perf_counter() - start]
        self.left -= 1

    def _check_shape(self, picture: Picture, size: tuple[int, int], shape: tuple[int, int, int]) -> None:
        others = self.channels
        if others is not None and others.shape[2] != shape[2]:
            raise ValueError(
                f"teacher {self.teacher.name!r}: expected {others.shape[2]} channels for {picture.path} as in "
                f"{one_line(others.file, 200)}, got {shape[2]}; use one teacher with the same options for all pictures"
            )
        expected = self.shapes.setdefault(size, shape)
        if expected != shape:
            raise ValueError(
                f"teacher {self.teacher.name!r}: expected a map of (h, w, D) = {expected} for {picture.path} as for other "
                f"pictures of {size[0]} x {size[1]}, got {shape}; use the same options for all pictures"
            )

    def _check_space(self, map_bytes: int) -> None:
        self.checked_space = True
        check_space(self.store.folder, map_bytes * self.left, self.left)

    def outlook(self, found: int) -> str:
        """What is found and what is to be done, in a line."""
        text = f"features: {found} maps found, {self.left} to make by {self.teacher.name}"
        known = self.left and self.channels is not None
        return text + (f" ({bytes_in_words(self.left * self.channels.bytes)}, {self.time_left()})" if known else "")  # type: ignore[union-attr]

    def time_left(self) -> str:
        """How long the maps to be made will take, going by the last ten."""
        return (
            f"about {seconds_in_words(self.left * median(self.seconds))} left"
            if self.seconds
            else "time left not known yet"
        )


def check_pictures(pictures: Sequence[Picture], folder: Path) -> None:
    """Raise an error unless there are pictures that exist, each with a name of its own within `folder`."""
    if len(pictures) == 0:
        raise ValueError("pictures: expected at least one, got none; name the views to encode")
    stems = [picture.stem for picture in pictures]
    if len(set(stems)) != len(stems):
        twice = next(stem for stem in stems if stems.count(stem) > 1)
        raise ValueError(f"pictures: expected each stem once, got {twice!r} twice; rename one of the pictures")
    for picture in pictures:
        map_file(folder, picture.stem)
        if not picture.path.is_file():
            raise FileNotFoundError(f"{picture.path}: no such file; expected the picture of view {picture.stem!r}")


def _make_room(folder: Path, pictures: Sequence[Picture], identity: dict[str, object], *, overwrite: bool) -> None:
    """Refuse maps that are not ours, or give them up if that was asked for."""
    found = read_manifest(folder)
    own = {map_file(folder, picture.stem) for picture in pictures} | (found.files(folder) if found else set())
    shadows = (
        file
        for picture in pictures
        for layout in LAYOUTS[: LAYOUTS.index(OWN)]
        if (file := folder / f"{picture.stem}{layout.suffix}").is_file() and layout_of(file, own) is layout
    )
    if (first := next(shadows, None)) is not None:
        raise ValueError(
            f"folder: expected one without maps of other programs, got {first}, which would be read instead of ours; use "
            "another folder"
        )
    if found is None:
        foreign = [file for p in pictures if (file := map_file(folder, p.stem)).is_file()]
        if foreign and not overwrite:
            raise ValueError(
                f"folder: expected one without maps of other programs, got {foreign[0]} and no features.json; use another "
                "folder, or pass overwrite=True (--overwrite)"
            )
    elif overwrite and found.teacher != identity:
        for stem in found.maps:
            map_file(folder, stem).unlink(missing_ok=True)
        Manifest(identity).save(folder)
