import os
import sys
from pathlib import Path

import pytest

from kfgs.splat.engines import table

DEEPBIND = getattr(os, "RTLD_DEEPBIND", 0)


@pytest.mark.skipif(not DEEPBIND, reason="the flag is glibc's")
@pytest.mark.parametrize(
    ("maps", "added"), [("7f00 /usr/lib/libLLVM-15.so.1", DEEPBIND), ("7f00 /usr/lib/libc.so.6", 0)]
)
def test_engines_keep_to_their_own_symbols_only_beside_another_llvm(monkeypatch, maps, added):
    """That it saves Python from a segfault is shown by tests/viz/test_headless.py."""
    before, real = sys.getdlopenflags(), Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda path, **_: maps if str(path).startswith("/proc") else real(path))
    with table._own_symbols():
        assert sys.getdlopenflags() == before | added
    assert sys.getdlopenflags() == before
