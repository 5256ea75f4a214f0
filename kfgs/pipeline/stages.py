"""A run folder of finished stages, each named by the hash of its inputs.

A stage is a function that fills a folder. Its name and the JSON of its inputs give a key. A complete folder with that key is
reused. Otherwise the stage is made in a temporary folder and moved into place in one step. So a killed run leaves only
finished stages, and the same command continues where it stopped.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._arrays import reading
from .._compiling import say_compiling
from .._files import (
    atomic_folder,
    digest_file,
    digest_value,
    locked,
    read_json,
    real_path,
    write_json,
)
from .._origin import Origin
from ..cameras import Camera
from ..cameras.camera import NEAR
from ..gaussians import Gaussians
from ..scenes import Scene
from ..scenes.files import has_alpha

STAGE_FILE, LOCK, DIGESTS = "stage.json", ".run.lock", "digests.json"
WRITTEN = ("stages", "stages/*", "unfinished", "unfinished/*", "teacher", "teacher/*")
"""The folders in a run folder that are written to."""
SHAPE = ("means", "quats", "scales", "opacities")
STAGE_VERSION = 3
"""Part of every key: raised if the same inputs give another result in a new version, so that old stages are not reused."""


@dataclass(frozen=True)
class Stage:
    """One finished stage: its files, and how it was made."""

    name: str
    key: str
    folder: Path
    seconds: float
    reused: bool


def read_stage(file: Path) -> dict[str, Any]:
    """The description of a finished stage; a ValueError if it has no name or no time."""
    about = read_json(file)
    with reading(file, "the description of a stage", "delete its folder, and it will be made again"):
        return {**about, "name": str(about["name"]), "seconds": float(about["seconds"])}


@dataclass
class Run:
    """The stages of one run folder, in the order of use.

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

    def stage(self, name: str, inputs: dict[str, Any], make: Callable[[Path], float | None]) -> Stage:
        """Return the finished stage of these inputs; make it if it does not exist.

        Several processes make it together (`together`): each calls `make`, and what the first one writes is kept.

        Args:
            name: a word for the folder's name.
            inputs: everything that decides the result, as JSON; for earlier stages, their keys.
            make: fills the given folder; may return the seconds of work by an earlier, killed process.

        Raises:
            ValueError: if a folder of that key is damaged.
        """
        key = _key(name, inputs)
        target = self.folder / "stages" / f"{name}-{key}"
        if (target / STAGE_FILE).is_file():
            about = read_stage(target / STAGE_FILE)
            if about.get("inputs") != json.loads(json.dumps(inputs)):
                raise ValueError(
                    f"{target}: expected the stage of these inputs, found the inputs of another stage; delete it"
                )
            if about.get("files") != _sizes(target):
                raise ValueError(
                    f"{target}: expected the files {about.get('files')} (name: bytes), found {_sizes(target)}; the stage "
                    "is damaged: delete the folder, and it will be made again"
                )
            done = Stage(name, key, target, about["seconds"], True)
            self.say(f"{name}: found in {target.name} (made in {done.seconds:.1f} s)")
        else:
            self.say(f"{name}: working")
            start = time.perf_counter()
            with atomic_folder(target) as temporary, say_compiling(self.say):
                earlier = make(temporary) or 0.0
                seconds = time.perf_counter() - start + earlier
                about = {"name": name, "inputs": inputs, "seconds": seconds, "files": _sizes(temporary)}
                write_json(temporary / STAGE_FILE, about)
            done = Stage(name, key, target, seconds, False)
            self.say(f"{name}: done in {seconds:.1f} s")
        self.stages.append(done)
        return done

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from working in the folder; a ValueError if one works there already."""
        with locked(self.folder, LOCK):
            yield

    def has(self, name: str, inputs: dict[str, Any]) -> bool:
        """Whether the stage of these inputs is finished."""
        return (self.folder / "stages" / f"{name}-{_key(name, inputs)}" / STAGE_FILE).is_file()

    def scratch(self, name: str, inputs: dict[str, Any]) -> Path:
        """A path for the unfinished work of a stage (checkpoints), kept until the stage is done."""
        return self.folder / "unfinished" / f"{name}-{_key(name, inputs)}"

    def digests(self, paths: Sequence[Path]) -> list[list[str]]:
        """[file name, SHA-256] of each file; unchanged files are not read again."""
        cache = _known_digests(self.folder / DIGESTS)
        result, changed = [], False
        for path in paths:
            info = path.stat()
            mark = [info.st_size, info.st_mtime_ns, info.st_ctime_ns]
            known = cache.get(str(real_path(path)))
            if not (isinstance(known, list) and known[:-1] == mark and isinstance(known[-1], str)):
                known = [*mark, digest_file(path)]
                cache[str(real_path(path))] = known
                changed = True
            result.append([path.name, known[-1]])
        if changed:
            write_json(self.folder / DIGESTS, cache)
        return result

    def say(self, text: str) -> None:
        """Report a line, if anyone listens."""
        if self.report is not None:
            self.report(text)


def _known_digests(path: Path) -> dict[str, Any]:
    """The digests that are kept; none if the file is missing or damaged: it is made again."""
    try:
        found = read_json(path)
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _key(name: str, inputs: dict[str, Any]) -> str:
    return digest_value({"name": name, "inputs": inputs, "version": STAGE_VERSION})[:12]


def _sizes(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_size for path in sorted(folder.iterdir()) if path.name != STAGE_FILE}


def is_whole(folder: Path) -> bool:
    """Whether a folder is a finished stage that this version made: its name follows from its inputs, no file changed its size.

    A damaged description is that of no stage.
    """
    try:
        about = read_stage(folder / STAGE_FILE)
    except (OSError, ValueError):
        return False
    return folder.name == f"{about['name']}-{_key(about['name'], about.get('inputs', {}))}" and about.get(
        "files"
    ) == _sizes(folder)


def stage_generator(seed: int, purpose: str) -> torch.Generator:
    """A separate generator for each stage, so that reusing a stage does not change later ones."""
    digest = hashlib.sha256(f"{purpose}:{seed}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:7], "little"))


def digest_tensors(*tensors: Tensor) -> str:
    """SHA-256 over shapes, dtypes and values, in hexadecimal."""
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(f"{tuple(tensor.shape)}{tensor.dtype}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def digest_shape(gaussians: Gaussians) -> str:
    """SHA-256 of positions, rotations, sizes and opacities; and of an origin, and `antialiased`, where they are set."""
    shape = (getattr(gaussians, name) for name in SHAPE)
    facts = [*origin_tensors(gaussians.origin), *[torch.tensor(True)] * gaussians.antialiased]
    return digest_tensors(*shape, *facts)


def digest_cameras(cameras: Sequence[Camera]) -> str:
    """SHA-256 of poses, intrinsics, sizes and near planes."""
    rows = [tensor for camera in cameras for tensor in (camera.viewmat, camera.K)]
    facts = torch.tensor([[camera.width, camera.height, camera.near] for camera in cameras], dtype=torch.float64)
    return digest_tensors(*rows, facts, *(origin_tensors(cameras[0].origin) if cameras else ()))


def digest_scene(scene: Scene, views: Sequence[int]) -> str:
    """SHA-256 of some views' poses, intrinsics, sizes and near planes, and of the sparse points.

    Near planes count only if one is not at 0.2, so that runs of older versions without near planes stay valid.
    """
    cameras = [scene.cameras[i] for i in views]
    poses = torch.stack([camera.viewmat for camera in cameras])
    intrinsics = torch.stack([camera.K for camera in cameras])
    sizes = torch.tensor([camera.size for camera in cameras])
    near = torch.tensor([camera.near for camera in cameras], dtype=torch.float64)
    near_planes = [near] if (near != NEAR).any() else []
    return digest_tensors(poses, intrinsics, sizes, scene.points, *near_planes, *origin_tensors(scene.origin))


def origin_tensors(origin: Origin) -> list[Tensor]:  # each [3] float64
    """An origin for a digest or a file; none if it is zero, so that what was made before there were origins stays valid."""
    return [torch.tensor(origin, dtype=torch.float64)] if any(origin) else []


def digest_pictures(run: Run, scene: Scene, views: Sequence[int]) -> list[list[str]]:
    """[file name, SHA-256] of the picture of each view, a word if it may be transparent, and the SHA-256 of its mask, if any."""
    paths = [scene.image_paths[i] for i in views]
    clear = [has_alpha(path) for path in paths]  # they were on white before
    pictures = [[*row, "on black"] if one else row for row, one in zip(run.digests(paths), clear, strict=True)]
    masks = [None if scene.masks is None else scene.masks[i] for i in views]
    known = iter(run.digests([mask for mask in masks if mask is not None]))
    return [row if mask is None else [*row, next(known)[1]] for row, mask in zip(pictures, masks, strict=True)]


def describe_lens(lens: Camera) -> list[Any]:
    """The values that decide how a picture is undistorted."""
    return [lens.K.tolist(), lens.size, asdict(lens.distortion) if lens.distortion else None]
