"""What a release needs: one version, a citation, an archive that holds what it names."""

import re
import tomllib
from pathlib import Path

import pytest

import kfgs

ROOT = Path(__file__).resolve().parents[1]


def test_the_version_stands_in_one_place():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" not in project["project"]
    assert project["tool"]["hatch"]["version"]["path"] == "kfgs/__init__.py"


@pytest.mark.parametrize(
    ("file", "line"), [("CITATION.cff", r"^version: (.+)$"), ("docs/compare.md", r"^  version = \{(.+)\},$")]
)
def test_files_that_repeat_the_version_have_the_same(file, line):
    assert re.findall(line, (ROOT / file).read_text(encoding="utf-8"), re.M) == [kfgs.__version__]


def test_the_changelog_has_a_section_for_the_version():
    assert re.search(rf"^## {re.escape(kfgs.__version__)}( |$)", (ROOT / "CHANGELOG.md").read_text(), re.M)


def test_all_that_the_source_archive_names_is_there():
    include = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["sdist"][
        "include"
    ]
    assert not [name for name in include if not list(ROOT.glob(name))]


def test_ci_builds_the_wheel_and_tries_it_alone():
    assert "bash .ci/wheel" in (ROOT / ".ci" / "run").read_text()
