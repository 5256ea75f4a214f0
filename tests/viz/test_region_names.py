import numpy as np
import pytest
from kfgs.viz.region_names import write_region_names
from messages import tells


def test_names_are_written_inside_large_regions_only():
    labels = np.full((120, 300), -1)
    labels[:, :150] = 0
    labels[10:40, 200:300] = 1
    labels[100:104, 160:290] = 2  # too narrow for its name
    paper = np.full((120, 300, 3), 90, np.uint8)
    drawn = write_region_names(paper, labels, ["wall", "lamp", "shelf"])
    changed = (drawn != paper).any(axis=-1)
    assert changed[:, :150].sum() > 50
    assert changed[10:40, 200:].sum() > 50
    assert changed.sum() == changed[:, :150].sum() + changed[10:40, 200:].sum()
    assert (paper == 90).all()
    rows, columns = np.nonzero(changed[:, :150])
    assert abs(rows.mean() - 60) < 8  # in the middle
    assert abs(columns.mean() - 75) < 8
    assert np.array_equal(write_region_names(paper, labels, ["a", "b", "c"], least=1.0), paper)


def test_names_stay_in_the_picture():
    labels = np.zeros((40, 60), int)
    drawn = write_region_names(np.zeros((40, 60, 3), np.uint8), labels, ["sofa"])
    assert drawn.any()
    assert not drawn[:, [0, -1]].any()


def test_wrong_input_is_named():
    with pytest.raises(ValueError, match=tells("names:", "got 1")):
        write_region_names(np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), int), ["a"])
    with pytest.raises(ValueError, match=tells("labels", "(3, 4)")):
        write_region_names(np.zeros((4, 4, 3), np.uint8), np.ones((3, 4), int), ["a", "b"])
