"""`kfgs select`: which parts are listed."""

import re

import pytest
import torch
from small_room import make_desk

from kfgs import Gaussians, SemanticField, connected_parts
from kfgs.cli import main
from kfgs.cli.output import lengths_odd
from kfgs.formats import write_splats
from kfgs.labels.components import component_distance


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    return make_desk(tmp_path_factory.mktemp("desk"))


def said_of(desk, capsys, *words):
    assert main(["select", "chair", str(desk / "run" / "field.kfgs"), *words]) == 0
    return capsys.readouterr().out.splitlines()[1:]


def test_parts_that_are_not_listed_are_counted(desk, capsys):
    field = SemanticField.load(desk / "run" / "field.kfgs")
    every = connected_parts(field.gaussians, field.query("chair"), smallest=1)
    listed = connected_parts(field.gaussians, field.query("chair"))
    assert {part.total for part in (*every, *listed)} == {len(every)}
    assert 1 <= len(listed) < len(every) < 100
    *parts, joined, note = said_of(desk, capsys)
    distance = component_distance(field.gaussians.means, field.query("chair").mask)
    assert joined == f"  parts are joined within {distance:.3g}; --distance changes it"
    assert len(parts) == len(listed)
    left = len(every) - len(listed)
    assert note.startswith(f"  {left} smaller part{'s are' if left > 1 else ' is'} not listed; --smallest 1 ")
    *parts, _ = said_of(desk, capsys, "--smallest", "1")
    assert [int(re.search(r"Part\((\d+) ", line)[1]) for line in parts] == [part.count for part in every]
    assert said_of(desk, capsys, "--smallest", "1000000") == [
        "  no part has 1000000 Gaussians; give a smaller --smallest"
    ]


def test_the_distance_within_which_gaussians_are_one_part_can_be_given(desk, capsys):
    whole, joined = said_of(desk, capsys, "--smallest", "1", "--distance", "100")
    field = SemanticField.load(desk / "run" / "field.kfgs")
    assert whole.startswith(f"  Part({len(field.query('chair'))} Gaussians")
    assert joined == "  parts are joined within 100; --distance changes it"


def test_a_part_that_may_be_two_things_is_marked(tmp_path, capsys):
    """Boxes of 1, 1, 1.5 and 2.25 units: only the last is more than 1.6 times as long as the median, 1.25."""
    x = torch.cat([start + torch.linspace(0, long, 11) for start, long in ((0, 1), (10, 1), (20, 1.5), (30, 2.25))])
    means = torch.stack([x, torch.zeros(44), torch.zeros(44)], dim=1)
    many = Gaussians(means, torch.tensor([[1.0, 0, 0, 0]]).repeat(44, 1), torch.full((44, 3), 0.1), torch.ones(44))
    many = many.replace(labels=torch.zeros(44, dtype=torch.int64), sh=torch.zeros(44, 1, 3))
    write_splats(many.replace(names=("chair",)), tmp_path / "a.ply")
    words = ["select", "chair", str(tmp_path / "a.ply"), "--distance", "1"]
    assert main(words) == 0
    parts = [line for line in capsys.readouterr().out.splitlines() if "Part(" in line]
    marked = [line.partition(" ? ")[2] for line in parts]
    assert sorted(marked) == ["", "", "", "(1.8 times as long as the median: two in one?)"]
    assert "at (31.1," in parts[[bool(one) for one in marked].index(True)]


def test_two_parts_have_no_median_to_compare_with():
    assert lengths_odd([1.0, 9.0]) == [None, None]
    assert lengths_odd([]) == []
    assert lengths_odd([0.0, 0.0, 1.0]) == [None] * 3
