import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from threading import Event, Thread

import pytest

from kfgs.splat.engines import table

DEEPBIND = getattr(os, "RTLD_DEEPBIND", 0)


@pytest.mark.skipif(not DEEPBIND, reason="the flag is glibc's")
@pytest.mark.parametrize(
    ("maps", "added"), [("7f00 /usr/lib/libLLVM-15.so.1", DEEPBIND), ("7f00 /usr/lib/libc.so.6", 0)]
)
def test_engines_keep_to_their_own_symbols_only_beside_another_llvm(monkeypatch, maps, added):
    before, real = sys.getdlopenflags(), Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda path, **_: maps if str(path).startswith("/proc") else real(path))
    with table._own_symbols():
        assert sys.getdlopenflags() == before | added
    assert sys.getdlopenflags() == before


@pytest.mark.skipif(not DEEPBIND, reason="the flag is glibc's")
def test_two_threads_that_load_at_once_leave_the_flags_as_they_were(monkeypatch):
    """Without a lock the second saves the flags of the first, and puts them back for good."""
    before, real = sys.getdlopenflags(), Path.read_text
    maps = "7f00 /usr/lib/libLLVM-15.so.1"
    monkeypatch.setattr(Path, "read_text", lambda path, **_: maps if str(path).startswith("/proc") else real(path))
    inside = Event()

    def second():
        with table._own_symbols():
            inside.set()

    thread = Thread(target=second)
    with table._own_symbols():
        thread.start()
        assert not inside.wait(0.2)  # it waits for the first
    thread.join(10)
    after = sys.getdlopenflags()
    sys.setdlopenflags(before)  # or a failure here would reach the other tests
    assert (after, inside.is_set()) == (before, True)


@pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed")
def test_triton_is_loaded_before_a_picture_is_drawn():
    """If torch's optimisers load it after Mesa's LLVM and pycolmap, Python ends with a segfault (notebook 6)."""
    code = "import sys; from kfgs import splat; splat.available_engines('cpu'); assert 'triton' in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
