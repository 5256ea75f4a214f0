"""What the package shows to the world: names, their documentation, the README's commands."""

import importlib
import inspect
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

import kfgs

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = [
    "kfgs.cameras", "kfgs.evaluation",
    "kfgs.fields", "kfgs.formats", "kfgs.labels", "kfgs.metrics", "kfgs.nn", "kfgs.pipeline",
    "kfgs.quant", "kfgs.batch", "kfgs.scenes", "kfgs.splat", "kfgs.teachers", "kfgs.toy", "kfgs.viewer", "kfgs.viz",
]  # fmt: skip


@pytest.mark.parametrize("name", kfgs.__all__)
def test_every_public_name_imports_and_is_documented(name):
    value = getattr(kfgs, name)
    assert inspect.getdoc(value)
    assert name in dir(kfgs)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_name_of_a_package_exists_and_functions_are_documented(package):
    module = importlib.import_module(package)
    assert module.__doc__
    for name in module.__all__:
        value = getattr(module, name)
        if inspect.isfunction(value) or inspect.isclass(value):
            assert inspect.getdoc(value), f"{package}.{name}"


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="fit_everything"):
        _ = kfgs.fit_everything


def test_import_kfgs_is_quick_because_it_loads_nothing():
    code = "import sys, kfgs; print(sorted({'torch', 'numpy', 'pyvista', 'pycolmap', 'numba', 'kornia'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def test_ci_runs_the_readmes_commands_as_written():
    readme, ci = (ROOT / "README.md").read_text(), (ROOT / ".ci" / "run").read_text()
    commands = [
        "pip install -c constraints.txt torch==2.13.0 . && kfgs demo",
        'pip install -c constraints.txt torch==2.13.0 ".[test]" && python -m pytest',
    ]
    for command in commands:
        assert f"```bash\n{command}\n```" in readme
        assert f"\n{command}" in ci


def test_the_package_stays_small():
    root = Path(kfgs.__file__).parent
    files = [path for path in root.rglob("*") if path.is_file() and path.suffix not in (".pyc", ".nbi", ".nbc", ".md")]
    # As a wheel packs them: each has two headers and a line with its digest; licence and description are 11 kB more.
    packed = {
        path: len(zlib.compress(path.read_bytes())) + 2 * len(str(path.relative_to(root))) + 130 for path in files
    }
    assert sum(packed.values()) + 11_000 < 1_380_000, sorted(packed, key=packed.__getitem__)[-5:]
