"""The floors of the house: which file may import which, read from the source without running it."""

import ast
import functools
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import kfgs

ROOT = Path(kfgs.__file__).parent

# From the bottom up. Places of one row never import each other; evaluation lies under pipeline, which scores with it.
FLOORS = (
    {"_card"},
    {"_check", "_files", "_interrupts", "_notes", "_rows"},
    {"_arrays", "_origin"},
    {"gaussians", "cameras"},
    {"splat", "quant", "metrics"},
    {"formats"},
    {"scenes", "labels"},
    {"toy", "nn"},
    {"teachers", "fields", "viz"},
    {"viewer"},
    {"evaluation"},
    {"pipeline"},
    {"batch"},
    {""},  # kfgs/__init__.py, the public names
    {"cli"},
    {"__main__"},
)
FLOOR = {place: floor for floor, places in enumerate(FLOORS) for place in places}
TYPES_ONLY = {("viz", "fields"), ("viewer", "fields")}  # viz may take a field as an argument

THIRD_PARTY = {
    name: f"kfgs/{folder}/"
    for folder, names in {
        "scenes": "pycolmap", "viz": "pyvista vtk vtkmodules trame_vtk", "splat/engines": "numba llvmlite triton",
        "teachers": "transformers tokenizers huggingface_hub", "viewer": "IPython anywidget traitlets",
        "batch": "dask distributed dask_jobqueue",
    }.items()
    for name in names.split()
}  # fmt: skip


@dataclass(frozen=True)
class Import:
    file: str  # "kfgs/viz/clouds.py"
    line: int
    module: str  # absolute: "kfgs.fields.start", "numpy"
    types_only: bool


def place(module: str) -> str:
    """The part of the house a module of kfgs lies in: "kfgs.splat.tiles" -> "splat"."""
    return module.split(".")[1] if "." in module else ""


def module_of(file: str) -> str:
    return file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def read_imports(file: str, source: str, modules: set[str]) -> Iterator[Import]:
    """All imports of a file, wherever they stand; `from . import name` means the module `name` if there is one."""
    tree = ast.parse(source)
    guarded = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and "TYPE_CHECKING" in ast.unparse(block.test)
        for statement in block.body
        for node in ast.walk(statement)
    }
    package = module_of(file) if file.endswith("/__init__.py") else module_of(file).rpartition(".")[0]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            told = [a.value for a in node.args[:1] if isinstance(a, ast.Constant) and isinstance(a.value, str)]
            names = [f"{package}{name}" if name.startswith(".") else name for name in told]
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            names = [f"{base}.{a.name}" if f"{base}.{a.name}" in modules else base for a in node.names]
        else:
            continue
        for name in dict.fromkeys(names):
            yield Import(file, node.lineno, name, id(node) in guarded)


def breaches(imports: list[Import]) -> list[str]:
    """What the house forbids, in words."""
    found = []
    for entry in imports:
        here, top = place(module_of(entry.file)), entry.module.split(".")[0]
        if top == "kfgs":
            there = place(entry.module)
            excused = entry.types_only and (here, there) in TYPES_ONLY
            if there not in FLOOR or here not in FLOOR:
                found.append(f"{entry.file}:{entry.line} {here!r} or {there!r} has no floor")
            elif here != there and FLOOR[there] >= FLOOR[here] and not excused:
                found.append(f"{entry.file}:{entry.line} imports {entry.module}, which is not on a lower floor")
        elif top in THIRD_PARTY and not entry.file.startswith(THIRD_PARTY[top]):
            found.append(f"{entry.file}:{entry.line} imports {top}, whose place is {THIRD_PARTY[top]}")
    return found


@functools.cache
def house() -> tuple[list[Import], set[str]]:
    files = {f"kfgs/{path.relative_to(ROOT).as_posix()}": path for path in sorted(ROOT.rglob("*.py"))}
    modules = {module_of(file) for file in files}
    imports = [
        entry for file, path in files.items() for entry in read_imports(file, path.read_text(encoding="utf-8"), modules)
    ]
    return imports, modules


def check(file: str, source: str) -> list[str]:
    return breaches(list(read_imports(file, source, {"kfgs", "kfgs.metrics", "kfgs.fields", "kfgs.fields.start"})))


def test_every_file_imports_only_from_lower_floors():
    imports, modules = house()
    assert len(imports) > 50
    assert {place(module) for module in modules} <= set(FLOOR)
    assert breaches(imports) == []


def test_no_file_imports_a_later_file_of_its_package():
    """Imports at run time can be put in an order, so every file stands on earlier ones; `import_module` counts, too."""
    imports, modules = house()
    hidden = Import("kfgs/formats/encodings.py", 1, "kfgs.formats.table", False)
    assert list(read_imports(hidden.file, 'import_module(".table", __package__)', modules)) == [hidden]
    graph: dict[str, set[str]] = {module: set() for module in modules}
    for entry in imports:
        if entry.module in modules and not entry.types_only and entry.module != module_of(entry.file):
            graph[module_of(entry.file)].add(entry.module)
    TopologicalSorter(graph).prepare()
    with pytest.raises(CycleError):
        TopologicalSorter({"a": {"b"}, "b": {"a"}}).prepare()


@pytest.mark.parametrize(
    ("file", "source", "message"),
    [
        ("kfgs/splat/tiles.py", "from ..quant import Codebook", "imports kfgs.quant"),
        ("kfgs/gaussians.py", "from kfgs import Scene", "imports kfgs,"),
        ("kfgs/quant/codebook.py", "importlib.import_module('kfgs.fields.start')", "imports kfgs.fields.start"),
        (
            "kfgs/labels/edit.py",
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ..fields import start",
            "imports kfgs.fields.start",
        ),
        ("kfgs/attic/old.py", "from .. import metrics", "'attic' or 'metrics' has no floor"),
        ("kfgs/labels/edit.py", "import pyvista as pv", "imports pyvista, whose place is kfgs/viz/"),
        ("kfgs/viz/clouds.py", "def f():\n    from pycolmap import Camera", "imports pycolmap, whose place is kfgs/sc"),
    ],
)
def test_a_breach_is_found(file, source, message):
    found = check(file, source)
    assert len(found) == 1
    assert message in found[0]
    assert found[0].startswith(f"{file}:{len(source.splitlines())} ")


def test_importing_kfgs_loads_nothing_heavy():
    """All packages whose names a user meets first import without the optional and the slow libraries."""
    packages = sorted(module for module in house()[1] if module.count(".") == 1 and module != "kfgs.__main__")
    light = {"triton", "traitlets"}  # torch may look at triton
    heavy = sorted({*THIRD_PARTY, "matplotlib", "skimage.segmentation"} - light)
    script = f"import {', '.join(packages)}, sys; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=600)
    assert (result.stdout.strip(), result.stderr) == ("[]", "")
