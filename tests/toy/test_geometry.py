import numpy as np
import pytest
import torch
from oracles_toy import first_hit as first_hit_by_steps

from kfgs.cameras.camera import Camera
from kfgs.toy.geometry import Solid, Texture, cast, first_hit, intersect, places_on, sample_surface, visible

SKIN = Texture("plaster", ((0.5, 0.5, 0.5), (0.6, 0.6, 0.6)))


def solid(shape="box", center=(0.0, 0.0, 0.0), half=(1.0, 1.0, 1.0), yaw=0.0) -> Solid:
    return Solid(shape, center, half, yaw, "wall", SKIN)


def camera(height=12, width=16) -> Camera:
    K = torch.tensor([[15.0, 0, 8.7], [0, 14.0, 5.4], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[2, 3] = 6.0  # looks along +z from z = -6
    return Camera(viewmat, K, width, height)


def rays_of(view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The camera's centre and the ray through the centre of each pixel, 1 long along the optical axis."""
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    return np.array([0, 0, -6.0]), np.stack([(x - 8.7) / 15.0, (y - 5.4) / 14.0, np.ones_like(x)], -1)


def test_solids_behind_or_around_the_origin_are_not_hit():
    behind = solid(center=(-5.0, 0.0, 0.0))
    assert np.isinf(intersect(behind, np.zeros(3), np.array([[1.0, 0, 0]]))).all()
    assert np.isinf(intersect(solid("ellipsoid"), np.zeros(3), np.array([[1.0, 0, 0]]))).all()


def test_cast_equals_stepping_along_every_ray():
    solids = [
        solid("box", (0.3, -0.2, 0.5), (0.8, 0.5, 0.4), 0.5),
        solid("ellipsoid", (-1.0, 0.6, -0.5), (0.6, 0.9, 0.5), -0.7),
        solid("box", (0.0, 0.0, 3.0), (8.0, 8.0, 0.3), 0.0),
        solid("ellipsoid", (0.5, 0.4, -3.5), (0.5, 0.4, 0.3), 0.2),
    ]
    view = camera()
    depth, places = cast(solids, view)
    index, (origin, rays) = places.which.reshape(view.size), rays_of(view)
    for row, column in [(r, c) for r in range(0, 12, 3) for c in range(0, 16, 2)]:
        t, hit = first_hit_by_steps(solids, origin, rays[row, column], far=10.0, step=0.02)
        assert index[row, column] == hit
        assert depth[row, column] == pytest.approx(t, abs=1e-9)
    assert set(np.unique(index)) == {0, 1, 2, 3}
    assert np.allclose(places.points.reshape(12, 16, 3), origin + rays * depth[..., None])


@pytest.mark.parametrize("shape", ["box", "ellipsoid"])
def test_normals_are_unit_outward_and_across_the_surface(shape):
    body = solid(shape, (1.0, 2.0, 3.0), (0.5, 1.0, 2.0), 0.6)
    points = sample_surface(body, 400, np.random.default_rng(0))
    n = places_on([body], points, np.zeros(400, int)).normals
    assert np.allclose(np.linalg.norm(n, axis=1), 1.0)
    steps = body.to_local(points + 1e-4 * n), body.to_local(points - 1e-4 * n)
    if shape == "box":
        size = [np.max(np.abs(p) - body.half, axis=1) for p in steps]
    else:
        size = [((p / body.half) ** 2).sum(1) - 1.0 for p in steps]
    assert (size[0] > 0).all()
    assert (size[1] < 0).all()


def test_points_on_an_ellipsoid_are_uniform_by_area():
    # For a spheroid of radii (a, a, c), c > a, the area with |z| < h is 2 pi a (h root(h) + c asin(e h / c) / e),
    # root(h) = sqrt(1 - (e h / c)^2): the surface of revolution integrated in closed form; e is its eccentricity.
    a, c, h = 0.5, 2.0, 1.2
    e = np.sqrt(1 - (a / c) ** 2)
    area = [2 * np.pi * a * (z * np.sqrt(1 - (e * z / c) ** 2) + c / e * np.arcsin(e * z / c)) for z in (h, c)]
    body = solid("ellipsoid", half=(a, a, c))
    points = sample_surface(body, 20_000, np.random.default_rng(2))
    share = (np.abs(points[:, 2]) < h).mean()
    assert share == pytest.approx(area[0] / area[1], abs=0.015)
    assert body.area() == pytest.approx(area[1], rel=0.011)
    assert solid("ellipsoid", half=(2.0, 2.0, 2.0)).area() == pytest.approx(16 * np.pi)


def test_a_ray_may_hit_nothing_and_the_nearest_solid_wins():
    walls = [solid(center=(9.0, 0, 0)), solid(center=(5.0, 0, 0))]
    t, which = first_hit(walls, np.zeros(3), np.array([[2.0, 0, 0], [9.0, 5.0, 0], [-9.0, 0, 0]]))
    assert t.tolist() == [2.0, np.inf, np.inf]
    assert which.tolist() == [1, -1, -1]


def test_a_camera_sees_what_its_own_rays_hit_and_nothing_else():
    solids = [
        solid("box", (0.3, -0.2, 0.5), (0.8, 0.5, 0.4), 0.5),
        solid("ellipsoid", (-1.0, 0.6, -0.5), (0.6, 0.9, 0.5)),
        solid("box", (0.0, 0.0, 3.0), (8.0, 8.0, 0.3), 0.0),
    ]
    view = camera()
    _, places = cast(solids, view)
    assert visible(solids, view, places).all()
    assert not visible(solids, view, places._replace(normals=-places.normals)).any()  # from behind
    origin, rays = rays_of(view)
    behind = (origin + rays * intersect(solids[2], origin, rays)[..., None]).reshape(-1, 3)[places.which != 2]
    assert len(behind) > 10
    assert not visible(solids, view, places_on(solids, behind, np.full(len(behind), 2))).any()
    before = places._replace(points=origin + 0.99 * (places.points - origin))
    assert visible(solids, view, before).all()  # a solid hides only what lies beyond it
