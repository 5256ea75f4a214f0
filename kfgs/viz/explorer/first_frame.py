"""Time the first frame of Gaussians: style "auto" draws points if it is slow."""

from __future__ import annotations

import os
from collections.abc import Callable
from time import perf_counter, process_time
from typing import Any

SLOW = 1.0  # seconds per frame; with slower frames a slider feels broken
SURE = 150_000  # up to so many Gaussians "auto" does not measure: they take half a second in software


class FirstFrame:
    """Times one frame of a VTK window, and calls `on_slow` if it took longer than `SLOW`.

    Args:
        window: VTK's render window.
        count: number of Gaussians drawn in it.
        on_slow: called after a slow frame.
    """

    def __init__(self, window: Any, count: int, on_slow: Callable[[], None]) -> None:
        self.waits = False  # whether the next frame is timed
        self._window, self._on_slow = window, on_slow
        self.unsure = count > SURE
        self._began = 0.0, 0.0
        window.AddObserver("StartEvent", self._begins)
        window.AddObserver("EndEvent", self._ends)

    def _begins(self, *_: Any) -> None:
        self._began = perf_counter(), process_time()

    def _ends(self, *_: Any) -> None:
        if not self.waits:
            return
        self.waits = False
        self._window.WaitForCompletion()
        wall, work = perf_counter() - self._began[0], process_time() - self._began[1]
        # software rendering uses all cores; the CPU time per core leaves out the load of other programs
        if self.unsure and min(wall, work / (os.cpu_count() or 1)) > SLOW:
            self._on_slow()
