import numpy as np
import pytest

from kfgs.toy.geometry import Places, Solid, Texture
from kfgs.toy.light import LAMPS, lamps_seen, openness

SKIN = Texture("plaster", ((0.5, 0.5, 0.5), (0.6, 0.6, 0.6)))
LAMP = LAMPS[0]
UP = np.array([0.0, 0.0, 1.0])


def piece(shape, z=1.0, half=(0.3, 0.3, 0.1), yaw=0.4):
    """A piece of furniture straight under the first lamp."""
    return Solid(shape, (LAMP.place[0], LAMP.place[1], z), half, yaw, "table", SKIN)


def on_floor(distances):
    """Places on the floor, so far to the side of the lamp."""
    return np.array([[LAMP.place[0] + x, LAMP.place[1], 0.0] for x in distances])


def facing_up(points, which=-1):
    return Places(points, np.broadcast_to(UP, points.shape), np.full(len(points), which))


@pytest.mark.parametrize("shape", ["box", "ellipsoid"])
def test_a_shadow_is_dark_in_its_middle_soft_at_its_edge_and_ends(shape):
    solid = piece(shape, half=(0.45, 0.45, 0.1))
    points = on_floor([0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 2.0])
    seen = lamps_seen([solid], facing_up(points))[:, 0]
    assert seen[0] < 0.02
    assert seen[-1] == 1.0
    assert (np.diff(seen) >= -1e-9).all()
    assert ((seen > 0.05) & (seen < 0.95)).any()


def test_no_solid_shades_itself_and_walls_cast_no_shadow():
    table = piece("box")
    top = np.array([[LAMP.place[0], LAMP.place[1], 1.1]])
    assert lamps_seen([table], facing_up(top, 0))[0, 0] == 1.0
    assert lamps_seen([table], facing_up(top - [0, 0, 1.0]))[0, 0] < 0.02
    wall = Solid("box", table.center, table.half, table.yaw, "wall", SKIN)
    assert lamps_seen([wall], facing_up(top - [0, 0, 1.0]))[0, 0] == 1.0


@pytest.mark.parametrize("shape", ["box", "ellipsoid"])
def test_corners_and_places_beside_furniture_are_less_open(shape):
    beside, near, far = openness([piece(shape, z=0.3, half=(0.3, 0.3, 0.3))], facing_up(on_floor([0.31, 0.5, 2.0])))
    assert beside < near < far
    dark, light = openness([], facing_up(np.array([[-2.9, -2.4, 0.0], [0.0, 0.0, 0.0]])))
    assert dark < 0.8 < light <= 1.0
