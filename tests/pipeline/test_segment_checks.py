"""What `segment_scene` refuses before it segments a view."""

import pytest
import torch
from messages import tells

from kfgs import Gaussians
from kfgs.cameras import Camera
from kfgs.fields import Identity, SemanticField
from kfgs.labels import LabelSet
from kfgs.pipeline import segment_scene
from kfgs.pipeline.describe import describe
from kfgs.scenes import Scene

WORDS = LabelSet(("wall", "chair", "door"), torch.eye(3))


def parts(folder):
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=32, height=24, name="a.png")
    cloud = Gaussians(torch.eye(3), torch.ones(3, 4), torch.ones(3, 3), torch.full((3,), 0.5), features=torch.eye(3))
    none = torch.zeros(0, 3)
    scene = Scene([camera], [folder / "images/a.png"], none, none.byte(), {"test": [0]}, folder=folder)
    return SemanticField(cloud, Identity(cloud.features.shape[1])), scene, WORDS


@pytest.mark.parametrize("out", ["maps", "maps/inside"])
def test_no_pictures_go_among_the_feature_maps_that_are_read(out, tmp_path):
    maps = tmp_path / "maps"
    maps.mkdir()
    with pytest.raises(ValueError, match=tells("out", "apart from the pictures and feature maps", str(maps))):
        segment_scene(*parts(tmp_path), tmp_path / out, maps=maps, pictures=0)
    assert list(maps.iterdir()) == []


def test_true_labels_of_other_classes_are_refused_before_the_work(tmp_path):
    truth = {"a": torch.full((24, 32), 7)}
    with pytest.raises(ValueError, match=tells("truth['a']", "labels below 3", "got 7")):
        segment_scene(*parts(tmp_path), tmp_path / "out", truth=truth, pictures=0)
    assert not (tmp_path / "out").exists()
    truth = {"a": torch.full((24, 32), 2)}
    assert set(segment_scene(*parts(tmp_path), tmp_path / "out", truth=truth, pictures=0)) == {"a"}


def test_maps_of_another_program_are_described(tmp_path):
    torch.save(torch.ones(8, 6, 9), tmp_path / "view_0_fmap_CxHxW.pt")
    assert describe(tmp_path) == f"{tmp_path}: 1 feature maps of another program\n  6 x 9 cells, 8 channels"
