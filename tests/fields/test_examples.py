"""Classes by examples: what is drawn to find the features that they show."""

import pytest
import torch
from cases_blobs import scene

from kfgs import label_set_from_examples
from kfgs.fields import Box, Clicks, Mask

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


def test_clicks_boxes_masks_and_gaussians_find_the_chair():
    made = label_set_from_examples(FIELD, {**shown(1), "d": torch.tensor([0, 1])})
    cosines = made.embeddings @ made.embeddings.T
    assert made.names == ("a", "b", "c", "d")
    assert float(cosines.min()) > 0.9  # all show the chair
    assert made.info["examples"] == {"a": 1, "b": 1, "c": 1, "d": 1}
    large = label_set_from_examples(FIELD, shown(2))
    assert float((large.embeddings * made.embeddings[:3]).sum(1).min()) > 0.99


@pytest.mark.parametrize(
    "wrong",
    [
        Clicks("no such view", [[1, 1]]),
        Clicks(VIEW, [[1, 1000]]),
        Box(VIEW, [5, 5, 4, 4]),
        Mask(VIEW, torch.ones(3, 3, dtype=torch.bool)),
        torch.tensor([10**6]),
    ],
)
def test_wrong_examples_are_named(wrong):
    with pytest.raises((ValueError, IndexError), match=r"examples\['z'\]\[1\]|out of bounds"):
        label_set_from_examples(FIELD, {**shown(1), "z": [Clicks(VIEW, [[20, 15]]), wrong]})
