import json

import numpy as np
import pytest
import torch
from cases_explorer import NAMES, cameras, field, line
from cases_explorer import classes as some_classes
from messages import tells

from kfgs.formats import read_splats
from kfgs.labels import connected_parts
from kfgs.viewer import saved
from kfgs.viewer.meaning import FieldMeaning
from kfgs.viewer.state import Exploration


def test_a_selection_is_saved_and_read_again(tmp_path):
    semantic = field().gaussians
    color = semantic.replace(features=None, sh=torch.rand(80, 1, 3), means=semantic.means + 0.01)
    made = Exploration(FieldMeaning(field(), some_classes(), cameras=cameras()), color, cameras=cameras())
    made.ask("chair")
    made.set_hidden([1])
    paths = made.save_selection(tmp_path / "new" / "folder")
    names = ["selection.json", "selection_color.ply", "selection_color.ply.classes.json"]
    assert [path.name for path in paths] == [*names, *(name.replace("color", "semantic") for name in names[1:])]
    assert sorted((tmp_path / "new" / "folder").iterdir()) == paths
    for side in made.sides:
        read, mask = read_splats(tmp_path / "new" / "folder" / f"selection_{side}.ply"), made.selected(side)
        assert read.names == NAMES
        assert read.gaussians.labels.tolist() == made.labels(side)[mask].tolist()
        torch.testing.assert_close(read.gaussians.means, made.cloud(side).means[mask])
        np.testing.assert_allclose(read.scores, made.scores(side)[mask], rtol=1e-6)
    facts = json.loads(paths[0].read_text())
    assert {key: value for key, value in facts.items() if key != "parts"} == made.details()
    expected = connected_parts(made.cloud("color"), made.selection("color"), cameras())
    assert facts["parts"]["color"] == [part.to_json() for part in expected]
    assert facts["parts"]["color"][0]["best_view"]["camera"].startswith("view_")


def test_the_best_view_is_named_by_its_place_among_all(tmp_path, monkeypatch):
    monkeypatch.setattr(saved, "MOST_VIEWS", 1)
    views = cameras(3)
    made = line(cameras=[views[1], views[0]])
    made.ask("chair")
    whole = json.loads(made.save_selection(tmp_path)[0].read_text())["parts"]["semantic"][0]["best_view"]
    assert (whole["index"], whole["camera"]) == (0, "view_1")
    monkeypatch.setattr(saved, "MOST_VIEWS", 2)
    monkeypatch.setattr(saved, "evenly", lambda count, most: np.array([1]))
    other = json.loads(made.save_selection(tmp_path)[0].read_text())["parts"]["semantic"][0]["best_view"]
    assert (other["index"], other["camera"]) == (1, "view_0")


def test_nothing_selected_writes_nothing(tmp_path):
    made = line()
    with pytest.raises(ValueError, match=tells("selection:", "got none", "question")):
        made.save_selection(tmp_path / "out")
    made.ask("chair")
    made.set_gamma(0.9)
    with pytest.raises(ValueError, match=tells("selection:", "got none", "0.9", "'chair'")):
        made.save_selection(tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match=tells("selection:", "expected a question", "got none")):
        line().selection("color")


def test_saving_whole_or_not_at_all(tmp_path, monkeypatch):
    made, write = line(), saved.write_splats
    made.ask("chair")
    first = made.save_selection(tmp_path)
    before = {path: path.read_bytes() for path in first}

    def fail(path, splats):
        if "color" in path.name:
            raise OSError("disk full")
        return write(path, splats)

    made.ask("table")
    monkeypatch.setattr(saved, "write_splats", fail)
    with pytest.raises(OSError, match="disk full"):
        made.save_selection(tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    with pytest.raises(OSError, match="disk full"):
        made.save_selection(tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_files_of_an_older_selection_do_not_stay(tmp_path):
    made = line()
    (tmp_path / "picture.png").write_bytes(b"mine")
    made.ask("chair")
    made.save_selection(tmp_path)
    made.set_distance(1e-6)  # now nothing of the colour side is selected
    paths = made.save_selection(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*(p.name for p in paths), "picture.png"])
    assert not any("color" in path.name for path in paths)
