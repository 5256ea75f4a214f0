"""A COLMAP scene whose lens distorts: read, projected as pycolmap does, undistorted, and drawn."""

import numpy as np
import pycolmap
import pytest
import torch
from messages import refused
from PIL import Image

import kfgs
from kfgs.cameras import project_points

PARAMS = [100.0, 104.0, 63.0, 49.0, -0.18, 0.05, 0.002, -0.001]  # OPENCV: fx fy cx cy k1 k2 p1 p2


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Four photographs of a chessboard of points, 2 units in front of the cameras, through a lens of 18 % barrel."""
    folder = tmp_path_factory.mktemp("lens")
    model = pycolmap.Reconstruction()
    lens = pycolmap.Camera(model="OPENCV", width=128, height=96, params=PARAMS, camera_id=1)
    model.add_camera_with_trivial_rig(lens)
    points = np.stack(np.meshgrid(np.linspace(-1, 1, 15), np.linspace(-0.8, 0.8, 11), [2.0]), -1).reshape(-1, 3)
    (folder / "images").mkdir()
    for number in range(4):
        turn = pycolmap.Rotation3d(np.array([0.0, 0.05 * number - 0.1, 0.0]))
        pose = pycolmap.Rigid3d(turn, np.array([0.1 * number, -0.05 * number, 0.2]))
        name = f"view {number}.png"
        seen = np.array(lens.img_from_cam(points @ pose.rotation.matrix().T + pose.translation))
        inside = (seen > 0).all(1) & (seen < [128, 96]).all(1)
        places = pycolmap.Point2DList(map(pycolmap.Point2D, seen[inside]))
        image = pycolmap.Image(name=name, points2D=places, camera_id=1, image_id=number + 1)
        model.add_image_with_trivial_frame(image, pose)
        picture = np.full((96, 128, 3), 40, np.uint8)
        for x, y in seen[inside].astype(int):
            picture[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2] = (250, 200, 60)
        Image.fromarray(picture).save(folder / "images" / name)
    for point in points:
        model.add_point3D(point, pycolmap.Track(), np.array([250, 200, 60], np.uint8))
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write(str(folder / "sparse" / "0"))
    return kfgs.load_scene(folder), lens, points


def test_points_fall_where_colmap_says(scene):
    taken, lens, points = scene
    assert len(taken) == 4
    assert len(taken.points) == 165
    for camera in taken.cameras:
        rotation, translation = camera.viewmat[:3, :3].double().numpy(), camera.viewmat[:3, 3].double().numpy()
        theirs = np.array(lens.img_from_cam(points @ rotation.T + translation))
        ours, _, seen = project_points(camera, torch.from_numpy(points).float())
        assert seen.sum() > 100
        np.testing.assert_allclose(ours[seen].numpy(), theirs[seen.numpy()], rtol=0, atol=2e-3)


def test_undistorted_views_are_pinholes(scene):
    """A point's bright dot in the undistorted picture lies where the new camera, without a lens, projects the point."""
    straight = scene[0].undistorted()
    for i in range(len(straight)):
        camera, image = straight.cameras[i], straight.image(i)
        assert camera.distortion is None
        pixels, _, seen = project_points(camera, torch.from_numpy(scene[2]).float())
        x, y = pixels[seen].T
        inside = (x > 3) & (x < camera.width - 3) & (y > 3) & (y < camera.height - 3)
        bright = image[y[inside].long(), x[inside].long(), 0]
        assert inside.sum() > 60
        assert float((bright > 0.6).float().mean()) > 0.97


def test_a_distorted_view_is_not_drawn_silently(scene):
    means, quats = torch.tensor([[0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]])
    cloud = kfgs.Gaussians(means, quats, torch.full((1, 3), 0.1), torch.ones(1) / 2, features=torch.ones(1, 1))
    refused(lambda: kfgs.rasterize(cloud, scene[0].cameras[0]), "undistort")
    assert kfgs.rasterize(cloud, scene[0].undistorted().cameras[0]).map.max() > 0.3
