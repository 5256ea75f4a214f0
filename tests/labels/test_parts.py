import json
import math

import pytest
import torch
from messages import tells

from kfgs.cameras import Camera, Similarity
from kfgs.gaussians import Gaussians
from kfgs.labels import Selection, connected_parts, describe_selection, view_shares
from kfgs.splat import rasterize, transform_gaussians


def camera(z=0.0, name="", turned=False, width=40, height=32):
    E = torch.eye(4)
    if turned:  # looks along -z
        E[0, 0] = E[2, 2] = -1
    E[2, 3] = z if turned else -z  # the centre lies at (0, 0, z)
    K = torch.tensor([[40.0, 0, width / 2], [0, 40, height / 2], [0, 0, 1]])
    return Camera(E, K, width, height, name)


def balls(means, opacity=0.95, scale=0.12):
    means = torch.tensor(means)
    n = len(means)
    colours = torch.zeros(n, 1, 3)
    return Gaussians(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.full((n, 3), scale),
        torch.full((n,), opacity),
        sh=colours,
    )


def scene():
    """Two rows of balls at z = 4, five on the left and four on the right, and one behind the left ones."""
    left = [[-1.0, 0.2 * i, 4.0] for i in range(5)]
    right = [[1.0, 0.2 * i, 4.0] for i in range(4)]
    return balls([*left, *right, [-1.2, 0.4, 4.9]])


def chosen(gaussians, n=9):
    scores = torch.linspace(0.9, 0.1, len(gaussians))
    return Selection(torch.arange(len(gaussians)) < n, scores, 0.05, "given")


def test_a_selection_in_numbers():
    gaussians = scene()
    found = describe_selection(gaussians, chosen(gaussians, 5))
    assert found.count == 5
    assert found.indices.tolist() == [0, 1, 2, 3, 4]
    assert found.centroid.tolist() == pytest.approx([-1, 0.4, 4])
    assert found.score == pytest.approx(float(torch.linspace(0.9, 0.1, 10)[:5].mean()))
    assert [corner.tolist() for corner in found.extent] == [
        pytest.approx([-1, 0, 4]),
        pytest.approx([-1, 0.8, 4]),
    ]
    assert (2 * found.box.half).tolist() == pytest.approx([0.8, 0, 0], abs=1e-6)
    assert found.box.axes[0].abs().tolist() == pytest.approx([0, 1, 0], abs=1e-6)
    assert found.volume == pytest.approx(0, abs=1e-6)
    assert found.best_view is None
    assert found.how == "given"


def test_parts_largest_first():
    gaussians = scene()
    found = connected_parts(gaussians, chosen(gaussians), distance=0.3)
    assert [one.indices.tolist() for one in found] == [[0, 1, 2, 3, 4], [5, 6, 7, 8]]
    assert [one.how for one in found] == ["given; part 1 of 2", "given; part 2 of 2"]
    assert found[1].centroid.tolist() == pytest.approx([1, 0.3, 4])
    assert len(connected_parts(gaussians, chosen(gaussians), distance=3.0)) == 1
    assert len(connected_parts(gaussians, chosen(gaussians), distance=0.3, most=1)) == 1
    assert len(connected_parts(gaussians, chosen(gaussians), distance=0.3, smallest=5)) == 1


def test_specks_are_left_out_unless_asked_for():
    n = 60
    gaussians = balls([*[[0.05 * i, 0.0, 4.0] for i in range(n)], [9.0, 9.0, 4.0], [9.05, 9.0, 4.0], [9.1, 9.0, 4.0]])
    everything = Selection.of(torch.ones(n + 3, dtype=torch.bool))
    assert [one.count for one in connected_parts(gaussians, everything, distance=0.1)] == [60, 3]  # 5 % of 60 is kept
    gaussians = gaussians.select(torch.arange(n + 2))
    everything = everything.mask[: n + 2]
    assert [one.count for one in connected_parts(gaussians, Selection.of(everything), distance=0.1)] == [60]
    assert [one.count for one in connected_parts(gaussians, Selection.of(everything), distance=0.1, smallest=1)] == [
        60,
        2,
    ]


def test_nothing_selected_has_no_parts():
    gaussians = scene()
    nothing = Selection(torch.zeros(10, dtype=torch.bool), torch.zeros(10), 0.7, "given")
    assert connected_parts(gaussians, nothing, [camera()]) == []
    with pytest.raises(ValueError, match=tells("selection:", "got none", "score > 0.7")):
        describe_selection(gaussians, nothing)


def test_the_nearer_camera_sees_it_best_and_the_one_behind_not_at_all():
    gaussians = scene()
    views = [camera(0, "far"), camera(1, "near"), camera(6, "away"), camera(0, "back", turned=True)]
    found = describe_selection(gaussians, chosen(gaussians), views)
    assert (found.best_view.camera, found.best_view.index) == ("near", 1)
    assert 0.02 < found.best_view.share < 1
    assert describe_selection(gaussians, chosen(gaussians), views[2:]).best_view is None
    seen = view_shares(gaussians, [torch.arange(9)], views)
    assert seen[2:, 0].tolist() == [0, 0]
    assert 1.5 < seen[1, 0] / seen[0, 0] < 16 / 9  # (4 / 3)^2, less the low-pass filter


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_the_best_view_is_the_same_in_every_frame(scale):
    gaussians, views = scene(), [camera(0, "far"), camera(1, "near")]
    moved = Similarity(scale, torch.eye(3), torch.tensor([1.0, -2.0, 3.0]))
    there = transform_gaussians(gaussians, moved)
    expected = describe_selection(gaussians, chosen(gaussians), views).best_view
    found = describe_selection(there, chosen(there), [moved.apply_to_camera(view) for view in views]).best_view
    assert (found.camera, found.index) == ("near", 1)
    assert found.share == pytest.approx(expected.share, rel=1e-3)


def test_shares_add_up_to_the_picture_and_know_what_hides():
    gaussians = scene()
    parts = [torch.arange(5), torch.arange(5, 9), torch.tensor([9]), torch.arange(10)]
    shares = view_shares(gaussians, parts, [camera()])[0]
    whole = rasterize(gaussians, camera()).alpha.mean()
    assert float(shares[:3].sum()) == pytest.approx(float(whole), rel=1e-5)
    assert float(shares[3]) == pytest.approx(float(whole), rel=1e-5)
    hidden = float(shares[2])  # the last ball stands behind the left row
    alone = float(view_shares(gaussians.select(torch.tensor([9])), [torch.tensor([0])], [camera()])[0, 0])
    assert hidden < 0.3 * alone


def test_more_parts_than_one_rendering_holds():
    gaussians = scene()
    parts = [torch.tensor([i]) for i in range(10)]
    views = [camera(), camera(1)]
    at_once = view_shares(gaussians, parts, views)
    assert at_once.shape == (2, 10)
    singles = torch.stack([view_shares(gaussians, [part], views)[:, 0] for part in parts], dim=1)
    torch.testing.assert_close(at_once, singles)
    many = view_shares(gaussians, parts * 2, views)  # 20 parts: two renderings
    torch.testing.assert_close(many, torch.cat([at_once, at_once], dim=1))


def test_large_pictures_are_compared_small():
    gaussians = scene()
    large, small = camera(width=400, height=320), camera(width=400, height=320).resized(128, 160)
    parts = [torch.arange(9)]
    assert view_shares(gaussians, parts, [large]).equal(view_shares(gaussians, parts, [small]))


def test_parts_are_selections_of_the_whole_cloud():
    gaussians = scene()
    asked = chosen(gaussians)
    left, right = (one.selection(len(gaussians)) for one in connected_parts(gaussians, asked, distance=0.3))
    assert left.indices.tolist() == [0, 1, 2, 3, 4]
    assert right.indices.tolist() == [5, 6, 7, 8]
    assert left.scores.tolist() == [1.0] * 5 + [0.0] * 5
    assert (left.threshold, left.how) == (None, "given; part 1 of 2")
    assert not left & right
    assert (left | right).mask.equal(asked.mask)
    again = asked & left  # the question's own scores
    assert again.mask.equal(left.mask)
    assert again.scores[:5].equal(asked.scores[:5])
    assert describe_selection(gaussians, again).score == pytest.approx(float(asked.scores[:5].mean()))


def test_a_part_fits_no_smaller_cloud():
    gaussians = scene()
    one = describe_selection(gaussians, chosen(gaussians, 5))
    assert len(one.selection(5).mask) == 5
    with pytest.raises(ValueError, match=tells("count:", "more than 4", "got 4")):
        one.selection(4)
    with pytest.raises(ValueError, match=tells("count:", "got 5.0")):
        one.selection(5.0)


def test_json_round_trip():
    gaussians = scene()
    found = describe_selection(gaussians, chosen(gaussians, 5), [camera(name="front")])
    plain = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert plain["count"] == 5
    assert plain["indices"] == [0, 1, 2, 3, 4]
    assert plain["best_view"] == {"camera": "front", "index": 0, "share": pytest.approx(found.best_view.share)}
    assert set(plain) - set(found.to_json(indices=False)) == {"indices"}
    assert "5 Gaussians at (-1, 0.4, 4)" in repr(found)
    assert "of 'front'" in repr(found)
    assert describe_selection(gaussians, chosen(gaussians)).to_json()["best_view"] is None


def test_wrong_input_is_named():
    gaussians = scene()
    with pytest.raises(ValueError, match=tells("selection.mask:", "[N]", "N = 10", "gaussians.means", "got (4,)")):
        describe_selection(gaussians, Selection.of(torch.ones(4, dtype=torch.bool)))
    with pytest.raises(ValueError, match=tells("selection.mask:", "[N]", "N = 10", "got (4,)")):
        connected_parts(gaussians, Selection.of(torch.ones(4, dtype=torch.bool)))
    broken = gaussians.replace(means=gaussians.means.clone().index_fill_(0, torch.tensor([1]), math.nan))
    with pytest.raises(ValueError, match=tells("gaussians.means:", "got NaN", "row 1")):
        describe_selection(broken, chosen(gaussians))
    with pytest.raises(ValueError, match=tells("most:", "got 0")):
        connected_parts(gaussians, chosen(gaussians), most=0)
