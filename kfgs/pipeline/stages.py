"""A run folder of finished stages, each named by the digest of its inputs.

A stage is a function that fills a folder. Its name and the JSON of its inputs give a key. A folder with that key is reused.
Otherwise the stage is made in a hidden folder and moved into place in one step, and never changed. So a killed run leaves
only finished stages, and the same call continues where it stopped.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._arrays import reading
from .._check import Progress
from .._files import atomic_folder, digest_file, digest_value, read_json, real_path, write_json
from .._origin import Origin
from ..cameras import Camera
from ..fields.train import digest_tensors
from ..gaussians import Gaussians
from ..scenes import Scene

STAGE_FILE, LOCK, DIGESTS = "stage.json", ".run.lock", "digests.json"
STAGE_VERSION = 4
"""Part of every key: raised if the same inputs give another result in a new version, so that old stages are not reused."""


@dataclass(frozen=True)
class Stage:
    """A finished stage: its files, and how it was made."""

    name: str
    folder: Path
    seconds: float
    inputs: dict[str, Any]

    @property
    def key(self) -> str:
        """What later stages that depend on it have among their inputs."""
        return self.folder.name.rpartition("-")[2]


@dataclass
class Run:
    """The stages of one run folder, in the order of use.

    Example:
        >>> import tempfile, pathlib
        >>> run = Run(pathlib.Path(tempfile.mkdtemp()))
        >>> first = run.stage("hello", {"who": "world"}, lambda folder: (folder / "a").write_text("hello"))
        >>> again = run.stage("hello", {"who": "world"}, lambda folder: None)
        >>> again == first, (again.folder / "a").read_text()
        (True, 'hello')
    """

    folder: Path
    report: Callable[[str], None] | None = None
    seed: int = 0
    progress: Progress = False
    stages: list[Stage] = field(default_factory=list)

    def stage(self, name: str, inputs: dict[str, Any], make: Callable[[Path], float | None]) -> Stage:
        """Return the finished stage of these inputs (all that decides the result, as JSON); make it if it does not exist.

        `make` fills the given folder, and may return the seconds of work by an earlier, killed process.
        """
        target = self._place("stages", name, inputs)
        finished = (target / STAGE_FILE).is_file()
        if not finished:
            self.say(f"{name}: working")
            start = time.perf_counter()
            with atomic_folder(target) as folder:
                earlier = make(folder) or 0.0
                seconds = time.perf_counter() - start + earlier
                write_json(folder / STAGE_FILE, {"name": name, "inputs": inputs, "seconds": seconds})
        stage = read_stage(target)
        took = f"{stage.seconds:.1f} s"
        self.say(f"{name}: found in {target.name} (made in {took})" if finished else f"{name}: done in {took}")
        self.stages.append(stage)
        return stage

    def finished(self, name: str) -> list[Stage]:
        """All finished stages of a name in the folder."""
        return [read_stage(file.parent) for file in sorted((self.folder / "stages").glob(f"{name}-*/{STAGE_FILE}"))]

    def scratch(self, name: str, inputs: dict[str, Any]) -> Path:
        """A path for the unfinished work of a stage (checkpoints), kept until the stage is done."""
        return self._place("unfinished", name, inputs)

    def _place(self, kind: str, name: str, inputs: dict[str, Any]) -> Path:
        key = digest_value({"name": name, "inputs": inputs, "version": STAGE_VERSION})[:12]
        return self.folder / kind / f"{name}-{key}"

    def digests(self, paths: Sequence[Path]) -> list[list[str]]:
        """[file name, SHA-256] of each file; files of unchanged size and times are not read again."""
        file = self.folder / DIGESTS
        try:
            known = dict(read_json(file))
        except (OSError, ValueError, TypeError):  # none yet, or damaged: it is made again
            known = {}
        result, before = [], len(known)
        for path in paths:
            about = path.stat()
            mark = f"{real_path(path)} {about.st_size} {about.st_mtime_ns} {about.st_ctime_ns}"
            if not isinstance(known.get(mark), str):
                known[mark] = digest_file(path)
            result.append([path.name, known[mark]])
        if len(known) > before:
            write_json(file, known)
        return result

    def generator(self, name: str) -> torch.Generator:
        """A separate generator for each stage, so that reusing a stage does not change later ones."""
        digest = hashlib.sha256(f"{name}:{self.seed}".encode()).digest()
        return torch.Generator().manual_seed(int.from_bytes(digest[:7], "little"))

    def say(self, text: str) -> None:
        """Report a line, if anyone listens."""
        if self.report is not None:
            self.report(text)


def read_stage(folder: Path) -> Stage:
    """A finished stage; a ValueError if its description is damaged."""
    about = read_json(folder / STAGE_FILE)
    with reading(folder / STAGE_FILE, "the description of a stage", "delete its folder, and it will be made again"):
        return Stage(str(about["name"]), folder, float(about["seconds"]), dict(about["inputs"]))


def digest_shape(gaussians: Gaussians) -> str:
    """SHA-256 of positions, rotations, sizes and opacities, and of an origin and `antialiased` where they are set."""
    shape = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    return digest_tensors(*shape, *origin_tensors(gaussians.origin), *[torch.tensor(True)] * gaussians.antialiased)


def digest_cameras(cameras: Sequence[Camera]) -> str:
    """SHA-256 of poses, intrinsics, sizes and near planes."""
    rows = [tensor for camera in cameras for tensor in (camera.viewmat, camera.K)]
    facts = torch.tensor([[camera.width, camera.height, camera.near] for camera in cameras], dtype=torch.float64)
    return digest_tensors(*rows, facts, *(origin_tensors(cameras[0].origin) if cameras else ()))


def digest_scene(scene: Scene, views: Sequence[int]) -> dict[str, str]:
    """SHA-256 of some views' cameras, and of the sparse points."""
    cameras = digest_cameras([scene.cameras[i] for i in views])
    return {"cameras": cameras, "points": digest_tensors(scene.points, *origin_tensors(scene.origin))}


def origin_tensors(origin: Origin) -> list[Tensor]:  # each [3] float64
    """An origin for a digest or a file; none if it is zero."""
    return [torch.tensor(origin, dtype=torch.float64)] if any(origin) else []


def digest_pictures(run: Run, scene: Scene, views: Sequence[int]) -> dict[str, Any]:
    """What decides the training pictures of some views: files, masks, and the lenses that are removed."""
    masks = {i: mask for i, mask in enumerate(scene.masks or ()) if mask is not None and i in views}
    return {
        "files": run.digests([scene.image_paths[i] for i in views]),
        "masks": [[i, *row] for i, row in zip(masks, run.digests(list(masks.values())), strict=True)],
        "lenses": None if scene.lenses is None else [describe_lens(scene.lenses[i]) for i in views],
    }


def describe_lens(lens: Camera) -> list[Any]:
    """The values that decide how a picture is undistorted."""
    return [lens.K.tolist(), lens.size, asdict(lens.distortion) if lens.distortion else None]
