"""What decides whether a finished stage still holds."""

from dataclasses import replace
from pathlib import Path

import torch

from kfgs.cameras import Camera
from kfgs.pipeline.digests import digest_scene, digest_tensors
from kfgs.scenes import Scene


def a_scene() -> Scene:
    K = torch.tensor([[60.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    cameras = [Camera(torch.eye(4), K, 64, 48, name) for name in ("a.png", "b.png")]
    points = torch.tensor([[0.0, 0, 3], [0, 1, 5]])
    return Scene(cameras, [Path("a.png"), Path("b.png")], points, torch.zeros(2, 3, dtype=torch.uint8))


def with_camera(scene: Scene, **changes: object) -> Scene:
    return replace(scene, cameras=[scene.cameras[0], replace(scene.cameras[1], **changes)])


def test_a_scene_is_told_by_all_that_a_rendering_depends_on() -> None:
    scene = a_scene()
    moved = torch.eye(4)
    moved[0, 3] = 1e-6
    others = [
        with_camera(scene, viewmat=moved),
        with_camera(scene, K=scene.cameras[1].K + torch.diag(torch.tensor([1e-3, 0, 0]))),
        with_camera(scene, width=65),
        with_camera(scene, near=0.1),
        replace(scene, points=scene.points + 1),
    ]
    digests = [digest_scene(one, [0, 1]) for one in (scene, *others)]
    assert len(set(digests)) == 6
    assert digest_scene(others[3], [0]) == digest_scene(scene, [0])  # of these views alone
    assert digest_scene(with_camera(scene, name="c.png"), [0, 1]) == digests[0]


def test_runs_from_before_cameras_had_a_near_plane_stay_valid() -> None:
    scene = a_scene()
    poses = torch.stack([camera.viewmat for camera in scene.cameras])
    intrinsics = torch.stack([camera.K for camera in scene.cameras])
    sizes = torch.tensor([[48, 64], [48, 64]])
    assert digest_scene(scene, [0, 1]) == digest_tensors(poses, intrinsics, sizes, scene.points)
