"""The examples in the docstrings are true: each module of kfgs that has some is run."""

import doctest
import importlib
from pathlib import Path

import pytest

import kfgs

ROOT = Path(kfgs.__file__).parent
MODULES = sorted(
    "kfgs." + path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".").removesuffix(".__init__")
    for path in ROOT.rglob("*.py")
    if ">>>" in path.read_text(encoding="utf-8")
)


def test_there_are_examples():
    assert {"kfgs._check", "kfgs.nn", "kfgs.metrics"} <= set(MODULES)


@pytest.mark.parametrize("name", MODULES)
def test_examples(name):
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted > 0
    assert result.failed == 0
