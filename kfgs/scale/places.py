"""Where scenes and runs lie: a folder, used in place, or a URL of fsspec, of which a task has a copy in a scratch folder."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from .._files import atomic_path, parse_json, real_path
from .scene_list import is_url

WRITER = "kfgs batch"
AT_WORK = ".at_work"
"""In the folder of a run: a worker writes it when it begins a task. So a task whose `state.json` is newer waits for a worker."""
LOCAL_ONLY = ("digests.json",)  # a run's notes about files of this machine
STAMPS = ("ETag", "etag", "md5Hash", "content_md5", "mtime", "LastModified", "last_modified", "created")
"""What file systems of fsspec say about a file's version; each has some of them."""


class Place:
    """A folder."""

    def __init__(self, folder: Path) -> None:
        self.path = folder
        """Where its files are, or their copies."""

    def listing(self) -> dict[str, list[Any]]:
        """[bytes, version] of each file by its relative name, without hidden ones; a changed file has another version.

        Links are followed, but each folder is listed once: a second link to it, or one that leads back, is left out.
        """
        found: dict[str, list[Any]] = {}
        seen = {real_path(self.path)}
        for here, folders, names in os.walk(self.path, followlinks=True):
            inside = sorted(Path(here) / name for name in folders if not name.startswith("."))
            folders.clear()
            for folder in sorted(inside, key=Path.is_symlink):  # links last: they may lead to a folder beside them
                if (real := real_path(folder)) not in seen:
                    seen.add(real)
                    folders.append(folder.name)
            for file in (Path(here) / name for name in names if not name.startswith(".")):
                if (mark := _mark(file)) is not None:  # else a broken link
                    found[file.relative_to(self.path).as_posix()] = mark
        return dict(sorted(found.items()))

    def marks(self, names: Iterable[str], listing: dict[str, list[Any]] | None = None) -> list[list[Any]]:
        """[name, bytes, version] of files, for a key; a file that does not exist has neither.

        Args:
            names: relative or absolute.
            listing: of this place, if there is one already.
        """
        known = self.listing() if listing is None else listing
        return [[name, *(known.get(name) or _mark(self.path / name) or [None])] for name in sorted(names)]

    def fetch(self, wanted: Callable[[str], bool]) -> None:
        """Copy the files whose relative names are wanted to `path`, if they are elsewhere."""

    def store(self) -> None:
        """Copy back what was made or changed in `path`, and delete what was deleted there."""

    def read_text(self, name: str) -> str | None:
        """A text; None if there is none."""
        try:
            return (self.path / name).read_text(encoding="utf-8", errors="replace")
        except FileNotFoundError:
            return None

    def write_text(self, name: str, text: str) -> None:
        """Write a text in one step."""
        with atomic_path(self.path / name) as temporary:
            temporary.write_text(text, encoding="utf-8")

    def write_json(self, name: str, value: dict[str, Any]) -> None:
        """Write a JSON object in one step."""
        self.write_text(name, json.dumps(value, indent=2, allow_nan=False) + "\n")

    def remove(self, name: str) -> None:
        """Delete a file, if it is there."""
        (self.path / name).unlink(missing_ok=True)

    def read_json(self, name: str) -> dict[str, Any]:
        """A JSON object that a batch wrote; an empty one if there is none, or it is damaged."""
        with suppress(ValueError):
            found = parse_json(self.read_text(name) or "{}")
            if isinstance(found, dict):
                return found
        return {}


class StoredPlace(Place):
    """A prefix in an object store, or another place that fsspec knows.

    Raises:
        ImportError: if fsspec, or its package for this kind of URL, is missing.
    """

    def __init__(self, url: str, scratch: Path) -> None:
        super().__init__(scratch)
        try:
            import fsspec

            local = {"auto_mkdir": True} if url.startswith(("file:", "local:")) else {}  # others know no folders
            self.files, root = fsspec.core.url_to_fs(url, **local)
        except (ImportError, ValueError) as error:
            raise ImportError(
                f"{url}: expected a kind of URL that fsspec can open ({error}); pip install 'kfgs[scale]', and for s3:// s3fs, "
                "for gs:// gcsfs, for abfs:// adlfs"
            ) from error
        self.url, self.root = url.rstrip("/"), root.rstrip("/")
        self._before: dict[str, list[Any]] = {}

    def _at(self, name: str) -> str:
        return f"{self.root}/{name}"

    def listing(self) -> dict[str, list[Any]]:
        """See `Place.listing`."""
        self.files.invalidate_cache()
        try:
            entries = self.files.find(self.root, detail=True)
        except FileNotFoundError:
            return {}
        found = {}
        for path, info in entries.items():
            name = path.removeprefix(self.root).lstrip("/")
            if name and not any(part.startswith(".") for part in name.split("/")):
                found[name] = [int(info["size"]), [str(info[stamp]) for stamp in STAMPS if stamp in info]]
        return dict(sorted(found.items()))

    def fetch(self, wanted: Callable[[str], bool]) -> None:
        """See `Place.fetch`."""
        names = [name for name in self.listing() if wanted(name) and not (self.path / name).is_file()]
        for name in names:
            (self.path / name).parent.mkdir(parents=True, exist_ok=True)
        if names:
            self.files.get([self._at(name) for name in names], [str(self.path / name) for name in names])
        self._before = super().listing()

    def store(self) -> None:
        """See `Place.store`."""
        now = {name: mark for name, mark in super().listing().items() if name not in LOCAL_ONLY}
        changed = [name for name, mark in now.items() if self._before.get(name) != mark]
        if changed:
            self.files.put([str(self.path / name) for name in changed], [self._at(name) for name in changed])
        for name in set(self._before) - set(now) - set(LOCAL_ONLY):
            self.remove(name)
        self._before = now

    def read_text(self, name: str) -> str | None:
        """See `Place.read_text`."""
        self.files.invalidate_cache()
        try:
            return str(self.files.cat_file(self._at(name)).decode("utf-8"))
        except FileNotFoundError:
            return None

    def write_text(self, name: str, text: str) -> None:
        """See `Place.write_text`; an object store shows an object when it is whole."""
        self.files.pipe_file(self._at(name), text.encode("utf-8"))

    def remove(self, name: str) -> None:
        """See `Place.remove`."""
        with suppress(FileNotFoundError):
            self.files.rm_file(self._at(name))


def begun_at(folder: Path, since: str) -> float | None:
    """When a worker began a task of a run, in seconds of the clock; None if none did after a file there was written."""
    note, earlier = _mark(folder / AT_WORK), _mark(folder / since)
    return None if note is None or earlier is None or note[1] < earlier[1] else note[1] / 1e9


@contextmanager
def open_place(place: str) -> Iterator[Place]:
    """A folder or URL; the scratch folder of a URL is deleted at the end."""
    if not is_url(place):
        yield Place(Path(place))
        return
    scratch = Path(tempfile.mkdtemp(prefix="kfgs-batch-"))
    try:
        yield StoredPlace(place, scratch)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def inside(*places: str) -> Callable[[str], bool]:
    """Whether a relative name is one of some files, or in one of some folders."""
    chosen = [(place.rstrip("/"), place.rstrip("/") + "/") for place in places]
    return lambda name: any(name == place or name.startswith(folder) for place, folder in chosen)


def _mark(file: Path) -> list[Any] | None:
    """[bytes, version] of a file; None if there is none."""
    try:
        info = file.stat()
    except OSError:  # none, or a link to itself
        return None
    return [info.st_size, info.st_mtime_ns]
