import signal
import subprocess
import sys
from pathlib import Path

import pytest
from messages import tells

from kfgs.scenes import SceneError
from kfgs.scenes.colmap import quiet_pycolmap

PROGRAM = """
import os, signal, sys
import kfgs.scenes
assert "pycolmap" not in sys.modules, "kfgs.scenes must not load pycolmap before it is needed"
from kfgs.scenes.colmap import import_pycolmap
import_pycolmap()
import numpy as np
from PIL import Image
noise = np.random.default_rng(0).integers(0, 255, (700, 500, 3), dtype=np.uint8)
noise[:, 100:300] = 7
for i in range(3):
    Image.fromarray(noise).save(f"{sys.argv[1]}/{i}.png")
print("saved", flush=True)
os.kill(os.getpid(), signal.SIGTERM)
"""


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """A process of its own, which loads pycolmap, writes pictures, and is asked to end."""
    command = [sys.executable, "-c", PROGRAM, str(tmp_path_factory.mktemp("pictures"))]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)


def test_pillow_can_write_png_after_pycolmap(ended):
    assert ended.stdout == "saved\n", ended.stderr[-500:]


def test_a_process_that_is_asked_to_end_says_nothing(ended):
    assert ended.returncode == -signal.SIGTERM
    assert ended.stderr == ""  # pycolmap's log library would print a stack


def test_pycolmap_failures_become_quiet_pycolmap(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=tells("x:", "a model", "(IndexError: unordered_map::at)", "do this")):  # noqa: SIM117
        with quiet_pycolmap("x: expected a model", "do this"):
            raise IndexError("unordered_map::at")
    with pytest.raises(SceneError, match=tells("MemoryError: no text")), quiet_pycolmap("x", "y"):
        raise MemoryError
    with pytest.raises(KeyboardInterrupt), quiet_pycolmap("x", "y"):
        raise KeyboardInterrupt
