import numpy as np
import torch
from cases_viz import data, some_camera
from messages import refused

from kfgs.cameras import Camera
from kfgs.viz import add_cameras, look_through
from kfgs.viz.linked import evenly


def turned(camera, times):
    moved = camera.viewmat.clone()
    moved[:3, 3] += times * moved[:3, 0]
    return Camera(moved, camera.K, camera.width, camera.height)


def test_frusta_open_like_their_cameras(plotter):
    camera = some_camera()
    mesh = data(add_cameras(plotter, [camera, camera], size=0.5))
    assert mesh["camera"].tolist() == [0] * 10 + [1] * 10
    ends = torch.from_numpy(np.array(mesh.points)).double().reshape(20, 2, 3)
    np.testing.assert_allclose(ends[:4, 0], camera.center.expand(4, 3), atol=1e-6)
    in_camera = ends[:4, 1] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    np.testing.assert_allclose(in_camera[:, 2], 0.5, atol=1e-6)
    pixels = in_camera @ camera.K.T / in_camera[:, 2:]
    np.testing.assert_allclose(pixels[:, :2], [(0, 0), (160, 0), (160, 120), (0, 120)], atol=1e-4)
    ridge = ends[8, 1] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    assert (ridge @ camera.K.T / ridge[2])[1] < 0  # the roof is above the picture


def test_size_of_frusta_follows_the_cameras(plotter):
    camera, far = some_camera(), turned(some_camera(), 10)
    extent = (far.center - camera.center).abs().max()
    mesh = data(add_cameras(plotter, [camera, far]))
    ends = np.array(mesh.points).reshape(20, 2, 3)
    forward = camera.viewmat[2, :3].numpy()
    np.testing.assert_allclose((ends[0, 1] - ends[0, 0]) @ forward, 0.05 * extent, rtol=1e-5)
    refused(lambda: add_cameras(plotter, []), "cameras:", "got none")
    refused(lambda: add_cameras(plotter, [camera], size=0.0), "size:", "got 0.0")


def test_thinning_is_even_and_keeps_both_ends(plotter):
    assert evenly(10, 4).tolist() == [0, 3, 6, 9]
    assert evenly(3, None).tolist() == evenly(3, 7).tolist() == [0, 1, 2]
    cameras = [turned(some_camera(), i) for i in range(10)]
    mesh = data(add_cameras(plotter, cameras, most=4))
    assert mesh["camera"].tolist() == [i for i in (0, 3, 6, 9) for _ in range(10)]


def quarters(i):
    """Red, green, blue and a grey that tells the pictures apart; clockwise from the upper left."""
    picture = np.zeros((60, 80, 3), np.uint8)
    picture[:30, :40, 0] = picture[:30, 40:, 1] = picture[30:, 40:, 2] = 255
    picture[30:, :40] = 60 * (i + 1)
    return picture


def test_only_the_chosen_pictures_are_read_and_wrong_ones_named(plotter):
    asked, views = [], [turned(some_camera(), i) for i in range(5)]
    add_cameras(plotter, views, images=lambda i: (asked.append(i), torch.full((700, 900, 3), 0.5))[1], most=2)
    assert asked == [0, 4]
    refused(lambda: add_cameras(plotter, views[:2], images=[quarters(0)]), "images:", "expected 2", "got 1")
    bad = [quarters(0), np.zeros((4, 4))]
    refused(lambda: add_cameras(plotter, views[:2], images=bad), "images[1]:", "[H, W, 3]", "got (4, 4)")


def test_a_camera_sees_its_picture_as_it_is(plotter):
    cameras = [turned(some_camera(), 3 * i) for i in range(3)]
    add_cameras(plotter, cameras, images=quarters, size=0.5)
    for i in (0, 2):
        look_through(plotter, cameras[i])
        plotter.render()
        picture = plotter.screenshot(return_img=True)[[30, 30, 90, 90], [40, 120, 120, 40]]
        assert picture.tolist() == [[255, 0, 0], [0, 255, 0], [0, 0, 255], [60 * (i + 1)] * 3]
