from dataclasses import replace

import kornia.geometry
import numpy as np
import pycolmap
import pytest
import torch
from cases_splat import gaussians_before
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.liegroup import Se3, So3
from kornia.geometry.pose import NamedPose
from kornia.geometry.quaternion import Quaternion
from kornia.geometry.vector import Vector3
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType
from messages import refused
from oracles_cameras import HEIGHT, LENSES, WIDTH, colmap_camera, colmap_pixels, project_pinhole

from kfgs.cameras import Camera, Distortion, Similarity, from_kornia, project_points, to_kornia, undistort
from kfgs.cameras.projection import as_cameras, camera_to_pixel, unproject_depth, world_to_camera
from kfgs.splat import project

K = torch.tensor([[70.0, 0.0, 50.0], [0.0, 66.0, 30.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
QUAT_XYZW = np.array([0.1, -0.2, 0.3, 0.9]) / np.linalg.norm([0.1, -0.2, 0.3, 0.9])
POSE = pycolmap.Rigid3d(pycolmap.Rotation3d(QUAT_XYZW), np.array([0.5, -1.0, 2.0]))


def posed(distortion=None, dtype=torch.float64):
    return Camera(POSE, K, WIDTH, HEIGHT, "posed", distortion).to(dtype)


def lens_camera(model):
    intrinsics = torch.from_numpy(colmap_camera(model).calibration_matrix())
    return Camera(torch.eye(4).double(), intrinsics, WIDTH, HEIGHT, model, Distortion(*LENSES[model][1:]))


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
    motion = Camera(pycolmap.Rigid3d(pycolmap.Rotation3d([0.5, 0.5, -0.5, 0.5]), [3, 1, -2]), K, 1, 1).viewmat
    moved = Camera(camera.viewmat @ torch.linalg.inv(motion), K, WIDTH, HEIGHT)
    there = points @ motion[:3, :3].T + motion[:3, 3]
    for ours, theirs in zip(project_points(camera, points), project_points(moved, there), strict=True):
        torch.testing.assert_close(ours, theirs)


def test_refusals():
    camera, bent = posed(), posed(Distortion("brown_conrady", (0.1, 0, 0, 0)))
    points = torch.ones(2, 3, dtype=torch.float64)
    refused(lambda: project_points(camera, points[:, :2]), "points:", "[N, 3]", "got (2, 2)")
    refused(lambda: world_to_camera(camera, points.long()), "points:", "got torch.int64", ".float()", error=TypeError)
    refused(lambda: project_points(camera, points, near=-1), "near:", "got -1")
    refused(lambda: unproject_depth(bent, torch.ones(camera.size)), "camera:", "got brown_conrady", "'posed'")
    refused(lambda: unproject_depth(camera, torch.ones(WIDTH, HEIGHT)), "depth:", "[64, 96]", "got (96, 64)")
    refused(lambda: unproject_depth(camera, torch.ones(HEIGHT, WIDTH).int()), "depth:", "torch.int32", error=TypeError)


# kornia's cameras

OTHER = pycolmap.Rigid3d(pycolmap.Rotation3d([0.6, 0.0, 0.0, 0.8]), [-0.4, 0.3, 1.0])
CAMERAS = [posed(), Camera(OTHER, K * torch.tensor([[1.3], [1.3], [1]]), 80, HEIGHT, "b.png")]


def test_kornia_projects_to_the_pixels_of_kfgs_and_lifts_them_again():
    cam = torch.from_numpy(points_in_front()[0])
    world = torch.stack([(cam - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3] for camera in CAMERAS])
    pixels, depths, _ = project_points(to_kornia(CAMERAS), world)
    alone = torch.stack([project_points(camera, world[0])[0] for camera in CAMERAS])
    assert project_points(CAMERAS, world[0])[0].equal(alone)
    torch.testing.assert_close(to_kornia(CAMERAS).project(world), pixels, rtol=0, atol=1e-9)
    torch.testing.assert_close(to_kornia(CAMERAS).unproject(pixels, depths[..., None]), world, rtol=0, atol=1e-12)
    assert (pixels[0] - project_points(CAMERAS[1], world[0])[0]).norm(dim=1).max() > 1  # the other camera's
    for camera, again in zip(CAMERAS, from_kornia(to_kornia(CAMERAS)), strict=True):
        assert again.K.equal(camera.K)
        assert (again.size, again.viewmat.tolist()) == (camera.size, camera.viewmat.tolist())


@pytest.mark.parametrize("model", [None, *LENSES])
def test_kornias_model_of_a_lens_gives_the_same_pixels(model):
    camera = posed() if model is None else replace(lens_camera(model), viewmat=posed().viewmat)
    local = points_in_front()[0]
    expected = project_points(replace(camera, viewmat=torch.eye(4)), torch.from_numpy(local))[0]
    torch.testing.assert_close(camera.model.project(Vector3(torch.from_numpy(local))).data, expected)


@pytest.mark.parametrize("model", [None, *LENSES])
def test_models_and_poses_of_a_batch_are_taken_row_by_row(model):
    lens = None if model is None else lens_camera(model).distortion
    half = lens and replace(lens, coefficients=tuple(k / 2 for k in lens.coefficients))
    cameras = [posed(lens), replace(posed(half), viewmat=OTHER, K=K * torch.tensor([[1.3], [1.3], [1]]))]
    kind = {None: "PINHOLE", "OPENCV_FISHEYE": "KANNALA_BRANDT_K3"}.get(model, "BROWN_CONRADY")
    params = torch.stack([camera.model.params for camera in cameras])
    first, both = (CameraModel(ImageSize(HEIGHT, WIDTH), CameraModelType[kind], p) for p in (params[0], params))
    poses = torch.stack([camera.viewmat for camera in cameras])
    world = torch.from_numpy(points_in_front()[1])
    for pinhole, pose, expected in (
        (both, Se3.from_matrix(poses), cameras),
        (both, OTHER, [replace(camera, viewmat=OTHER) for camera in cameras]),
        (first, NamedPose(cameras[0].pose, "world", "camera"), cameras[:1]),
        (first, poses, [replace(cameras[0], viewmat=camera.viewmat) for camera in cameras]),
    ):
        views = from_kornia(pinhole, pose)
        assert [view.size for view in views] == [camera.size for camera in expected]
        pairs = (project_points(cameras, world) for cameras in (views, expected))
        torch.testing.assert_close(*pairs, check_dtype=False)
    refused(lambda: from_kornia(both, poses[[0, 1, 1]]), "pose:", "[2, 4, 4]", "got (3, 4, 4)")


def test_poses_of_kornia_are_matrices_of_kfgs():
    turn, shift = Quaternion(torch.tensor([0.5, 0.5, -0.5, 0.5])), torch.tensor([1.0, 2.0, 3.0])
    R, step = turn.matrix(), Similarity(1.0, turn, shift)
    assert all(Similarity(1.0, rotation, shift).rotation.equal(step.rotation) for rotation in (R, So3(turn)))
    batch = Se3(Quaternion(turn.data[None]), shift[None])
    for pose in (Se3(turn, shift), batch, NamedPose(Se3(turn, shift))):
        assert Camera(pose, K, WIDTH, HEIGHT).R.equal(R)
        torch.testing.assert_close(Similarity.from_matrix(pose).matrix(), step.matrix())
    torch.testing.assert_close(step.pose.matrix(), step.matrix())
    back = NamedPose(Se3(turn, shift), "world", "camera").inverse()
    for wrong in (lambda: Camera(back, K, WIDTH, HEIGHT), lambda: from_kornia(posed().model, back)):
        refused(wrong, "pose:", "from the world", ".inverse()")
    refused(lambda: Camera(posed(), K, WIDTH, HEIGHT), "viewmat:", "got Camera", error=TypeError)
    refused(lambda: Similarity(2.0, R, shift).pose, "scale: expected 1", "got 2")


def test_what_kornia_cannot_hold_is_refused():
    bent = replace(CAMERAS[1], distortion=Distortion("kannala_brandt", (0.1, 0, 0, 0)))
    refused(lambda: to_kornia([CAMERAS[0], bent]), "camera:", "got kannala_brandt", "'b.png'")
    refused(lambda: to_kornia([]), "cameras:", "got none")
    assert len(to_kornia(camera for camera in CAMERAS).height) == 2
    assert [view.size for view in as_cameras([to_kornia(CAMERAS), posed()])] == [c.size for c in (*CAMERAS, posed())]
    refused(lambda: to_kornia([None]), "cameras:", "got NoneType", "from_kornia", error=TypeError)
    flat = CameraModel(ImageSize(4, 4), CameraModelType.ORTHOGRAPHIC, torch.ones(4))
    refused(lambda: from_kornia(flat), "pinhole:", "perspective", "Orthographic", error=TypeError)
    pinhole, points = to_kornia(CAMERAS), torch.ones(3, 5, 3)
    refused(lambda: from_kornia(pinhole, torch.eye(4)), "pose:", "None", "extrinsics")
    refused(lambda: project_points([], points[0]), "cameras:", "got none")
    refused(lambda: project_points(CAMERAS, points), "points (of 2 cameras):", "[2, N, 3]", "got (3, 5, 3)")
    cloud = gaussians_before(CAMERAS[0], 3, seed=0)
    for single in (lambda: undistort(torch.ones(HEIGHT, WIDTH, 3), pinhole), lambda: project(cloud, pinhole)):
        refused(single, "camera:", "got PinholeCamera", "from_kornia", error=TypeError)
    stacked = PinholeCamera(pinhole.intrinsics[:, None], pinhole.extrinsics[:, None], pinhole.height, pinhole.width)
    refused(lambda: from_kornia(stacked), "pinhole.intrinsics:", "[2, 4, 4]", "got (2, 1, 4, 4)")
    small = to_kornia(CAMERAS[:1]).scale(torch.tensor([0.3], dtype=torch.float64))
    refused(lambda: from_kornia(small), "width:", "got 28.")
