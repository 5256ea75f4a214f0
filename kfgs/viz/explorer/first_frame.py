"""Whether the first frame of Gaussians is quick enough for sliders: what the style "auto" goes by."""

from __future__ import annotations

import os
from collections.abc import Callable
from time import perf_counter, process_time
from typing import Any

SLOW = 1.0  # seconds a frame from which "auto" draws points: a slider that follows later feels broken
SURE = 150_000  # Gaussians that "auto" draws without looking at the clock: half a second in software


class FirstFrame:
    """Looks at the clock for one frame of a window, and calls a function if that was slow.

    Args:
        window: VTK's render window.
        count: of the Gaussians drawn in it.
        on_slow: what to do then.
    """

    def __init__(self, window: Any, count: int, on_slow: Callable[[], None]) -> None:
        self.waits = False  # for a frame to be judged
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
        # in software all cores draw; other programs on them do not count
        if self.unsure and min(wall, work / (os.cpu_count() or 1)) > SLOW:
            self._on_slow()
