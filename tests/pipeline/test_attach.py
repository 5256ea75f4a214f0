"""A semantic field attached to a splat of the same scene, in its frame or another."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from cases_clouds import balls, room
from messages import refused, tells
from scipy.spatial.transform import Rotation

from kfgs.cameras import Camera
from kfgs.cameras.similarity import Similarity
from kfgs.fields import Identity, SemanticField
from kfgs.formats.ply import read_ply, write_ply
from kfgs.formats.sidecar import NAMES, beside
from kfgs.formats.table import read_splats, write_splats
from kfgs.gaussians import Gaussians
from kfgs.labels import LabelSet
from kfgs.pipeline.attach import attach, label_cloud, save_labelled
from kfgs.scenes import SceneError

CLASSES = LabelSet(("wall", "box", "table"), torch.eye(4)[:3])


def true_labels(points):
    """Which of wall (0), box (1) and table (2) a point of `room` lies on."""
    x, y, z = points.T
    box = (x - 2.9).abs().lt(0.42) & (y - 0.65).abs().lt(0.27) & z.gt(0.88) & z.lt(0.93)
    table = ((x - 1.2) ** 2 + (y - 1.8) ** 2).sqrt().lt(0.63) & (z - 0.7).abs().lt(0.03)
    return torch.where(box, 1, torch.where(table, 2, 0))


def cloud(count, seed, **others):
    points = room(count, seed).float()
    return balls(points, scale=0.03, opacity=0.8, **others)


def a_field(count=4_000):
    gaussians = cloud(count, 0)
    made = gaussians.replace(features=CLASSES.embeddings[true_labels(gaussians.means)])
    return SemanticField(made, Identity(CLASSES.dim))


def a_splat(count=6_000):
    gaussians = cloud(count, 1)
    sh = torch.rand(len(gaussians), 1, 3, generator=torch.Generator().manual_seed(0))
    return gaussians.replace(sh=sh, extra={"warmth": np.arange(len(gaussians), dtype=np.float32)})


CAMERAS = [
    Camera.look_at(
        (3.2 + math.cos(a), 2.6 + math.sin(a), 2.0 + 0.4 * math.sin(3 * a)),
        (1.6, 1.2, 0.6),
        width=128,
        height=96,
        fov_degrees=56,
        name=f"view_{a:.1f}.png",
    )
    for a in (0.0, 0.5, 1.0, 1.6, 2.4, -0.7)
]


def a_similarity(seed=3):
    rng = np.random.default_rng(seed)
    rotation = torch.from_numpy(Rotation.random(random_state=rng).as_matrix())
    return Similarity(2.5, rotation, torch.from_numpy(5 * rng.normal(size=3)))


def moved(splats, similarity):
    """The Gaussians are round: there is no rotation to turn."""
    return splats.replace(means=similarity.apply(splats.means), scales=splats.scales * similarity.scale)


def accuracy(labels, splats):
    return float((labels == true_labels(splats.means)).float().mean())


def test_words_of_another_teacher_are_refused_before_any_work():
    words = LabelSet(CLASSES.names, torch.eye(5)[:3])
    refused(lambda: attach(a_field(50), a_splat(50), words), "classes:", "[C, 4]", "got (3, 5)", "teacher")


def test_distance_in_one_frame():
    splats = a_splat()
    attached = attach(a_field(), splats, CLASSES)
    assert accuracy(attached.labels, splats) > 0.97
    assert attached.alignment is None
    assert "the frames agree" in attached.notes[0]
    labelled = attached.labels >= 0
    score = attached.gaussians.scores
    expected = 1 - attached.transfer.distances / attached.transfer.distance
    torch.testing.assert_close(score[labelled], expected[labelled].float())
    assert (score[~labelled] == 0).all()


def test_views_label_what_they_show_and_their_neighbours():
    splats = a_splat()
    hidden = torch.tensor([[1.2, 1.8, 0.62], [50.0, 50.0, 50.0]])  # below the table's top; out of every view and reach
    splats = Gaussians.cat([splats, splats.select(torch.tensor([0, 1])).replace(means=hidden)])
    attached = attach(a_field(), splats, CLASSES, cameras=CAMERAS, by="views")
    labelled = int((attached.labels >= 0).sum())  # by views and by distance
    assert repr(attached).startswith(f"Attached({labelled:,} of {len(splats):,} Gaussians labelled, 3 classes, lambda ")
    assert len(repr(attached)) < 200
    assert accuracy(attached.labels, splats) > 0.95
    assert attached.labels[-2] == 2
    assert attached.labels[-1] == -1
    assert attached.gaussians.scores[-1] == 0
    facts = attached.facts
    assert 0.8 * len(splats) < facts["shown"] < len(splats)


@pytest.mark.parametrize("by", ["distance", "views"])
def test_cameras_of_the_same_names_find_the_frame(by):
    similarity = a_similarity()
    here, there = a_splat(), moved(a_splat(), similarity)
    splat_cameras = [similarity.apply_to_camera(camera) for camera in CAMERAS]
    expected = attach(a_field(), here, CLASSES, cameras=CAMERAS, by=by)
    found = attach(a_field(), there, CLASSES, cameras=CAMERAS, frame=splat_cameras, by=by)
    assert float((found.labels == expected.labels).float().mean()) > 0.999  # ties and borders round differently
    torch.testing.assert_close(found.similarity.matrix(), similarity.matrix(), atol=1e-3, rtol=1e-4)
    assert found.alignment.inliers == len(CAMERAS)
    assert found.transfer.distance == pytest.approx(similarity.scale * expected.transfer.distance, rel=1e-2)


def test_a_splat_in_another_frame_is_refused_with_what_to_give():
    with pytest.raises(SceneError, match=tells("frames disagree", "frame=Similarity.identity()")):
        attach(a_field(), moved(a_splat(), a_similarity()), CLASSES)


def test_a_given_distance_is_lambda():
    attached = attach(a_field(1_500), a_splat(1_500), CLASSES, distance=0.02)
    assert attached.transfer.distance == 0.02
    assert attached.facts["lambda"] == 0.02
    assert 0 < attached.transfer.orphaned == int((attached.labels == -1).sum())
    labelled, none = attached.transfer.labelled, attached.transfer.orphaned
    assert attached.notes[1].endswith(
        f"Gaussians {labelled:,} got a class by distance (lambda 0.02), {none:,} got none"
    )


def test_the_facts_survive_a_file(tmp_path):
    attached = attach(a_field(1_500), a_splat(1_500), CLASSES, cameras=CAMERAS, by="views")
    facts = json.loads(json.dumps(attached.facts, allow_nan=False))
    by_distance = f"{attached.transfer.labelled} that no view shows by distance (lambda {facts['lambda']:.3g})"
    counts = f"{facts['shown']:,} got a class by the views, {by_distance}, {facts['counts']['none']} got none"
    assert attached.notes[1].endswith(f"1,500 Gaussians {counts}")
    assert sum(facts["counts"].values()) == len(attached.gaussians)
    write_splats(attached.gaussians, tmp_path / "a.ply", facts=attached.facts)
    back = read_splats(tmp_path / "a.ply")
    assert torch.equal(back.labels, attached.labels)
    assert back.names == CLASSES.names
    written = json.loads(beside(tmp_path / "a.ply", NAMES).read_text())
    assert written["labelled by"] == "votes of 6 segmented views"


def test_what_cannot_be_done_is_refused():
    field, splats = a_field(200), a_splat(200)
    refused(lambda: attach(field, splats, CLASSES, by="magic"), "by:", "'distance', 'views'", "got 'magic'")
    refused(lambda: attach(field, splats, CLASSES, by="views"), "cameras:", 'by="views"', "got none")
    refused(lambda: attach(field, splats, CLASSES, frame=CAMERAS), "cameras:", "for frame", "got none")
    refused(lambda: attach(field, splats, CLASSES, distance=0.0), "distance:", "got 0.0")
    nothing = splats.select(torch.zeros(len(splats), dtype=torch.bool))
    refused(lambda: attach(field, nothing, CLASSES), "splats:", "got none")
    strangers = [replace(camera, name=f"other_{i}.png") for i, camera in enumerate(CAMERAS)]
    with pytest.raises(SceneError, match=tells("cameras:", "two names", "got 0")):
        attach(field, splats, CLASSES, cameras=CAMERAS, frame=strangers)


def test_labels_are_written_and_carried_to_points(tmp_path):
    scores, names = torch.tensor([0.5, 0.75]), ("wall", "chair")
    cloud = balls([[0.0, 0, 0], [5, 0, 0]], [1, 0], features=torch.eye(2), scores=scores, names=names)
    save_labelled(tmp_path / "a.ply", cloud, rule="by hand")
    read = read_splats(tmp_path / "a.ply")
    assert (read.labels.tolist(), read.scores.tolist(), read.names) == ([1, 0], [0.5, 0.75], ("wall", "chair"))
    assert read.sh is not None  # other programs show the classes
    points = {"x": np.array([0.1, 5.0, 100.0, np.nan], np.float32), "mine": np.arange(4, dtype=np.uint8)}
    points |= {name: np.zeros(4, np.float32) for name in "yz"}
    write_ply(tmp_path / "points.ply", points)
    moved, files = label_cloud(cloud, tmp_path / "points.ply", tmp_path / "labelled.ply", distance=1.0)
    columns = read_ply(tmp_path / "labelled.ply")
    assert columns["class_id"].tolist() == moved.labels.tolist() == [1, 0, -1, -1]
    assert columns["mine"].tolist() == [0, 1, 2, 3]
    assert {"red", "green", "blue"} <= set(columns)
    assert [file.name for file in files] == ["labelled.ply", "labelled.ply.classes.json"]


def test_labelled_points_are_a_ply(tmp_path):
    cloud = balls([[0.0, 0, 0]], [0], names=("wall",))
    points = {name: np.zeros(3, np.float32) for name in "xyz"}
    write_ply(tmp_path / "points.ply", points)
    refused(lambda: label_cloud(cloud, tmp_path / "points.ply", tmp_path / "points.spz"), "out:", ".ply", "points.spz")
