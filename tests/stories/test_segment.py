"""Unseen views are segmented: both methods in mIoU, and by every engine alike."""

import pytest
import torch

import kfgs
from kfgs.pipeline import true_labels
from kfgs.splat import rasterize_labels


def miou(field, room) -> float:
    truth = true_labels(room.scene, room.folder / "labels", "test")
    labels = {room.scene.stem(i): field.segment(room.scene.cameras[i], room.classes) for i in room.scene.views("test")}
    return float(kfgs.evaluation.evaluate_segmentation(labels.__getitem__, truth, room.classes.names).miou.value)


def test_kfgs_method(fused, room, recorded):
    assert miou(fused, room) == pytest.approx(recorded["miou of the fused field"], abs=0.004)


def test_the_papers_method(paper, room, recorded):
    assert miou(paper, room) == pytest.approx(recorded["miou of the paper's field"], abs=0.01)


def test_labels_are_those_of_the_reference_engine(fused, paper, room):
    """Every pixel of an unseen view, whichever engine draws the Gaussians' classes."""
    for field in (fused, paper):
        cloud = field.label(room.classes)
        votes = torch.nn.functional.one_hot(cloud.labels + 1, len(room.classes) + 1)[:, 1:].float()
        cloud = cloud.replace(features=votes, sh=None)
        fast, plain = (rasterize_labels(cloud, room.unseen[0], engine=name).labels for name in ("auto", "reference"))
        assert torch.equal(fast, plain)
        assert len(fast.unique()) > 8
