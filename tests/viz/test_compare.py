"""Which viewpoints show an edit, and the pictures of it."""

import math

import numpy as np
import torch
from cases_clouds import balls
from PIL import Image

from kfgs.cameras import Camera
from kfgs.gaussians import Gaussians
from kfgs.labels import Selection, connected_parts
from kfgs.splat.rasterize import render_color
from kfgs.viz.compare import views_of_change, write_comparison
from kfgs.viz.films import WIDTH, write_parts


def ball(*places, color=(1.0, 0.0, 0.0), scale=0.3):
    sh = ((torch.tensor(color) - 0.5) / 0.28209479177387814).expand(len(places), 1, 3).clone()
    return balls(places, scale=scale, opacity=1.0, sh=sh)


def camera(degrees, name="a.png", size=(48, 64)):
    """At the origin, looking in the plane y = 0 at `degrees` from +z towards +x."""
    a = math.radians(degrees)
    viewmat = torch.eye(4)
    viewmat[0, :3] = torch.tensor([math.cos(a), 0.0, -math.sin(a)])
    viewmat[2, :3] = torch.tensor([math.sin(a), 0.0, math.cos(a)])
    height, width = size
    return Camera(viewmat, torch.tensor([[60.0, 0, width / 2], [0, 60, height / 2], [0, 0, 1]]), width, height, name)


def changed_share(before, after, camera):
    """The share of the small picture in which an edit shows."""
    small = camera.resized(72, 96)
    pictures = (render_color(cloud, small) for cloud in (before, after))
    return float(((next(pictures) - next(pictures)).abs().amax(-1) > 8 / 255).float().mean())


def views_of_edits(states, cameras, count=2):
    return views_of_change(states[0], states[-1], cameras, count, between=states[1:-1])


AHEAD, RIGHT = (0.0, 0.0, 5.0), (5.0, 0.0, 0.0)


def test_views_that_show_more_come_first_and_others_never():
    before, after = ball(AHEAD, RIGHT), ball(RIGHT)
    cameras = [camera(180), camera(28), camera(0), camera(20)]
    shares = [changed_share(before, after, one) for one in cameras]
    assert shares[3] > shares[2] > shares[1] > shares[0] == 0  # off the middle a ball looks larger, till it is cut off
    assert views_of_change(before, after, cameras, 1) == [3]
    assert views_of_change(before, after, cameras, 9) == [3, 2, 1]
    assert views_of_change(before, before, cameras, 9) == []
    assert views_of_change(before, after, cameras, 0) == []
    assert views_of_change(before, after, [], 3) == []


def test_the_second_view_looks_another_way():
    before, after = ball(AHEAD, RIGHT), ball((0.0, 0.0, 50.0))
    cameras = [camera(0), camera(2), camera(75), camera(90)]
    chosen = views_of_change(before, after, cameras, 2)
    assert len({min(i, 2) // 2 for i in chosen}) == 2  # one of the first two, one of the last two


def test_each_edit_gets_a_view_before_any_gets_two():
    large, plain = ball(AHEAD, (0.6, 0.0, 5.0)), ball(RIGHT, scale=0.1)
    green = ball(RIGHT, scale=0.1, color=(0.0, 1.0, 0.0))
    before, after = Gaussians.cat([large, plain]), green
    cameras = [camera(0), camera(-31), camera(2), camera(90)]
    assert views_of_change(before, after, cameras, 2) == [0, 1]  # both of the large change, before the small one
    painted_first, removed_first = [before, Gaussians.cat([large, green]), after], [before, plain, after]
    for count, expected in ((0, []), (1, [3]), (2, [3, 0]), (3, [3, 0, 1]), (9, [3, 0, 1, 2])):
        assert views_of_edits(painted_first, cameras, count) == expected
    assert views_of_edits(removed_first, cameras, 2) == [0, 3]


def test_an_edit_that_is_undone_gets_no_view():
    before, away, red = ball(AHEAD, RIGHT), ball(AHEAD), ball(RIGHT, AHEAD, color=(0.0, 1.0, 0.0))
    cameras = [camera(0), camera(90)]
    assert views_of_edits([before, away, before], cameras) == []
    assert views_of_edits([before, away, before, red], cameras[:1]) == [0]


def test_the_comparison_holds_both_renderings(tmp_path):
    before, after = ball(AHEAD), ball(AHEAD, color=(0.0, 1.0, 0.0))
    path = write_comparison(tmp_path / "new" / "a.png", before, after, [camera(0)])
    picture = np.asarray(Image.open(path))
    assert path == tmp_path / "new" / "a.png"
    left, right = ((render_color(cloud, camera(0)) * 255).round().numpy() for cloud in (before, after))
    bottom = picture.shape[0] - 6
    np.testing.assert_allclose(picture[bottom - 48 : bottom, 6:70], left, atol=1)
    np.testing.assert_allclose(picture[bottom - 48 : bottom, 76:140], right, atol=1)
    assert picture.shape == (bottom + 6, 146, 3)


def test_each_part_is_drawn_in_its_own_view(tmp_path):
    cloud = ball((0.0, 0, 2), (0.0, 0, -2), (9.0, 0, 0), scale=0.2)
    selection = Selection.of(torch.tensor([True, True, False]), "by hand")
    views = [camera(0, "front.png", (60, 80)), camera(180, "back.png", (60, 80))]
    parts = connected_parts(cloud, selection, views, distance=0.5)
    seen = []

    def under(camera):
        seen.append(camera.name)
        return np.full((camera.height, camera.width, 3), 120, np.uint8)

    write_parts(tmp_path / "a.png", cloud, parts, views, under, "ball")
    assert sorted(seen) == ["back.png", "front.png"]
    with Image.open(tmp_path / "a.png") as picture:
        drawn = np.asarray(picture)
    assert abs(drawn.shape[1] - 2 * WIDTH) < 30
    middle = drawn.shape[0] // 2 + 10
    for center in (WIDTH // 2, 3 * WIDTH // 2):
        assert drawn[middle, center].tolist() == [120] * 3  # the part keeps its colour
    assert (drawn[middle, 20] > 200).all()
    write_parts(tmp_path / "b.png", cloud, connected_parts(cloud, selection), views, under, "ball")
    assert not (tmp_path / "b.png").exists()
