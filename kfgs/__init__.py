"""Decoupled semantic fields of 3-D Gaussians: distil, compress, segment, label, edit.

The public names are in `__init__.pyi`. Each is imported when it is first used, so that `import kfgs` is quick and works on a
headless machine.
"""

import os
import sys

import lazy_loader

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def _one_thread_after_a_fork() -> None:
    """Keep torch to one thread in a forked child: the others of its parent are not there, and it would wait for them."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_one_thread_after_a_fork)
