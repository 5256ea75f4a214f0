import json
import math

import pytest
import torch
from cases_clouds import balls
from messages import refused, tells

from kfgs.cameras import Camera
from kfgs.labels import Selection, connected_parts
from kfgs.splat import rasterize


def camera(z=0.0, name="", turned=False, width=40, height=32):
    E = torch.eye(4)
    if turned:  # looks along -z
        E[0, 0] = E[2, 2] = -1
    E[2, 3] = z if turned else -z  # the centre lies at (0, 0, z)
    K = torch.tensor([[40.0, 0, width / 2], [0, 40, height / 2], [0, 0, 1]])
    return Camera(E, K, width, height, name)


def scene():
    """Two rows of balls at z = 4, five on the left and four on the right, and one behind the left ones."""
    left = [[-1.0, 0.2 * i, 4.0] for i in range(5)]
    right = [[1.0, 0.2 * i, 4.0] for i in range(4)]
    made = balls([*left, *right, [-1.2, 0.4, 4.9]], sh=torch.zeros(10, 1, 3))
    return made.replace(opacities=torch.full((10,), 0.95), scales=torch.full((10, 3), 0.12))


def chosen(gaussians, n=9):
    scores = torch.linspace(0.9, 0.1, len(gaussians))
    return Selection(torch.arange(len(gaussians)) < n, scores, 0.05, "given")


def whole(gaussians, selection, cameras=None):
    """All selected Gaussians as one part."""
    return connected_parts(gaussians, selection, cameras, distance=100.0)[0]


def test_a_selection_in_numbers():
    gaussians = scene()
    part = whole(gaussians, chosen(gaussians, 5))
    assert (part.count, part.total, part.indices.tolist()) == (5, 1, [0, 1, 2, 3, 4])
    assert part.centroid.tolist() == pytest.approx([-1, 0.4, 4])
    assert part.score == pytest.approx(float(torch.linspace(0.9, 0.1, 10)[:5].mean()))
    assert [corner.tolist() for corner in part.extent] == [pytest.approx([-1, 0, 4]), pytest.approx([-1, 0.8, 4])]
    assert (2 * part.box.half).tolist() == pytest.approx([0.8, 0, 0], abs=1e-6)
    assert part.box.axes[0].abs().tolist() == pytest.approx([0, 1, 0], abs=1e-6)
    assert part.best_view is None


def test_parts_largest_first():
    gaussians = scene()
    found = connected_parts(gaussians, chosen(gaussians), distance=0.3)
    assert [part.indices.tolist() for part in found] == [[0, 1, 2, 3, 4], [5, 6, 7, 8]]
    assert [part.how for part in found] == ["given; part 1 of 2", "given; part 2 of 2"]
    assert found[1].centroid.tolist() == pytest.approx([1, 0.3, 4])
    assert len(connected_parts(gaussians, chosen(gaussians), distance=3.0)) == 1
    assert len(connected_parts(gaussians, chosen(gaussians).mask, distance=3.0)) == 1
    assert len(connected_parts(gaussians, chosen(gaussians), distance=0.3, most=1)) == 1
    assert len(connected_parts(gaussians, chosen(gaussians), distance=0.3, smallest=5)) == 1
    specks = balls([[0.05 * i, 0.0, 4.0] for i in range(60)] + [[9.0, 9 + 0.05 * i, 4.0] for i in range(3)])
    for n, smallest, counts in (
        (63, None, [60, 3]),
        (62, None, [60]),
        (62, 1, [60, 2]),
    ):  # by default 5 % of the largest
        rule = {} if smallest is None else {"smallest": smallest}
        found = connected_parts(specks[:n], Selection.of(torch.ones(n, dtype=torch.bool)), distance=0.1, **rule)
        assert [part.count for part in found] == counts
    nothing = Selection(torch.zeros(10, dtype=torch.bool), torch.zeros(10), 0.7, "given")
    assert connected_parts(gaussians, nothing, [camera()]) == []


def test_the_nearer_camera_sees_it_best_and_the_one_behind_not_at_all():
    gaussians = scene()
    views = [camera(0, "far"), camera(1, "near"), camera(6, "away"), camera(0, "back", turned=True)]
    best = whole(gaussians, chosen(gaussians), views).best_view
    assert (best.camera, best.index) == ("near", 1)
    assert 0.02 < best.share < 1
    assert whole(gaussians, chosen(gaussians), views[2:]).best_view is None
    far = whole(gaussians, chosen(gaussians), views[:1]).best_view.share
    assert 1.5 < best.share / far < 16 / 9  # (4 / 3)^2, less the low-pass filter


def test_shares_add_up_to_the_picture_and_know_what_hides():
    gaussians = scene()
    everything = Selection.of(torch.ones(10, dtype=torch.bool))
    parts = connected_parts(gaussians, everything, [camera()], distance=0.3, smallest=1)
    shares = [part.best_view.share for part in parts]
    picture = float(rasterize(gaussians, camera()).alpha.mean())
    assert sum(shares) == pytest.approx(picture, rel=1e-5)
    assert whole(gaussians, everything, [camera()]).best_view.share == pytest.approx(picture, rel=1e-5)
    ball = gaussians.select(torch.tensor([9]))  # it stands behind the left row
    alone = whole(ball, Selection.of(torch.tensor([True])), [camera()]).best_view.share
    assert shares[2] < 0.3 * alone


def test_a_part_in_words_and_as_json():
    gaussians = scene()
    part = whole(gaussians, chosen(gaussians, 5), [camera(name="front")])
    plain = json.loads(json.dumps(part.to_json(), allow_nan=False))
    assert (plain["count"], plain["indices"]) == (5, [0, 1, 2, 3, 4])
    assert plain["best_view"] == {"camera": "front", "index": 0, "share": pytest.approx(part.best_view.share)}
    assert "5 Gaussians at (-1, 0.4, 4)" in repr(part)
    assert "of 'front'" in repr(part)
    assert whole(gaussians, chosen(gaussians)).to_json()["best_view"] is None


def test_wrong_input_is_named():
    gaussians = scene()
    with pytest.raises(ValueError, match=tells("selection.mask:", "[N]", "N = 10", "gaussians.means", "got (4,)")):
        connected_parts(gaussians, Selection.of(torch.ones(4, dtype=torch.bool)))
    broken = gaussians.replace(means=gaussians.means.clone().index_fill_(0, torch.tensor([1]), math.nan))
    refused(lambda: connected_parts(broken, chosen(gaussians)), "means:", "got NaN", "row 1")
    refused(lambda: connected_parts(gaussians, chosen(gaussians), most=0), "most:", "got 0")
    refused(lambda: connected_parts(gaussians, chosen(gaussians), distance=0), "distance:", "(0, inf)", "got 0")
