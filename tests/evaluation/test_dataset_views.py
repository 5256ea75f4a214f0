"""From a folder to a score: scene, truth and a field of another program under a protocol."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_models import write_model, write_picture
from messages import tells
from PIL import Image

from kfgs.evaluation import LabelTruth, LerfOvs2D, MaskAndBoxes, MaskTruth, OVS3DClosed
from kfgs.evaluation.datasets import load_3dovs, load_labels, load_lerf_ovs, truth_views
from kfgs.evaluation.datasets.views import named_as_in
from kfgs.evaluation.foreign import Level, SplattedMethod
from kfgs.gaussians import Gaussians
from kfgs.pipeline import true_labels
from kfgs.scenes import Scene, load_scene

EGG, BOWL = torch.eye(4)[0], torch.eye(4)[1]


def _encode(texts: list[str]) -> torch.Tensor:
    known = {"egg": EGG, "bowl": BOWL}
    return torch.stack([known.get(text, torch.eye(4)[2]) for text in texts])


def _scene(folder: Path, names: list[str]) -> Scene:
    write_model(folder / "sparse/0", names)
    for name in names:
        write_picture(folder / "images" / name)
    return load_scene(folder)


def _wall(scene: Scene, view: int) -> SplattedMethod:
    """Egg on the left half of a view and bowl on the right: two opaque Gaussians in front of its camera."""
    camera = scene.cameras[view]
    local = torch.tensor([[-0.45, 0.0, 1.0], [0.7, 0.0, 1.0]])
    means = (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    quats, scales = torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1), torch.full((2, 3), 0.3)
    return SplattedMethod(
        "wall", [Level(Gaussians(means, quats, scales, torch.full((2,), 0.999), torch.stack([EGG, BOWL])))]
    )


def test_lerf_ovs_from_its_folder_to_a_score(tmp_path: Path) -> None:
    scene = _scene(tmp_path / "mine", ["frame_00001.png", "frame_00002.png"])
    labels = tmp_path / "label/mine"
    labels.mkdir(parents=True)
    method = _wall(scene, 1)
    likes = method.cosines(truth_views(scene, _mask_truth("frame_00002", 48, 64))[0], torch.stack([EGG, BOWL]))[0]
    x = int((likes[24, :, 0] > likes[24, :, 1]).nonzero().max())
    objects = [
        {"category": text, "bbox": [a, 0, b, 47], "segmentation": [[a, 0], [b, 0], [b, 47], [a, 47]]}
        for text, a, b in (("egg", 0, x), ("bowl", x + 1, 63))
    ]
    info = {"name": "frame_00002.jpg", "width": 64, "height": 48}
    (labels / "frame_00002.json").write_text(json.dumps({"info": info, "objects": objects}))
    truth = load_lerf_ovs(tmp_path, "mine")
    views = truth_views(scene, truth)
    assert [view.stem for view in views] == ["frame_00002"]
    report = LerfOvs2D().score(method, truth, views, _encode)
    assert report["localisation"] == 1
    assert report["mIoU"] > 0.5


def test_3dovs_from_its_folder_to_a_score(tmp_path: Path) -> None:
    scene = _scene(tmp_path, ["00.png", "01.png"])
    method = _wall(scene, 0)
    view = truth_views(scene, _mask_truth("00", 48, 64))[0]
    labels = method.cosines(view, torch.stack([EGG, BOWL]))[0].nan_to_num(-2)
    folder = tmp_path / "segmentations"
    (folder / "0").mkdir(parents=True)
    (folder / "classes.txt").write_text("egg\nbowl\n")
    best = labels.argmax(-1).masked_fill(labels.amax(-1) < -1, -1)
    for i, text in enumerate(("egg", "bowl")):
        Image.fromarray(((best == i).numpy() * 255).astype(np.uint8)).save(folder / f"0/{text}.png")
    truth = load_3dovs(tmp_path)
    report = OVS3DClosed(texts=("egg", "bowl")).score(method, truth, truth_views(scene, truth), _encode)
    assert (report["mIoU"], report["accuracy"]) == (1, 1)


def _mask_truth(stem: str, height: int, width: int) -> MaskTruth:
    return MaskTruth({stem: {"egg": MaskAndBoxes(torch.zeros(height, width, dtype=torch.bool))}})


def test_cameras_get_the_size_of_the_truth(tmp_path: Path) -> None:
    scene = _scene(tmp_path, ["a.png"])
    assert truth_views(scene, _mask_truth("a", 24, 32))[0].camera.size == (24, 32)
    assert truth_views(scene, _mask_truth("a", 24, 32), "scene")[0].camera.size == (48, 64)
    labels = LabelTruth(("egg",), {"a": torch.zeros(48, 64, dtype=torch.int64)})
    assert truth_views(scene, labels)[0].camera.size == (48, 64)
    with pytest.raises(ValueError, match=tells("'a'", "64x48", "24x32", "turned")):
        truth_views(scene, _mask_truth("a", 32, 24))


def test_labels_of_one_folder_are_not_those_of_another(tmp_path: Path) -> None:
    """A rig has a picture `a` in each folder: flat labels could be of both."""
    scene = _scene(tmp_path, ["left/a.png", "right/a.png", "left/b.png"])
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(tmp_path / "a.png")
    Image.fromarray(np.ones((48, 64), np.uint8)).save(tmp_path / "b.png")
    assert [*true_labels(scene, tmp_path, "all")] == ["left/b"]
    assert truth_views(scene, _mask_truth("b", 48, 64))[0].camera.size == (48, 64)
    with pytest.raises(ValueError, match=tells("right/b", "not in it")):
        truth_views(scene, _mask_truth("right/b", 48, 64))


def test_truth_of_another_scene(tmp_path: Path) -> None:
    scene = _scene(tmp_path, ["frame_1.png", "b.png"])
    with pytest.raises(
        ValueError, match=tells("2 views", "frame_00001 too (1 of 1", "did you mean 'frame_1.png'?", "one data set")
    ):
        truth_views(scene, _mask_truth("frame_00001", 48, 64))
    with pytest.raises(ValueError, match=tells("'b'", "none", "leave the picture out")):
        truth_views(scene, MaskTruth({"b": {}}))
    bent = write_model(tmp_path / "bent/sparse/0", ["a.png"], model="SIMPLE_RADIAL", params=[50, 31, 25, 0.1])
    write_picture(tmp_path / "bent/images/a.png")
    with pytest.raises(ValueError, match=tells("distortion", "scene.undistorted()")):
        truth_views(load_scene(bent), _mask_truth("a", 48, 64))


def test_truth_and_labels_are_found_by_names_that_are_spelled_otherwise(tmp_path: Path) -> None:
    scene = _scene(tmp_path, ["A.JPG", "K\u00fcche.png", "left/b.png"])
    files = {"a.png": 0, "Ku\u0308che.PNG": 1, "left/b.png.png": 2}
    for name, value in files.items():
        (tmp_path / "labels" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((48, 64), value, np.uint8)).save(tmp_path / "labels" / name, "PNG")
    (tmp_path / "labels/classes.json").write_text('["x", "y", "z"]', encoding="utf-8-sig")
    found = true_labels(scene, tmp_path / "labels", "all")
    assert {stem: int(labels[0, 0]) for stem, labels in found.items()} == {"A": 0, "K\u00fcche": 1, "left/b": 2}
    truth = load_labels(tmp_path / "labels")
    assert [(view.stem, view.camera.name) for view in truth_views(scene, truth)] == [
        ("Ku\u0308che", "K\u00fcche.png"), ("a", "A.JPG"), ("left/b.png", "left/b.png"),
    ]  # fmt: skip
    named = named_as_in(scene, truth)
    assert {stem: int(named.maps[stem][0, 0]) for stem in named.maps} == {"A": 0, "K\u00fcche": 1, "left/b": 2}


def test_masks_are_found_by_texts_that_are_spelled_otherwise(tmp_path: Path) -> None:
    folder = tmp_path / "segmentations"
    for name in ("0/Apple.png", "0/Cafe\u0301.PNG"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((4, 4), 255, np.uint8)).save(folder / name, "PNG")
    (folder / "classes.txt").write_bytes("\ufeffapple\r\ncaf\u00e9\r\n".encode())
    assert list(load_3dovs(tmp_path).frames["0"]) == ["apple", "caf\u00e9"]
    (folder / "0/Apple.png").rename(folder / "0/aple.png")
    with pytest.raises(ValueError, match=tells("got aple", "did you mean 'apple'?")):
        load_3dovs(tmp_path).frames["0"]
