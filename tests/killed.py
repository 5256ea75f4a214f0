"""Kill a process before each of its calls to the file system, one after the other."""

import subprocess
import sys
from pathlib import Path

SCRIPT = """
import os, pathlib, signal, sys
names = {}
exec(sys.argv[1], names)
base = pathlib.Path(sys.argv[2])
for kill_at in range(100_000):
    folder = base / f"{kill_at:05d}"
    folder.mkdir()
    names["prepare"](folder)
    child = os.fork()
    if child == 0:
        calls = 0
        def hook(event, arguments):
            global calls
            if event == "open" or event.startswith(("os.", "fcntl.", "shutil.", "tempfile.")):
                calls += 1
                if calls == kill_at + 1:  # os.kill is an event, too
                    os.kill(os.getpid(), signal.SIGKILL)
        sys.addaudithook(hook)
        names["work"](folder)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code != -signal.SIGKILL:
        sys.exit(code)
"""


def kill_everywhere(code: str, base: Path) -> list[Path]:
    """Run `prepare(folder)`, and `work(folder)` in a process that is killed before its first, second, ... call.

    Args:
        code: defines both functions.
        base: an empty folder; it gets a folder for each kill.

    Returns:
        The folders, in the order of the kills; in the last one, `work` came to its end.
    """
    base.mkdir()
    subprocess.run([sys.executable, "-c", SCRIPT, code, str(base)], check=True, timeout=250)
    return sorted(base.iterdir())
