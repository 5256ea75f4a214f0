"""`kfgs select`: which parts are listed."""

import re

import pytest
from small_room import make_desk

from kfgs import SemanticField, connected_parts
from kfgs.cli import main
from kfgs.labels.components import component_distance


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    return make_desk(tmp_path_factory.mktemp("desk"))


def said_of(desk, capsys, *words):
    assert main(["select", "chair", str(desk / "run" / "field.kfgs"), *words]) == 0
    return capsys.readouterr().out.splitlines()[1:]


def test_parts_that_are_not_listed_are_counted(desk, capsys):
    field = SemanticField.load(desk / "run" / "field.kfgs")
    listed = connected_parts(field.gaussians, field.query("chair"))
    *parts, joined, note = said_of(desk, capsys)
    distance = component_distance(field.gaussians.means, field.query("chair").mask)
    assert joined == f"  parts are joined within {distance:.3g}; --distance changes it"
    assert [int(re.search(r"Part\((\d+) ", line)[1]) for line in parts] == [part.count for part in listed]
    left = listed[0].total - len(listed)
    assert left > 0
    assert note == f"  {left} smaller part{'s are' if left > 1 else ' is'} not listed"


def test_the_distance_within_which_gaussians_are_one_part_can_be_given(desk, capsys):
    whole, joined = said_of(desk, capsys, "--distance", "100")
    field = SemanticField.load(desk / "run" / "field.kfgs")
    assert whole.startswith(f"  Part({len(field.query('chair'))} Gaussians")
    assert joined == "  parts are joined within 100; --distance changes it"
