"""Scenes and splats in UTM: in memory float32 from an origin, in answers and files the coordinates of the world."""

import json

import numpy as np
import pytest
import torch

from kfgs import Camera, Gaussians, read_splats, write_splats
from kfgs._origin import choose_origin, to_world
from kfgs.cameras.similarity import Similarity
from kfgs.formats.ply import read_ply, write_ply
from kfgs.labels import Move, OfClass, OrientedBox
from kfgs.labels.edit_list import join
from kfgs.scenes import align_by_cameras
from kfgs.splat.transform import transform_gaussians

UTM = np.array([448262.25, 5411932.5, 200.0])


def cloud(count=60, seed=0):
    """Gaussians in a cube of side 2, and their float64 places in it."""
    g = torch.Generator().manual_seed(seed)
    places = torch.rand(count, 3, generator=g, dtype=torch.float64) * 2 - 1
    quats, scales = torch.randn(count, 4, generator=g), torch.rand(count, 3, generator=g) * 0.05 + 0.02
    labels, sh = torch.arange(count) % 3, torch.rand(count, 4, 3, generator=g)
    opacities = torch.rand(count, generator=g) * 0.8 + 0.1
    return Gaussians(places.float(), quats, scales, opacities, sh=sh, labels=labels), places


def far_file(path, offset=UTM, count=60, seed=0):
    """A PLY in double, moved by an offset, without help of the reader's code; and the places in it."""
    near, places = cloud(count, seed)
    write_splats(near, path)
    table = read_ply(path)
    world = places.numpy() + offset
    write_ply(path, table | {name: world[:, i].copy() for i, name in enumerate("xyz")})
    return world


def world_of(gaussians):
    return gaussians.means.double().numpy() + np.array(gaussians.origin)


def test_origin_is_zero_near_zero_and_for_a_large_scene():
    room = torch.rand(1000, 3, dtype=torch.float64) * 5
    assert choose_origin(room) == choose_origin(room + 100) == (0, 0, 0)
    assert choose_origin(room[:1] + 3) == choose_origin(room[:1].repeat(9, 1) + 3) == (0, 0, 0)  # one place has no size
    assert choose_origin(room * 1e5) == (0, 0, 0)
    assert choose_origin(torch.zeros(0, 3)) == (0, 0, 0)


@pytest.mark.parametrize("size", [1e-4, 1.0, 800.0])
def test_origin_lies_near_what_is_far(size):
    places = torch.rand(1000, 3, dtype=torch.float64) * size + torch.from_numpy(UTM)
    places[0] = torch.nan
    origin = torch.tensor(choose_origin(places), dtype=torch.float64)
    assert float((places[1:] - origin).abs().max()) < 20 * max(size, 1e-6 * float(UTM.max()))


def test_ply_in_double_is_read_and_written_to_the_millimetre(tmp_path):
    world = far_file(tmp_path / "far.ply")
    splats = read_splats(tmp_path / "far.ply")
    assert splats.means.dtype == torch.float32
    assert np.abs(world_of(splats) - world).max() < 1e-5
    write_splats(splats, tmp_path / "again.ply")
    assert {read_ply(tmp_path / "again.ply")[name].dtype.str for name in "xyz"} == {"<f8"}
    again = read_splats(tmp_path / "again.ply")
    assert again.origin == splats.origin
    assert torch.equal(again.means, splats.means)


@pytest.mark.parametrize("ending", ["glb", "splat", "spz", "sog", "compressed.ply"])
def test_other_formats_keep_the_place(tmp_path, ending):
    world = far_file(tmp_path / "far.ply")
    written = write_splats(read_splats(tmp_path / "far.ply"), tmp_path / f"far.{ending}")
    back = read_splats(tmp_path / f"far.{ending}")
    order = np.arange(len(world)) if written.order is None else written.order.numpy()
    assert np.abs(world_of(back) - world[order]).max() < 2e-3
    assert any("origin" in lost for lost in written.lost) == (ending != "glb")
    if ending == "glb":  # a translation of the node, y up and z back
        text = (tmp_path / "far.glb").read_bytes()[20:].split(b"BIN")[0].decode("utf-8", "replace")
        assert json.JSONDecoder().raw_decode(text)[0]["nodes"][0]["translation"][0] == back.origin[0]
    else:
        assert tmp_path / f"far.{ending}.origin.json" in written.paths


def test_origin_of_another_version_is_refused_and_its_advice_works(tmp_path):
    far_file(tmp_path / "far.ply")
    splats = read_splats(tmp_path / "far.ply")
    write_splats(splats.replace(labels=None), tmp_path / "far.splat")
    with (tmp_path / "far.splat").open("r+b") as file:
        file.truncate(32)
    with pytest.raises(ValueError, match=r"far.splat.origin.json: .* another version; delete it"):
        read_splats(tmp_path / "far.splat")
    (tmp_path / "far.splat.origin.json").unlink()
    assert len(read_splats(tmp_path / "far.splat")) == 1


def test_edits_and_joins_stay_in_the_world(tmp_path):
    world = far_file(tmp_path / "far.ply")
    splats = read_splats(tmp_path / "far.ply").replace(names=("a", "b", "c"))
    moved = Move(OfClass("b"), translation=(0.5, 0, 0), rotation=("z", 90), pivot=tuple(UTM)).apply(splats)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    want = np.where((np.arange(60) % 3 == 1)[:, None], (world - UTM) @ quarter.T + UTM + [0.5, 0, 0], world)
    assert np.abs(world_of(moved) - want).max() < 1e-4
    other = splats.with_origin(tuple(UTM + 40))
    both = join(splats, other)
    assert np.abs(world_of(both) - np.concatenate([world, world])).max() < 1e-4


def test_a_similarity_from_a_local_frame_to_utm_loses_nothing():
    near, places = cloud()
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    to_utm = Similarity(2.0, turn, torch.from_numpy(UTM))
    far = transform_gaussians(near, to_utm)
    assert np.abs(world_of(far) - (2 * places.numpy() @ turn.double().numpy().T + UTM)).max() < 1e-5
    back = transform_gaussians(far, to_utm.inverse())
    assert np.abs(world_of(back) - places.numpy()).max() < 1e-5
    camera = Camera.look_at((0, -4, 1), (0, 0, 0), width=32, height=24)
    moved = to_utm.apply_to_camera(camera)
    want = to_utm.apply(camera.center.double()[None])[0]
    assert float((to_world(moved.center, moved.origin) - want).abs().max()) < 1e-5
    assert "5411932.5" in repr(moved)


def test_pictures_of_two_clouds_share_an_origin(tmp_path):
    pv = pytest.importorskip("pyvista")
    from kfgs.viz import add_boxes, add_cameras, add_cloud, look_through, to_pyvista
    from kfgs.viz.plotter import camera_of

    world = far_file(tmp_path / "far.ply")
    gaussians = read_splats(tmp_path / "far.ply")
    np.testing.assert_allclose(to_pyvista(gaussians).points, world, rtol=0, atol=1e-4)
    plotter = pv.Plotter(off_screen=True, window_size=(32, 24))
    near = Camera.look_at((0, -4, 1), (0, 0, 0), width=32, height=24)
    camera = Camera(near.viewmat, near.K, 32, 24, origin=tuple(UTM))
    box = OrientedBox.around(torch.from_numpy(world))
    actors = [add_cloud(plotter, gaussians), add_cloud(plotter, gaussians.with_origin(tuple(UTM + 50)))]
    frames = add_boxes(plotter, [box]).mapper.dataset, add_cameras(plotter, [camera]).mapper.dataset
    one, two = (actor.mapper.dataset.points for actor in actors)
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-4)
    assert max(np.abs(np.asarray(mesh.points)).max() for mesh in frames) < 20
    look_through(plotter, camera)
    seen = camera_of(plotter, plotter.renderer)
    np.testing.assert_allclose(to_world(seen.center, seen.origin), UTM + np.array([0, -4, 1]), rtol=0, atol=1e-4)
    plotter.close()


def test_a_checkpoint_in_double_keeps_its_place(tmp_path):
    near, places = cloud()
    raw = {"means": places + torch.from_numpy(UTM), "scales": near.scales.log(), "quats": near.quats}
    raw |= {"opacities": near.opacities.logit(), "sh0": near.sh[:, :1], "shN": near.sh[:, 1:]}
    torch.save({"step": 1, "splats": raw}, tmp_path / "ckpt_1.pt")
    back = read_splats(tmp_path / "ckpt_1.pt")
    assert np.abs(world_of(back) - places.numpy() - UTM).max() < 1e-5


def test_cameras_of_two_frames_are_aligned_in_the_world():
    ring = [(3 * np.cos(a), 3 * np.sin(a), 1.0 + 0.2 * a) for a in np.linspace(0, 5, 6)]
    local = [Camera.look_at(eye, (0, 0, 0), width=32, height=24, name=f"{i}.png") for i, eye in enumerate(ring)]
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    to_utm = Similarity(2.0, turn, torch.from_numpy(UTM))
    found = align_by_cameras(local, [to_utm.apply_to_camera(camera) for camera in local]).similarity
    point = torch.tensor([[0.3, -0.2, 1.0]]).double()
    assert float((found.apply(point) - to_utm.apply(point)).abs().max()) < 1e-4
