"""What is done with each scene of a batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from dataclasses import field as default
from pathlib import Path
from typing import Any

from .._check import check_whole
from .._files import as_path
from .._notes import is_strict
from ..pipeline import Paper, Uplift
from ..scenes import SfmConfig


@dataclass(frozen=True)
class BatchOptions:
    """Options of `run_batch`, the same for all scenes. Workers receive them, so they hold paths and plain values."""

    teacher: str | None = None
    """Name of the network that makes feature maps, see `load_teacher`; None: each scene has its maps in `features/`."""
    weights: str | None = None
    """Of the teacher: a file or folder that every worker can read, or a hub id."""
    teacher_options: Mapping[str, Any] = default(default_factory=dict)
    """Of the teacher."""
    sfm: SfmConfig = default(default_factory=SfmConfig)
    """For folders of photos without poses; `num_threads` follows `threads`."""
    method: Uplift | Paper = default(default_factory=Uplift)
    """How fields are made."""
    split: str = "train"
    """The split of training views."""
    seed: int = 0
    """Every random choice follows from it."""
    device: str = "auto"
    """Where to train, see `fit`."""
    text: str | None = None
    """Text table of `kfgs text` for all scenes; None: each scene's `classes.json` and `text.npy` or `text.safetensors`."""
    pictures: int = 4
    """How many views of a scene get a sheet, an overlay and a feature picture."""
    share: int = 8
    """Pictures that a worker encodes in one task; a killed worker loses at most these."""
    threads: int = 1
    """Threads of each task. Equal numbers of threads give equal bits, however many workers there are."""
    discard_features: bool = False
    """Delete a scene's feature maps when its field is made."""
    strict: bool = default(default_factory=is_strict)
    """Refuse scenes of which something broken would be left out (`--strict`): workers do not hear the command line."""

    def __post_init__(self) -> None:
        check_whole("share", self.share, 1)
        check_whole("threads", self.threads, 1)
        check_whole("pictures", self.pictures, 0)
        for name in ("weights", "text"):  # workers run in other folders
            given = getattr(self, name)
            if given is not None and as_path(given).exists():
                object.__setattr__(self, name, str(as_path(given).absolute()))
        if self.discard_features and isinstance(self.method, Paper) and self.method.codebook is None:
            raise ValueError(
                "discard_features: expected False for mode 'decouple', which learns from the maps, got True; leave out"
            )

    @property
    def sfm_config(self) -> SfmConfig:
        """`sfm` with the number of threads: one thread makes the same model every time."""
        return replace(self.sfm, num_threads=self.threads)


@dataclass(frozen=True)
class Job:
    """A scene as its tasks receive it."""

    source: str
    """A folder or URL."""
    out: str
    """The run's folder or URL."""
    options: BatchOptions

    @property
    def text_file(self) -> Path | None:
        """The text table for all scenes."""
        return None if self.options.text is None else Path(self.options.text)
