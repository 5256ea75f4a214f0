import subprocess
import sys
from pathlib import Path


def test_compression_is_computed_on_the_device_of_the_caller():
    """In a process of its own: a device of torch cannot be taken back."""
    script = Path(__file__).parents[1] / "far_device.py"
    run = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
