import numpy as np
import pytest
import torch
from cases_clouds import random_cloud
from messages import refused

from kfgs._notes import hear
from kfgs.cameras import Similarity
from kfgs.formats import write_splats
from kfgs.labels import Insert
from kfgs.labels.edit_list import join
from kfgs.splat import transform_gaussians
from kfgs.splat.sh import evaluate_sh


def splats(n, coefficients=1, labels=None, classes=(), extra=None, seed=0, dtype=torch.float32):
    labels = None if labels is None else torch.tensor(labels)
    return random_cloud(n, coefficients, seed, dtype, labels=labels, names=tuple(classes), extra=extra or {})


@pytest.mark.parametrize(("first", "second"), [(16, 4), (1, 16), (4, 4)])
def test_the_lower_degree_is_filled_up_and_looks_as_before(first, second):
    a, b = splats(3, first), splats(2, second, seed=1)
    both = join(a, b)
    assert both.sh.shape == (5, max(first, second), 3)
    directions = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    shown = evaluate_sh(both.sh, directions)
    torch.testing.assert_close(shown[:3], evaluate_sh(a.sh, directions[:3]))
    torch.testing.assert_close(shown[3:], evaluate_sh(b.sh, directions[3:]))
    assert both.means.equal(torch.cat([a.means, b.means]))


def test_classes_are_the_same_when_their_names_are():
    a = splats(3, labels=[0, 1, -1], classes=("wall", "chair"))
    b = splats(4, labels=[2, 0, -1, 1], classes=("chair", "wall", "vase", "never used"), seed=1)
    both = join(a, b)
    assert both.names == ("wall", "chair", "vase")
    assert both.labels.tolist() == [0, 1, -1, 2, 1, -1, 0]


def test_classes_without_names():
    named, bare = splats(2, labels=[0, 1], classes=("wall", "chair")), splats(2, labels=[3, 0], seed=1)
    assert join(bare, bare).names == ()
    assert join(bare, bare).labels.tolist() == [3, 0, 3, 0]
    into_named, into_bare = join(named, bare), join(bare, named)
    assert into_named.names == ("wall", "chair", "class 0", "class 3")
    assert into_named.labels.tolist() == [0, 1, 3, 2]
    assert into_bare.names == ("class 0", "class 1", "class 2", "class 3", "wall", "chair")
    assert into_bare.labels.tolist() == [3, 0, 4, 5]


def test_what_one_cloud_lacks_is_filled():
    a = splats(2, extra={"id": np.array([7, 8], np.int32)})
    b = splats(1, labels=[0], classes=("vase",), extra={"heat": np.array([3.0])}, seed=1)
    b = b.replace(scores=torch.tensor([0.25]))
    both = join(a, b)
    assert both.labels.tolist() == [-1, -1, 0]
    assert both.scores.tolist() == [0, 0, 0.25]
    assert both.extra["id"].tolist() == [7, 8, 0]
    assert both.extra["id"].dtype == np.int32
    assert both.extra["heat"].tolist() == [0, 0, 3]
    assert join(splats(2), splats(1)).labels is None
    assert join(splats(2, dtype=torch.float64), splats(1)).sh.dtype == torch.float64


def test_all_is_drawn_as_the_scene_and_a_note_says_so():
    said = []
    with hear(said.append):
        both = join(random_cloud(2), random_cloud(3, antialiased=True))
        join(random_cloud(2), random_cloud(3))
    assert not both.antialiased
    assert said == ["what is inserted has antialiased=True; it is drawn as the scene: False"]


def test_what_cannot_be_joined_or_inserted_is_refused():
    refused(lambda: join(splats(2), splats(1, coefficients=0)), "sh:", "got none", "inserted")
    refused(lambda: join(splats(2, coefficients=0), splats(1)), "sh:", "got none", "scene")
    refused(lambda: Insert(""), "source:", "path", "got ''", error=TypeError)
    refused(lambda: Insert("a.ply", "far"), "similarity", "got", error=TypeError)
    matrix = Similarity(2.0, torch.eye(3), torch.ones(3)).matrix()
    assert Insert("a.ply", matrix.tolist()).similarity.scale == pytest.approx(2)


def test_insert_reads_the_file_and_places_it(tmp_path):
    scene, object_ = splats(4, 9, labels=[0, 0, 1, 1], classes=("wall", "chair")), splats(3, 4, seed=1)
    object_ = object_.replace(labels=torch.tensor([0, 0, 0]), names=("vase",))
    write_splats(object_, tmp_path / "vase.ply")
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    place = Similarity(2.0, quarter, torch.tensor([1.0, 2.0, 3.0]))
    from_file = Insert(tmp_path / "vase.ply", place).apply(scene)
    assert from_file.names == ("wall", "chair", "vase")
    assert from_file.labels.tolist() == [0, 0, 1, 1, 2, 2, 2]
    x, y, z = object_.means.unbind(1)
    torch.testing.assert_close(from_file.means[4:], torch.stack([1 - 2 * y, 2 + 2 * x, 3 + 2 * z], dim=1))
    moved = transform_gaussians(object_, place)
    torch.testing.assert_close(from_file.sh[4:, :4], moved.sh)
    assert not from_file.sh[4:, 4:].any()
    assert len(scene) == 4
    stays = Insert(tmp_path / "vase.ply").apply(scene)
    torch.testing.assert_close(stays.means[4:], object_.means)
