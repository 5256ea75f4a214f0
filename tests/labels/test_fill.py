"""Removal with `fill`: a floor of known height and colours under a box, whose hole is closed and nothing else."""

import json

import pytest
import torch
from cases_clouds import balls

from kfgs.cameras import Camera
from kfgs.gaussians import Gaussians
from kfgs.labels import EditList, Extract, Remove
from kfgs.labels.edit_list import read_edits
from kfgs.labels.selection import OfIndex
from kfgs.splat import rasterize
from kfgs.splat.sh import rgb_to_sh0

CAMERA = Camera.look_at((0, 0, 3), (0, 0, 0), up=(0, 1, 0), fov_degrees=25.0, width=64, height=64)  # 1.3 of the floor
GREEN, RED, BLUE = (0.1, 0.8, 0.1), (0.7, 0.2, 0.2), (0.2, 0.2, 0.7)
EDIT = Remove("box", fill=True)


def patch(low, high, label, color, step=0.05):
    """Overlapping Gaussians on a grid between two corners."""
    means = torch.cartesian_prod(*(torch.arange(a, b + 1e-6, step) for a, b in zip(low, high, strict=True)))
    sh = torch.zeros(len(means), 4, 3)
    sh[:, 0] = rgb_to_sh0(torch.tensor(color))
    made = balls(means, torch.full((len(means),), label), names=("floor", "box", "crate"), sh=sh)
    return made.replace(scales=torch.full_like(means, 0.6 * step), opacities=torch.full((len(means),), 0.9))


def room():
    """A floor, half red and half blue, with a hole in its middle, on which a box stands; and specks labelled as the box."""
    floor = Gaussians.cat([patch((-1, -1, 0), (-0.03, 1, 0), 0, RED), patch((0.02, -1, 0), (1, 1, 0), 0, BLUE)])
    floor = floor.select(floor.means[:, :2].abs().amax(1) > 0.3)
    specks = patch((-0.9, 0.9, 1.0), (0.9, 0.9, 1.0), 1, GREEN, step=0.3)
    return Gaussians.cat([floor, patch((-0.2, -0.2, 0), (0.2, 0.2, 0.4), 1, GREEN), specks])


def test_the_floor_continues_under_the_box():
    hole, after = Remove("box").apply(room()), EDIT.apply(room())
    new = after.select(after.means[:, :2].abs().amax(1) < 0.27)
    assert len(new) > 60  # discs of the size of the floor's Gaussians
    assert bool((new.means[:, 2].abs() < 1e-3).all() and (new.labels == 0).all())
    assert float(new.scales[:, 2].max()) < 0.2 * float(new.scales[:, :2].min())
    for half, color in ((new.means[:, 0] < -0.15, RED), (new.means[:, 0] > 0.15, BLUE)):
        apart = new.sh[half, 0].mean(0) - rgb_to_sh0(torch.tensor(color))
        assert float(apart.abs().max()) < 0.3  # the halves are 1.8 apart, and mix in the middle
    before, closed = rasterize(hole, CAMERA), rasterize(after, CAMERA)
    assert float((before.alpha < 0.1).float().mean()) > 0.15
    assert float(closed.alpha.min()) > 0.85  # at the seam with the old floor; 0.97 in the middle
    far = torch.nn.functional.max_pool2d((before.alpha < 0.9).float()[None], 9, 1, 4)[0] == 0
    assert float((closed.map - before.map).abs()[far].max()) < 8 / 255


def test_a_hole_that_shows_a_floor_stays():
    shelf = patch((-1, -1, 0.6), (1, 1, 0.6), 0, BLUE)
    shelf, box = shelf.select(shelf.means[:, :2].abs().amax(1) > 0.3), patch((-0.2, -0.2, 0.6), (0.2, 0.2, 1), 1, GREEN)
    after = EDIT.apply(Gaussians.cat([patch((-1.5, -1.5, 0), (1.5, 1.5, 0), 0, RED), shelf, box]))
    assert not bool(((after.means[:, :2].abs().amax(1) < 0.25) & (after.means[:, 2] > 0.3)).any())


def test_what_stands_beside_or_above_stays():
    """A crate that touches the box keeps its Gaussians, a ceiling hides no floor, and scattered Gaussians are no thing."""
    crate, ceiling = patch((0.25, -0.2, 0), (0.45, 0.2, 0.3), 2, BLUE), patch((-1, -1, 1.2), (1, 1, 1.2), 0, GREEN)
    before = Gaussians.cat([room(), crate, ceiling])
    after = EDIT.apply(before)
    assert int((after.labels == 2).sum()) == len(crate)
    assert int(((after.means[:, :2].abs().amax(1) < 0.2) & (after.means[:, 2].abs() < 0.01)).sum()) > 60
    assert len(Remove(OfIndex(range(0, 1300, 97)), fill=True).apply(before)) == len(before) - 14


def test_without_a_surface_nothing_is_invented():
    alone, rest = Extract("box").apply(room()), patch((9, 9, 0), (9.5, 9.5, 0), 0, BLUE)
    assert torch.equal(EDIT.apply(Gaussians.cat([alone, rest])).means, rest.means)
    assert len(EDIT.apply(alone)) == 0


def test_the_same_again_elsewhere_and_in_float64():
    once, again = EDIT.apply(room()), EDIT.apply(room())
    assert all(torch.equal(a, b) for a, b in zip(once.tensors().values(), again.tensors().values(), strict=True))
    far = EDIT.apply(room().to(torch.float64).replace(origin=(5e5, 4e6, 0.0)))
    assert (far.means.dtype, far.origin) == (torch.float64, (5e5, 4e6, 0.0))
    assert torch.allclose(far.means.float(), once.means, atol=1e-5)


def test_fill_in_json_and_its_refusals(tmp_path):
    edits = EditList((EDIT, Remove("floor")))
    saved = json.loads(edits.save(tmp_path / "edits.json").read_text())["edits"]
    assert [each.get("fill") for each in saved] == [True, None]  # without it as older versions write it
    assert EditList.load(tmp_path / "edits.json") == edits
    with pytest.raises(ValueError, match="fill: expected True or False, got 'yes'"):
        read_edits([{"op": "remove", "where": ["box"], "fill": "yes"}])
    with pytest.raises(ValueError, match="fill: expected colours"):
        EDIT.apply(room().replace(sh=None))
