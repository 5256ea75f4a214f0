"""Query, transfer, remove, recolour (Sec. 3.4): a question becomes an edit of the colour scene."""

import pytest
import torch

import kfgs
from kfgs.labels import OfClass, nearest_labels


@pytest.fixture(scope="module")
def labelled(fused, color, room):
    """The colour field with the semantic field's classes."""
    return kfgs.attach(fused, color, room.classes, by="distance").gaussians


def test_query(fused, room, recorded):
    selection = fused.query("chair", room.classes)
    assert selection.threshold == pytest.approx(recorded["gamma"], abs=1e-6)
    assert len(selection) == pytest.approx(recorded["Gaussians of the chair"], rel=0.02)
    cosine = fused.query("chair", room.classes, score="cosine")
    assert cosine.threshold == pytest.approx(recorded["gamma of the cosine"], abs=0.03)  # Intel 0.870, AMD 0.893
    parts = kfgs.connected_parts(fused.gaussians, selection, distance=0.15)
    assert 5 <= len(parts) <= recorded["chairs"]  # the room has five; on an Intel two backrests lie apart
    inside = fused.gaussians.means[parts[0].indices]
    low, high = parts[0].extent
    assert ((inside >= low - 1e-4) & (inside <= high + 1e-4)).all()


def test_transfer(fused, color, labelled, room, recorded):
    """A colour Gaussian takes the label of the nearest semantic one that is closer than lambda; checked by brute force."""
    semantic = fused.label(room.classes)
    carried = nearest_labels(semantic.means, semantic.labels, color.means)
    assert carried.distance == pytest.approx(recorded["lambda"], rel=0.02)
    assert carried.orphaned / len(color) == pytest.approx(recorded["share without a label"], abs=0.01)
    known = semantic.labels >= 0
    some = torch.arange(0, len(color), 7)
    apart = torch.cdist(color.means[some].double(), semantic.means[known].double())
    nearest, source = apart.min(1)
    expected = torch.where(nearest < carried.distance, semantic.labels[known][source], -1)
    clear = apart.topk(2, largest=False).values.diff(dim=1)[:, 0] > 1e-6  # not two equally near
    assert torch.equal(carried.labels[some][clear], expected[clear])
    assert torch.equal(labelled.labels, carried.labels)
    assert torch.equal(kfgs.transfer_labels(semantic, color).labels, carried.labels)


def test_remove_and_recolor(labelled, room, recorded):
    edits = kfgs.EditList().then(kfgs.Remove(OfClass("chair"))).then(kfgs.Recolor(OfClass("plant"), "#c04040"))
    edited = edits.apply(labelled)
    removed = len(labelled) - len(edited)
    assert removed == pytest.approx(recorded["Gaussians removed"], rel=0.03)
    chair, plant = (room.classes.index(name) for name in ("chair", "plant"))
    before, after = labelled, edited
    left = before.select(before.labels != chair)
    assert 0 < len(left) == len(after)
    assert torch.equal(after.means, left.means)
    rest = after.labels != plant
    assert torch.equal(after.sh[rest], left.sh[rest])  # nothing else changes
    red = after.sh[~rest][:, 0].mean(0)
    assert red[0] > red[1:].max() + 0.3
    score = kfgs.score_views(after, room.scene).psnr.value
    whole = kfgs.score_views(before, room.scene).psnr.value
    # A processor with other vectors rounds differently, and training takes another path: five seeds give 25.66 to 26.08.
    assert whole == pytest.approx(recorded["PSNR of the colour field"], abs=0.4)
    assert score == pytest.approx(recorded["PSNR of the edited field"], abs=0.4)


def test_ply_round_trip(labelled, room, tmp_path):
    """Labels, class names and every value come back from the file."""
    kfgs.write_splats(labelled, tmp_path / "room.ply")
    before, after = labelled, kfgs.read_splats(tmp_path / "room.ply")
    assert torch.equal(after.labels, before.labels)
    assert after.names == tuple(room.classes.names)
    torch.testing.assert_close(after.means, before.means, rtol=0, atol=0)
    for name in ("scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(after.quats.abs(), before.quats.abs(), rtol=0, atol=1e-6)
