import kornia.geometry
import numpy as np
import pycolmap
import pytest
import torch
from messages import tells
from oracles_cameras import HEIGHT, LENSES, WIDTH, colmap_pixels, project_pinhole

from kfgs.cameras import Camera, Distortion, project_points
from kfgs.cameras.projection import camera_to_pixel, projection_jacobian, unproject_depth, world_to_camera

K = torch.tensor([[70.0, 0.0, 50.0], [0.0, 66.0, 30.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
QUAT_XYZW = np.array([0.1, -0.2, 0.3, 0.9]) / np.linalg.norm([0.1, -0.2, 0.3, 0.9])
POSE = pycolmap.Rigid3d(pycolmap.Rotation3d(QUAT_XYZW), np.array([0.5, -1.0, 2.0]))


def posed(distortion=None, dtype=torch.float64):
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3] = torch.from_numpy(POSE.matrix())
    return Camera(viewmat.to(dtype), K.to(dtype), WIDTH, HEIGHT, "posed", distortion)


def lens_camera(model):
    parameters, kind, coefficients = LENSES[model]
    focal = parameters[:2] if len(parameters) > 5 else [parameters[0]] * 2
    center = parameters[2:4] if len(parameters) > 5 else parameters[1:3]
    intrinsics = torch.tensor([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]], dtype=torch.float64)
    return Camera(torch.eye(4, dtype=torch.float64), intrinsics, WIDTH, HEIGHT, model, Distortion(kind, coefficients))


def points_in_front(count=40, seed=0):
    """World points whose depth in the posed camera lies in [1, 10]."""
    rng = np.random.default_rng(seed)
    cam = np.stack([rng.uniform(-0.6, 0.6, count), rng.uniform(-0.4, 0.4, count), np.ones(count)], 1)
    cam *= rng.uniform(1, 10, (count, 1))
    return cam, np.array([POSE.inverse() * x for x in cam])


def test_world_to_camera_is_colmaps_cam_from_world():
    cam, world = points_in_front()
    result = world_to_camera(posed(), torch.from_numpy(world)).numpy()
    np.testing.assert_allclose(result, cam, atol=1e-12)
    # wrong readings: the pose as camera-to-world; y up and z backward (OpenGL)
    inverse = np.array([POSE.inverse() * x for x in world])
    assert np.abs(inverse - cam).max() > 1
    assert np.abs(result * [1, -1, -1] - cam).max() > 1


def test_pixels_agree_with_colmap_and_with_loops():
    cam, world = points_in_front()
    colmap = pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=[70, 66, 50, 30.5])
    xy, depth, _ = project_points(posed(), torch.from_numpy(world))
    np.testing.assert_allclose(xy.numpy(), colmap.img_from_cam(cam), atol=1e-10)
    loops, depths = project_pinhole(K.numpy(), posed().viewmat.numpy(), world)
    np.testing.assert_allclose(xy.numpy(), loops, atol=1e-10)
    np.testing.assert_allclose(depth.numpy(), depths, atol=1e-12)


@pytest.mark.parametrize("model", LENSES)
def test_lens_agrees_with_colmap(model):
    cam, _ = points_in_front()
    ours = camera_to_pixel(lens_camera(model), torch.from_numpy(cam)).numpy()
    np.testing.assert_allclose(ours, colmap_pixels(model, cam), atol=1e-9)
    _, kind, coefficients = LENSES[model]
    assert lens_camera(model).distortion == Distortion(kind, coefficients)
    pinhole = camera_to_pixel(Camera(torch.eye(4), lens_camera(model).K, WIDTH, HEIGHT), torch.from_numpy(cam)).numpy()
    assert np.abs(pinhole - ours).max() > 0.5  # leaving the lens out shows


def test_center_of_first_pixel_is_one_half():
    camera = posed()
    lifted = unproject_depth(camera, torch.full(camera.size, 3.0, dtype=torch.float64))
    xy, depth, visible = project_points(camera, lifted.reshape(-1, 3))
    assert visible.all()
    torch.testing.assert_close(depth, torch.full_like(depth, 3.0))
    torch.testing.assert_close(xy[0], torch.tensor([0.5, 0.5], dtype=torch.float64))
    grid = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    torch.testing.assert_close(xy.reshape(HEIGHT, WIDTH, 2), torch.stack(grid[::-1], -1).double())
    # the wrong reading: COLMAP's K handed to kornia's integer grid is off by half a pixel on every ray
    wrong = kornia.geometry.depth.depth_to_3d_v2(torch.ones(camera.size, dtype=torch.float64), K[None])[0, 0, 0]
    torch.testing.assert_close(camera_to_pixel(camera, wrong[None])[0], torch.zeros(2, dtype=torch.float64))


def test_behind_the_camera_is_culled_by_depth():
    point = torch.tensor([[0.2, 0.1, -2.0], [0.2, 0.1, 2.0]], dtype=torch.float64)
    camera = Camera(torch.eye(4), K, WIDTH, HEIGHT)
    pixel = camera_to_pixel(camera, point)[0]  # the trap: a plausible pixel, inside the picture
    assert 0 < pixel[0] < WIDTH
    assert 0 < pixel[1] < HEIGHT
    xy, depth, visible = project_points(camera, point)
    assert visible.tolist() == [False, True]
    assert xy[0].tolist() == [0, 0]
    assert depth.tolist() == [-2, 2]


def test_picture_includes_its_left_top_edge_and_excludes_the_others():
    camera = Camera(torch.eye(4), torch.tensor([[64.0, 0, 48], [0, 64, 32], [0, 0, 1]]), 96, 64)
    corners = torch.tensor([[0.0, 0.0], [96.0, 32.0], [48.0, 64.0], [95.5, 63.5], [-0.5, 3.0]])
    points = torch.cat([(corners - torch.tensor([48.0, 32.0])) / 64, torch.ones(5, 1)], 1)
    xy, _, visible = project_points(camera, points)
    assert visible.tolist() == [True, False, False, True, False]
    torch.testing.assert_close(xy, corners)  # outside the picture, but in front of the camera: still given


def test_no_nan_whatever_comes():
    points = torch.tensor(
        [[0.0, 0, 0], [1, -1, 0], [1, 1, 1e-30], [1e30, 0, 1], [float("nan"), 0, 1], [0, 0, torch.inf]]
    )
    for lens in (
        None,
        Distortion("brown_conrady", (0.1, 0.2, 0, 0, 0.3)),
        Distortion("kannala_brandt", (0.1, 0, 0, 0)),
    ):
        camera = Camera(torch.eye(4), K.float(), WIDTH, HEIGHT, distortion=lens)
        assert not camera_to_pixel(camera, points[:4]).isnan().any()
        xy, _, visible = project_points(camera, points)
        assert not xy.isnan().any()
        assert not visible.any()


def test_lens_does_not_fold_far_points_into_the_picture():
    lens = Distortion("brown_conrady", (-1 / 3, 0.0, 0.0, 0.0))  # radius r - r^3 / 3 turns at r = 1, is 0 at sqrt(3)
    camera = Camera(torch.eye(4), K.float(), WIDTH, HEIGHT, distortion=lens)
    points = torch.tensor([[0.5, 0.0, 1.0], [1.7, 0.0, 1.0]])
    folded = camera_to_pixel(camera, points)[1]  # 60 degrees off-axis, far outside a field of view of 38 degrees
    assert 0 < folded[0] < WIDTH
    assert 0 < folded[1] < HEIGHT
    assert project_points(camera, points)[2].tolist() == [True, False]


def test_jacobian_is_the_derivative_of_the_projection():
    cam = torch.from_numpy(points_in_front(6)[0])
    exact = torch.autograd.functional.jacobian(lambda x: camera_to_pixel(posed(), x).sum(0), cam)  # [2, N, 3]
    torch.testing.assert_close(projection_jacobian(posed(), cam), exact.transpose(0, 1))


@pytest.mark.parametrize("model", [None, "FULL_OPENCV", "OPENCV_FISHEYE"])
def test_gradcheck(model):
    lens = None if model is None else lens_camera(model).distortion
    points = torch.from_numpy(points_in_front(5)[1])
    inputs = (points.requires_grad_(), posed().viewmat.requires_grad_(), K.clone().requires_grad_())

    def pixels(points, viewmat, intrinsics):
        # a Camera refuses matrices off the manifold of poses, so the steps of gradcheck go around its constructor
        camera = posed(lens)
        object.__setattr__(camera, "viewmat", viewmat)
        object.__setattr__(camera, "K", intrinsics)
        return project_points(camera, points)[:2]

    assert torch.autograd.gradcheck(pixels, inputs)


def test_moving_world_and_camera_together_changes_nothing():
    _, world = points_in_front()
    camera, points = posed(), torch.from_numpy(world)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3] = torch.from_numpy(pycolmap.Rigid3d(pycolmap.Rotation3d([0.5, 0.5, -0.5, 0.5]), [3, 1, -2]).matrix())
    moved = Camera(camera.viewmat @ torch.linalg.inv(motion), K, WIDTH, HEIGHT)
    there = points @ motion[:3, :3].T + motion[:3, 3]
    for ours, theirs in zip(project_points(camera, points), project_points(moved, there), strict=True):
        torch.testing.assert_close(ours, theirs)


def test_refusals():
    camera, bent = posed(), posed(Distortion("brown_conrady", (0.1, 0, 0, 0)))
    points = torch.ones(2, 3, dtype=torch.float64)
    with pytest.raises(ValueError, match=tells("points:", "[N, 3]", "got (2, 2)")):
        project_points(camera, points[:, :2])
    with pytest.raises(TypeError, match=tells("points:", "got torch.int64", ".float()")):
        world_to_camera(camera, points.long())
    with pytest.raises(TypeError, match=tells("points_cam:", "got torch.int64")):
        camera_to_pixel(camera, points.long())
    with pytest.raises(ValueError, match=tells("near:", "got -1")):
        project_points(camera, points, near=-1)
    with pytest.raises(ValueError, match=tells("camera:", "got brown_conrady", "'posed'")):
        projection_jacobian(bent, points)
    with pytest.raises(ValueError, match=tells("camera:", "got brown_conrady")):
        unproject_depth(bent, torch.ones(camera.size))
    with pytest.raises(ValueError, match=tells("depth:", "[64, 96]", "got (96, 64)")):
        unproject_depth(camera, torch.ones(WIDTH, HEIGHT))
    with pytest.raises(TypeError, match=tells("depth:", "got torch.int32")):
        unproject_depth(camera, torch.ones(camera.size, dtype=torch.int32))
