import pytest
import torch
from cases_clouds import balls
from messages import refused

from kfgs.cli.edits import Edits, parse_edits
from kfgs.labels import Extract, Move, OfClass, Recolor, Remove, connected_parts


def read(**words):
    return parse_edits(Edits(**words))


def test_each_option_is_the_edit_it_says():
    assert read(recolor=["plant:#ff0080"]) == [Recolor(OfClass("plant"), (1.0, 0.0, 128 / 255))]
    assert read(move=["table:0.5,0,-2e-1"]) == [Move(OfClass("table"), (0.5, 0.0, -0.2))]
    assert read(remove=["window blind", "chair"]) == [Remove(OfClass("window blind")), Remove(OfClass("chair"))]
    both = Remove([OfClass("chair", 0), OfClass("chair", 1)], fill=True)
    assert read(remove=["chair/1", "rug", "chair/2:fill"]) == [both, Remove(OfClass("rug"))]
    assert read(extract=["rug", "sofa"]) == [Extract([OfClass("rug"), OfClass("sofa")])]


def test_the_order_does_not_depend_on_the_line():
    words = {"extract": ["a"], "remove": ["b"], "move": ["d:1,2,3"], "recolor": ["h:red", "i:blue"]}
    expected = ["recolor", "recolor", "move", "remove", "extract"]
    edits = read(**words)
    assert [edit.op for edit in edits] == expected
    assert [edit.where[0].name for edit in edits[:4]] == ["h", "i", "d", "b"]


def test_a_class_asked_in_other_case_is_removed_with_it():
    # Asked one after the other, the second would find nothing where they are one class.
    assert read(remove=["chair", "rug", "Chair"]) == [
        Remove([OfClass("chair"), OfClass("Chair")]),
        Remove(OfClass("rug")),
    ]


def test_a_number_behind_a_class_is_a_part_of_it():
    second = OfClass("chair", 1)
    assert read(recolor=["chair/2:red"]) == [Recolor(second, (1.0, 0.0, 0.0))]
    assert read(move=["chair/2:0.5,0,0"]) == [Move(second, (0.5, 0.0, 0.0))]
    assert read(extract=["chair/2", "rug"]) == [Extract([second, OfClass("rug")])]
    assert read(remove=["chair/2"]) == [Remove(second)]
    for name in ("tv/monitor", "chair/", "/2", "chair/-1", "chair/1.5"):
        assert read(remove=[name]) == [Remove(OfClass(name))]


def rows(*sizes):
    """A row of Gaussians of class 1 for each size, 0.1 apart; rows are 10 apart. Beside them a row of class 0."""
    means = torch.tensor([(10.0 * i, 0.1 * j, 0.0) for i, n in enumerate((*sizes, 40)) for j in range(n)])
    return balls(means, torch.arange(len(means)) < sum(sizes), names=("wall", "chair"))


def test_parts_are_numbered_as_select_lists_them():
    cloud = rows(20, 60, 40, 60)
    things = connected_parts(cloud, OfClass("chair").select(cloud))
    assert [thing.count for thing in things] == [60, 60, 40, 20]
    for number, thing in enumerate(things, start=1):
        (edit,) = read(extract=[f"Chair/{number}"])
        assert torch.equal(edit.apply(cloud).means, cloud.means[thing.indices])


def test_a_part_beyond_the_last_is_refused():
    (edit,) = read(remove=["chair/3"])
    refused(lambda: edit.apply(rows(20, 60)), "part:", "1 to 2", "got chair/3", "`kfgs select`")


def test_parts_that_are_removed_are_counted_together():
    cloud = rows(20, 60, 40, 50)
    (edit,) = read(remove=["chair/1", "chair/2"])
    left = edit.apply(cloud)
    assert torch.equal(left.means, torch.cat([cloud.means[:20], cloud.means[80:120], left.means[-40:]]))
    (edit,) = read(remove=["chair/1", "chair"])
    assert edit.apply(cloud).labels.unique().tolist() == [0]


def test_a_class_name_may_hold_a_colon():
    assert read(move=["a:b:1,0,0"]) == [Move(OfClass("a:b"), (1.0, 0.0, 0.0))]


@pytest.mark.parametrize(
    ("option", "words", "message"),
    [
        ("recolor", "plant", ("recolor:", "'plant:#c04040'", "got 'plant'")),
        ("recolor", ":red", ("recolor:", "got ':red'")),
        ("recolor", "plant:", ("recolor:", "got 'plant:'")),
        ("recolor", "plant:rde", ("recolor:", "got 'rde'")),
        ("recolor", "plant:#ff000080", ("recolor:", "got '#ff000080'")),
        ("move", "table:1,2", ("move:", "expected 3", "got 'table:1,2'")),
        ("move", "table:1,2,inf", ("move:", "expected 3", "got 'table:1,2,inf'")),
        ("remove", "chair/0", ("remove:", "got 'chair/0'", "'chair/1'")),
        ("move", "chair/00:1,0,0", ("move:", "got 'chair/00'", "'chair/1'")),
    ],
)
def test_other_words_are_refused_and_quoted(option, words, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(lambda: read(**{option: [words]}), *message)


def test_a_class_of_that_exact_name_wins_over_a_part():
    words = Edits(move=["chair/1/2:1,0,0"], remove=["Chair/1", "chair/2"])
    assert parse_edits(words, ["chair", "chair/1"]) == [
        Move(OfClass("chair/1", 1), (1.0, 0.0, 0.0)),
        Remove(OfClass("Chair/1")),
        Remove(OfClass("chair", 1)),
    ]
