"""What a release needs: one version, a citation, an archive that holds what it names."""

import re
import tomllib
from pathlib import Path

import kfgs

ROOT = Path(__file__).resolve().parents[1]


def test_the_version_stands_in_one_place():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" not in project["project"]
    assert project["tool"]["hatch"]["version"]["path"] == "kfgs/__init__.py"
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.M)
    assert cited is not None
    assert cited[1] == kfgs.__version__


def test_the_changelog_has_a_section_for_the_version():
    assert re.search(rf"^## {re.escape(kfgs.__version__)}( |$)", (ROOT / "CHANGELOG.md").read_text(), re.M)


def test_all_that_the_source_archive_names_is_there():
    include = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["sdist"][
        "include"
    ]
    assert not [name for name in include if not list(ROOT.glob(name))]


def test_ci_builds_the_wheel_and_tries_it_alone():
    assert "bash .ci/wheel" in (ROOT / ".ci" / "run").read_text()
