"""A run folder of finished stages, each under the hash of what it was made from.

A stage is a function that fills a folder. Its name and the JSON description of its inputs give a key; a folder with
that key that is complete is used as it is, otherwise the stage is made in a temporary folder and moved into place in
one step. So a killed run leaves only finished stages, and the same command continues where it stopped.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._files import atomic_folder, digest_file, digest_value, read_json, write_json
from ..cameras import Camera
from ..cameras.camera import NEAR
from ..scenes import Scene

STAGE_FILE = "stage.json"
STAGE_VERSION = 2
"""Part of every key: raised when the same inputs would give another result, so that old stages are not used again."""


@dataclass(frozen=True)
class Stage:
    """One finished stage: where its files lie, and how it came about."""

    name: str
    key: str
    folder: Path
    seconds: float
    reused: bool


class UnfinishedError(Exception):
    """A stage is not in the run folder, and `Run.look_only` says not to make it."""


@dataclass
class Run:
    """The stages of one run folder, in the order they were asked for.

    Example:
        >>> import tempfile, pathlib
        >>> run = Run(pathlib.Path(tempfile.mkdtemp()))
        >>> one = run.stage("hello", {"who": "world"}, lambda folder: (folder / "a").write_text("hello"))
        >>> again = run.stage("hello", {"who": "world"}, lambda folder: None)
        >>> one.reused, again.reused, (again.folder / "a").read_text()
        (False, True, 'hello')
    """

    folder: Path
    report: Callable[[str], None] | None = None
    stages: list[Stage] = field(default_factory=list)
    look_only: bool = False
    """Make and write nothing: a stage that is not finished raises `UnfinishedError`, and files are not digested."""

    def stage(self, name: str, inputs: dict[str, Any], make: Callable[[Path], float | None]) -> Stage:
        """Return the finished stage of these inputs, making it if it is not there.

        Args:
            name: a word for the folder's name.
            inputs: everything that decides the result, as JSON; keys of earlier stages stand for their content.
            make: fills the folder it is given; may return the seconds of work that an earlier, killed process did for it.

        Raises:
            ValueError: if a folder of that key is damaged.
            UnfinishedError: if the stage is not there, and `look_only` is True.
        """
        key = _key(name, inputs)
        target = self.folder / "stages" / f"{name}-{key}"
        if (target / STAGE_FILE).is_file():
            about = read_json(target / STAGE_FILE)
            if about.get("inputs") != json.loads(json.dumps(inputs)):
                raise ValueError(
                    f"{target}: expected the stage of these inputs, found the inputs of another stage; delete it"
                )
            if about.get("files") != _sizes(target):
                raise ValueError(
                    f"{target}: expected the files {about.get('files')} (name: bytes), found {_sizes(target)}; the stage "
                    "is damaged: delete the folder, and it will be made again"
                )
            done = Stage(name, key, target, float(about["seconds"]), True)
            self.say(f"{name}: found in {target.name} (made in {done.seconds:.1f} s)")
        elif self.look_only:
            raise UnfinishedError(name)
        else:
            self.say(f"{name}: working")
            start = time.perf_counter()
            for left_over in target.parent.glob(f".{target.name}.*"):  # of a process that was killed
                shutil.rmtree(left_over, ignore_errors=True)
            with atomic_folder(target) as temporary:
                earlier = make(temporary) or 0.0
                seconds = time.perf_counter() - start + earlier
                about = {"name": name, "inputs": inputs, "seconds": seconds, "files": _sizes(temporary)}
                write_json(temporary / STAGE_FILE, about)
            done = Stage(name, key, target, seconds, False)
            self.say(f"{name}: done in {seconds:.1f} s")
        self.stages.append(done)
        return done

    def scratch(self, name: str, inputs: dict[str, Any]) -> Path:
        """A path for the unfinished work of a stage (checkpoints), kept until the stage is done."""
        return self.folder / "unfinished" / f"{name}-{_key(name, inputs)}"

    def digests(self, paths: Sequence[Path]) -> list[list[str]]:
        """[file name, SHA-256] of each file, in the order given; a file that has not changed is not read again.

        With `look_only`, a file that would have to be read gets "unknown", which is the digest of no finished stage.
        """
        cache_path = self.folder / "digests.json"
        cache: dict[str, Any] = read_json(cache_path) if cache_path.is_file() else {}
        result, changed = [], False
        for path in paths:
            info = path.stat()
            mark = [info.st_size, info.st_mtime_ns, info.st_ctime_ns]
            known = cache.get(str(path.resolve()))
            if known is None or known[:-1] != mark:
                if self.look_only:
                    result.append([path.name, "unknown"])
                    continue
                known = [*mark, digest_file(path)]
                cache[str(path.resolve())] = known
                changed = True
            result.append([path.name, known[-1]])
        if changed:
            write_json(cache_path, cache)
        return result

    def say(self, text: str) -> None:
        """Report a line, if anyone listens."""
        if self.report is not None:
            self.report(text)


def _key(name: str, inputs: dict[str, Any]) -> str:
    return digest_value({"name": name, "inputs": inputs, "version": STAGE_VERSION})[:12]


def _sizes(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_size for path in sorted(folder.iterdir()) if path.name != STAGE_FILE}


def stage_generator(seed: int, purpose: str) -> torch.Generator:
    """A generator of its own for each stage, so that skipping a finished stage changes nothing downstream."""
    digest = hashlib.sha256(f"{purpose}:{seed}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:7], "little"))


def digest_tensors(*tensors: Tensor) -> str:
    """SHA-256 over shapes, dtypes and values, in hexadecimal."""
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(f"{tuple(tensor.shape)}{tensor.dtype}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def digest_scene(scene: Scene, views: Sequence[int]) -> str:
    """SHA-256 of some views' poses, intrinsics, sizes and near planes, and of the sparse points.

    Where all near planes are at 0.2 they are left out: runs from before cameras had one stay valid.
    """
    cameras = [scene.cameras[i] for i in views]
    poses = torch.stack([camera.viewmat for camera in cameras])
    intrinsics = torch.stack([camera.K for camera in cameras])
    sizes = torch.tensor([camera.size for camera in cameras])
    near = torch.tensor([camera.near for camera in cameras], dtype=torch.float64)
    return digest_tensors(poses, intrinsics, sizes, scene.points, *([near] if (near != NEAR).any() else []))


def describe_lens(lens: Camera) -> list[Any]:
    """What decides how a lens is removed, as plain values."""
    return [lens.K.tolist(), lens.size, asdict(lens.distortion) if lens.distortion else None]
