import cases_web
import numpy as np
import pytest
import torch
from cases_web import PAPER, needs_chromium, numbers, psnr

from kfgs.cameras import Camera
from kfgs.splat import rasterize
from kfgs.viewer import Exploration
from kfgs.viewer.pack import pack_scene

pytestmark = needs_chromium
ENOUGH = 40  # dB


@pytest.fixture(scope="module")
def state(room):
    return cases_web.room_state(room)


@pytest.fixture(scope="module")
def shared_viewer(browser, state):
    return cases_web.Viewer(browser, pack_scene(state))


@pytest.fixture
def viewer(shared_viewer):
    yield shared_viewer
    assert shared_viewer.errors == []


def drawn(state, camera, side="color", colors=None, keep=None):
    """What the rasteriser draws: harmonics, or these colours [N, 3] uint8, of some Gaussians."""
    cloud = state.cloud(side)
    if colors is not None:
        cloud = cloud.replace(features=torch.from_numpy(np.ascontiguousarray(colors)).float() / 255, sh=None)
    if keep is not None:
        cloud = cloud[torch.from_numpy(keep)]
    return rasterize(cloud.replace(labels=None), camera, background=PAPER).map.clamp(0, 1).numpy()


def state_colors(state, show):
    state.set_show(show)
    return state.colors("color")


@pytest.mark.parametrize("index", [0, 3, 7])
def test_harmonics_agree_with_the_rasteriser(viewer, state, index):
    camera = state.cameras[index]
    truth = drawn(state, camera)
    assert truth.std() > 0.05
    assert psnr(viewer.picture(camera), truth) > ENOUGH


def test_gaussians_beside_and_around_the_camera(viewer, state):
    """Here the footprint's limit at 1.3 fields of view and the near plane count."""
    viewmat = state.cameras[0].viewmat.clone()
    viewmat[:3, 3] -= viewmat[:3, :3] @ (state.cloud("color").means[7] - state.cameras[0].viewmat.inverse()[:3, 3])
    camera = Camera(viewmat, torch.tensor([[40.0, 0, 40], [0, 40, 30], [0, 0, 1]]), 80, 60, near=0.05)
    assert psnr(viewer.picture(camera), drawn(state, camera)) > ENOUGH


def winners(cloud, camera, places):
    """The Gaussian with the largest weight at the centres of some pixels: channel i of a picture is the weight of Gaussian i."""
    picture = rasterize(cloud.replace(features=torch.eye(len(cloud)), sh=None, labels=None), camera).map
    weights = picture[[int(y) for _, y in places], [int(x) for x, _ in places]]
    return torch.where(weights.sum(dim=1) < 0.05, -1, weights.argmax(dim=1)).tolist()


PICK = """([places, drawn]) => {
  const {cloud, camera} = renderer.seen();
  return places.map(([x, y]) => kfgs.gaussianAt(cloud, camera, x, y, Uint8Array.from(drawn)));
}"""


def test_antialiased_is_drawn_and_picked_with_opacity_compensation(browser, state):
    cloud, camera = state.cloud("color"), state.cameras[0]
    tiny = cloud.replace(scales=0.3 * cloud.scales, antialiased=True)
    fine = Exploration(state.meaning, tiny, cameras=state.cameras, distance=0.2)
    viewer = cases_web.Viewer(browser, pack_scene(fine))
    picture = viewer.picture(camera)
    plain = rasterize(tiny.replace(antialiased=False), camera, background=PAPER).map.clamp(0, 1).numpy()
    assert psnr(picture, drawn(fine, camera)) > ENOUGH
    assert psnr(picture, plain) < 30
    places = [(x + 0.5, y + 0.5) for x in range(4, camera.width, 9) for y in range(4, camera.height, 9)]
    picked = viewer.run(PICK, [places, [1] * len(tiny)])
    assert np.mean(np.equal(picked, winners(tiny, camera, places))) > 0.9
    assert viewer.errors == []


def test_labels_within_lambda(viewer, state):
    camera = state.cameras[2]
    for distance in (0.04, 0.2):
        state.set_distance(distance)
        truth = drawn(state, camera, colors=state_colors(state, "labels"))
        assert psnr(viewer.picture(camera, mode="labels", **{"lambda": distance}), truth) > ENOUGH
        wrong = viewer.picture(camera, mode="labels", **{"lambda": 0.1 if distance > 0.1 else 1})
        assert psnr(wrong, truth) < ENOUGH
    for kind, mode in (("labels", "labels"), ("rgb", "color")):
        state.set_show(kind)
        truth = drawn(state, camera, "semantic", state.colors("semantic"))
        assert psnr(viewer.picture(camera, "semantic", mode=mode), truth) > ENOUGH


def test_scores_of_the_labels_and_of_a_question(viewer, state):
    camera = state.cameras[2]
    state.set_distance(0.2)
    state.ask(None)
    low, high = state.clim
    look = {"mode": "score", "lambda": 0.2, "low": low, "high": high}
    truth = drawn(state, camera, colors=state_colors(state, "score"))
    assert psnr(viewer.picture(camera, **look), truth) > ENOUGH
    state.ask(state.meaning.names[1])
    low, high = state.clim
    truth = drawn(state, camera, colors=state_colors(state, "score"))
    assert psnr(viewer.picture(camera, **look | {"low": low, "high": high, "question": 1}), truth) > ENOUGH
    state.ask(None)


def test_what_is_not_selected_dims(viewer, state):
    camera = state.cameras[2]
    state.set_distance(0.15)
    asked = state.ask(state.meaning.names[0])
    gamma = float(asked.selection.scores[asked.valid].median())  # one has this score exactly, and is not selected
    state.set_gamma(gamma)
    chosen = state.selected("color")
    assert 0 < chosen.sum() < len(chosen)
    look = {"mode": "color", "question": 0, "gamma": gamma, "lambda": 0.15, "dim": True}
    dimmed, plain = viewer.picture(camera, **look), viewer.picture(camera)
    colors = np.where(chosen, 255, 0)[:, None].repeat(3, axis=1).astype(np.uint8)
    share = (drawn(state, camera, colors=colors) * (drawn(state, camera, colors=0 * colors) < 0.05)).mean(axis=2)
    assert np.abs(dimmed - plain)[share > 0.99].max(initial=0) < 0.05
    assert np.abs(dimmed - plain).mean() > 0.02
    outlined = viewer.picture(camera, **look | {"outline": [1, 0, 1]})
    changed = np.abs(outlined - dimmed).max(axis=2) > 0.1
    assert 0 < changed.mean() < 0.5
    state.ask(None)


@pytest.mark.parametrize("side", ["color", "semantic"])
def test_a_pick_has_the_largest_weight(viewer, state, side):
    camera = state.cameras[3]
    viewer.picture(camera, side)
    places = [(x + 0.5, y + 0.5) for x in range(4, camera.width, 9) for y in range(4, camera.height, 9)]
    some = np.arange(len(state.cloud(side))) % 3 > 0
    rest = {index for index in viewer.run(PICK, [places, some.astype(int).tolist()]) if index >= 0}
    assert rest
    assert some[list(rest)].all()
    picked = viewer.run(PICK, [places, np.ones(len(some), int).tolist()])
    wanted = winners(state.cloud(side), camera, places)
    assert np.greater_equal(wanted, 0).sum() > 20
    assert np.mean(np.equal(picked, wanted)) > 0.95  # two may have the same weight but for the rounding of the pack


def test_a_polygon(viewer, state):
    camera, means = state.cameras[3], state.cloud("color").means
    viewer.picture(camera)
    seen = means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    xy = (seen @ camera.K.T)[:, :2] / seen[:, 2:]
    lasso = [[10, 10], [50, 12], [30, 50]]
    drawn = np.arange(len(means)) % 3 > 0
    inside = (seen[:, 2] > camera.near).numpy() & drawn
    for (ax, ay), (bx, by) in zip(lasso, lasso[1:] + lasso[:1], strict=True):
        inside &= ((bx - ax) * (xy[:, 1] - ay) - (by - ay) * (xy[:, 0] - ax) > 0).numpy()
    within = """([lasso, drawn, through]) => {
      const {cloud, camera} = renderer.seen();
      return base64(kfgs.gaussiansIn(cloud, lasso, camera, Uint8Array.from(drawn), through));
    }"""
    mask = numbers(viewer.run(within, [lasso, drawn.astype(int).tolist(), True]), np.uint8) > 0
    assert inside.sum() > 5
    assert (mask != inside).sum() <= 1  # the pack's rounding at the border
    seen = numbers(viewer.run(within, [lasso, drawn.astype(int).tolist(), False]), np.uint8) > 0
    assert (seen <= mask).all()
    assert 5 < seen.sum() < mask.sum()
