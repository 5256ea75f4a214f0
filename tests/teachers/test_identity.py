import functools
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import kfgs
from kfgs.teachers.identity import code_identity, plain_options, weights_identity


def written(text, name="f", **known):
    """What a module of that text calls `name`."""
    names = {"torch": torch, "__name__": "mine", **known}
    exec(compile(text, "mine.py", "exec"), names)
    return names[name]


def code(text, name="f", **known):
    return code_identity(written(text, name, **known))["code"]


def test_where_a_function_lies():
    assert code_identity(Path.exists)["source"] == "pathlib:Path.exists"
    assert code_identity(functools.partial(written("def f(x): return x"), 1))["source"] == "mine:f"
    assert code_identity(written("class f:\n def __call__(self, x): return x")())["source"] == "mine:f"


BASE = "def f(x, k=3):\n    return x[:, ::2] * k + 1.5"


@pytest.mark.parametrize(
    "other",
    [
        "def f(x, k=3):\n    return x[:, ::4] * k + 1.5",  # a constant
        "def f(x, k=4):\n    return x[:, ::2] * k + 1.5",  # a default
        "def f(x, *, k=3):\n    return x[:, ::2] / k + 1.5",  # an operation
        "def f(x, k=3):\n    return x[:, ::2].relu() * k + 1.5",  # a name
        "def f(x, k=3):\n    return (lambda y: y - 1)(x[:, ::2] * k + 1.5)",
    ],
)
def test_another_code_is_noticed(other):
    assert code(other) != code(BASE)


@pytest.mark.parametrize(
    "same",
    [
        "\n\n# moved\n" + BASE,
        "def f(x, k=3):\n    # why\n    return x[:, ::2] * k + 1.5",
        BASE.replace(":\n", ":\n    'Says.'\n", 1),
    ],
)
def test_comments_docstrings_and_lines_do_not_count(same):
    assert code(same) == code(BASE)


def test_functions_are_seen_through_decorators_partials_and_within_functions():
    for text in ("@torch.no_grad()\ndef f(x): return x + {}", "def f(x):\n def g(y): return y + {}\n return g(x)"):
        assert code(text.format(1)) != code(text.format(2))
    add = written("def f(x, k): return x + k")
    assert code_identity(functools.partial(add, k=1))["code"] != code_identity(functools.partial(add, k=2))["code"]
    text = "class f:\n    cell = {}\n    @property\n    def a(self): return {}\n    @staticmethod\n    def b(x): return x + {}\n"
    codes = {code(text.format(*numbers)) for numbers in ((1, 1, 1), (2, 1, 1), (1, 2, 1), (1, 1, 2))}
    assert len(codes) == 4
    text = "class f:\n    mean = {}\n    kind = {}\n    sizes = {{'a': {}}}"
    kinds = ("torch.float16", "torch.float32")
    codes = {code(text.format(*v)) for v in (((1, 2), kinds[0], [1]), ((1, 3), kinds[0], [1]), ((1, 2), kinds[1], [1]))}
    assert len(codes | {code(text.format((1, 2), kinds[0], [2]))}) == 4
    text = "class f:\n    @cached\n    def a(self): return {}"
    codes = {code(text.format(number), cached=functools.cached_property) for number in (1, 2)}
    assert len(codes) == 2
    base = written("class base:\n    def a(self): return 1", "base")
    changed = written("class base:\n    def a(self): return 2", "base")
    child = "class f(base):\n    def b(self): return 1"
    assert code(child, base=base) != code(child, base=changed)
    assert code_identity(written(child, base=base)()) == code_identity(written(child, base=base))
    assert code_identity(torch.sin)["code"] != code_identity(torch.cos)["code"]


def test_what_is_not_noticed_is_as_documented():
    def make(factor):
        return lambda x: x * factor

    assert code_identity(make(1))["code"] == code_identity(make(2))["code"]


def test_digest_is_the_same_in_every_process():
    program = (
        "from kfgs.teachers.identity import code_identity\n"
        "def f(x):\n    return x if x in {'a', 'b', 'c', 'd'} else 0\n"
        "print(code_identity(f)['code'])"
    )
    found = {
        subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=600,
            env={"PYTHONHASHSEED": seed, "PYTHONPATH": str(Path(kfgs.__file__).parents[1]), "OMP_NUM_THREADS": "1"},
        ).stdout
        for seed in ("1", "2")
    }  # fmt: skip
    assert len(found) == 1
    assert len(found.pop().strip()) == 16


def test_weights_are_told_apart_by_content(tmp_path):
    file, folder = tmp_path / "w.pt", tmp_path / "w"
    file.write_bytes(b"abc")
    assert weights_identity(file) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-2
    (folder / "part").mkdir(parents=True)
    (folder / "part" / "a.bin").write_bytes(b"abc")
    first = weights_identity(str(folder))
    (folder / ".cache").write_bytes(b"x")
    assert weights_identity(folder) == first
    (folder / "part" / "a.bin").write_bytes(b"abd")
    assert weights_identity(folder) != first
    assert weights_identity("owner/name") == "owner/name"
    assert weights_identity(None) is None
    assert weights_identity("") is None  # not the folder in which the command runs


def test_options_become_json():
    class Odd:
        pass

    found = plain_options(
        {"size": (3, 4), "dtype": torch.float16, "bad": float("nan"), "odd": [Odd()], "by": {1: True}}
    )
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["size"] == [3, 4]
    assert found["dtype"] == "torch.dtype torch.float16"
    assert found["bad"] == "builtins.float nan"
    assert found["odd"][0].endswith("Odd")
    assert found["by"] == {"1": True}
