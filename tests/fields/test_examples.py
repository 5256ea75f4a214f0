"""Classes by examples: what is drawn to find the features that they show."""

from dataclasses import replace

import pytest
import torch
from cases_blobs import COUNT, scene

from kfgs import Camera, SemanticField, label_set_from_examples
from kfgs.fields import Box, Clicks, Picked
from kfgs.fields.examples import LONGEST, Mask

FIELD = scene([("chair", 0.0), ("lamp", 0.0)])
(VIEW,) = (camera for camera in FIELD.cameras if camera.name == "at the chair")  # 40 x 30; the chair is in its middle


def shown(times, field=FIELD):
    """The same three examples in a view so many times as large."""
    small = torch.zeros(30, 40, dtype=torch.bool)
    small[13:18, 18:25] = True
    mask = small.repeat_interleave(times, 0).repeat_interleave(times, 1)
    view = VIEW.resized(30 * times, 40 * times)
    box = [times * edge for edge in (18, 13, 25, 18)]
    return {"a": Clicks(view, [[20.5 * times, 15.5 * times]]), "b": Box(view, box), "c": Mask(view, mask)}


def test_a_huge_view_is_drawn_small_and_says_the_same(monkeypatch):
    plain, sizes, render = label_set_from_examples(FIELD, shown(1)), [], SemanticField.render
    monkeypatch.setattr(SemanticField, "render", lambda self, camera: sizes.append(camera.size) or render(self, camera))
    monkeypatch.setattr("kfgs.fields.examples.LONGEST", 40)
    large = label_set_from_examples(FIELD, shown(8))
    assert sizes == [(30, 40)] * 3
    assert torch.equal(large.embeddings, plain.embeddings)
    assert LONGEST >= 4096  # photographs of usual size are drawn as they are


def test_a_stored_camera_of_more_pixels_than_any_picture_is_refused(tmp_path):
    huge = replace(VIEW, width=20_000, height=20_000)
    replace(FIELD, cameras=(huge,)).save(tmp_path / "field.kfgs")
    with pytest.raises(ValueError, match=r"134,217,728 pixels.*20,000 x 20,000"):
        SemanticField.load(tmp_path / "field.kfgs")
    assert isinstance(huge, Camera)
    assert len(FIELD) == 2 * COUNT


@pytest.mark.parametrize(
    "wrong",
    [
        Clicks("no such view", [[1, 1]]),
        Clicks(VIEW, [[1, 1000]]),
        Box(VIEW, [5, 5, 4, 4]),
        Mask(VIEW, torch.ones(3, 3, dtype=torch.bool)),
        Picked([10**6]),
    ],
)
def test_all_examples_are_checked_before_the_first_view_is_rendered(wrong, monkeypatch):
    monkeypatch.setattr(SemanticField, "render", lambda self, camera: pytest.fail("rendered"))
    with pytest.raises(ValueError, match=r"examples\['z'\]\[1\]"):
        label_set_from_examples(FIELD, {**shown(1), "z": [Clicks(VIEW, [[20, 15]]), wrong]})
