"""Things that views tell apart and distance does not."""

import numpy as np
import torch
from cases_clouds import balls
from messages import refused

from kfgs import Camera, read_splats, write_splats
from kfgs.labels import Duplicate, OfClass, Remove, connected_parts, number_instances, transfer_labels
from kfgs.labels.components import number_parts
from kfgs.labels.edit_list import join
from kfgs.labels.instances import _join, _pieces

NAMES = ("floor", "chair")


def box(low, high, step=0.1):
    return torch.cartesian_prod(*(torch.arange(a, b + 1e-6, step) for a, b in zip(low, high, strict=True)))


def room():
    """Two slabs that nearly touch, on a floor; and a leg beside the second."""
    floor = box((-2.0, -2.0, 0.0), (2.0, 2.0, 0.0))
    slabs = [box((-0.8, -0.3, 0.1), (-0.1, 0.3, 0.2)), box((0.1, -0.3, 0.1), (0.8, 0.3, 0.2))]
    leg = box((0.9, 0.0, 0.1), (1.0, 0.1, 0.3))
    truth = torch.cat([torch.full((len(part),), k) for k, part in enumerate([floor, *slabs, leg])])
    return balls(torch.cat([floor, *slabs, leg]), truth > 0, scale=0.03, opacity=0.99, names=NAMES), truth


def views(count=12):
    angles = torch.arange(count) * 2 * torch.pi / count
    places = torch.stack([2 * angles.cos(), 2 * angles.sin(), torch.full((count,), 4.0)], dim=1)
    return [Camera.look_at(place, (0.0, 0.0, 0.5), up=(0, 0, 1), width=200, height=150) for place in places]


def test_views_part_what_distance_joins_and_a_leg_belongs_to_what_it_touches(tmp_path):
    cloud, truth = room()
    assert len(connected_parts(cloud, "chair", distance=0.25)) == 1
    told = number_instances(cloud, views())
    column = told.extra["instance"].astype(int)
    first, second = np.bincount(column[truth == 1]).argmax(), np.bincount(column[truth == 2]).argmax()
    assert {first, second} == {1, 2}
    assert (column[truth == 1] == first).mean() > 0.95
    assert (column[(truth == 2) | (truth == 3)] == second).mean() > 0.95
    assert len(connected_parts(told, "chair")) == 2
    assert len(connected_parts(told, "chair", distance=1.0)) == 1  # a distance decides alone

    write_splats(told, tmp_path / "told.ply")
    again = Remove(OfClass("chair", 0)).apply(read_splats(tmp_path / "told.ply"))
    assert [part.number for part in connected_parts(again, "chair")] == [2]  # it keeps its number
    assert len(OfClass("chair", 1).select(again)) == int((column == 2).sum())
    refused(lambda: OfClass("chair", 0).select(again), "part:", "[2]", "got chair/1")
    assert len(connected_parts(Duplicate("chair", (0, 0, 9)).apply(told), "chair")) == 4  # a copy is a new thing
    assert len(connected_parts(join(told, cloud), "chair")) == 3  # without numbers: one thing of its class
    assert join(told, cloud).extra["instance"].dtype == np.float32
    assert not join(cloud, told).extra
    carried = transfer_labels(told, balls(cloud.means + 0.01), 0.05)
    np.testing.assert_array_equal(carried.extra["instance"], told.extra["instance"], strict=True)  # type too
    assert not transfer_labels(cloud, carried).extra  # old numbers go with the old labels


def test_parts_join_while_most_views_say_so_then_small_ones_by_touch_and_the_unseen_by_distance():
    """Cells 1 apart, and one far away. The first two are together in 6 of 10 views, 3 and 4 are unseen, 2 is small."""
    centres = torch.tensor([0.0, 1, 2, 3, 4, 5, 20])[:, None] * torch.tensor([1.0, 0, 0])
    seen = np.diag([1.0, 1, 1, 0, 0, 1, 1])
    seen = 10 * seen.diagonal()[:, None] * seen.diagonal()
    together = np.diag(seen.diagonal())
    together[0, 1] = together[1, 0] = 6
    number = _join(together, seen, centres.numpy(), np.array([10, 10, 1, 1, 1, 9, 1]))
    assert [number.tolist().index(part) for part in number] == [0, 0, 0, 0, 4, 4, 6]


def test_a_jump_in_depth_cuts_a_class_and_specks_are_no_pieces():
    near, far = box((-0.5, -0.5, 1.0), (0.5, 0.5, 1.0), 0.05), box((-1.5, -1.5, 0.0), (1.5, 1.5, 0.0), 0.05)
    cloud = balls(torch.cat([near, far]), [1] * (len(near) + len(far)), scale=0.03, opacity=0.99)
    piece = _pieces(cloud, Camera.look_at((0, 0, 4), (0, 0, 0), up=(0, 1, 0), width=100, height=100))[1]
    sizes = np.bincount(piece.ravel())[1:]
    assert sorted(sizes[sizes > 0] > 200) == [True, True]


def test_things_of_several_classes_keep_apart():
    cloud = balls(torch.randn(6, 3), [0, 0, 1, 1, 1, 0]).replace(extra={"instance": np.array([1, 1, 1, 2, 0, 2])})
    assert number_parts(cloud, torch.ones(6) > 0).tolist() == [0, 0, 3, 4, -1, 1]
    assert number_parts(cloud, cloud.labels == 1).tolist() == [-1, -1, 0, 1, -1, -1]
    for foreign in ([0.5] * 6, [0, 1, -1, 1, 0, 1], [np.nan] * 6, [0] * 6, [10**17, 0, 1, 1, 1, 1]):
        assert int(number_parts(cloud.replace(extra={"instance": foreign}), torch.ones(6) > 0).min()) == 0


def test_what_is_missing_is_named():
    cloud = room()[0]
    refused(lambda: number_instances(cloud, []), "cameras:", "got none", "connected_parts")
    refused(lambda: number_instances(cloud.replace(labels=None), views(1)[0]), "gaussians:", "labels")
    assert len(number_instances(cloud[:0], views(1)[0])) == 0
