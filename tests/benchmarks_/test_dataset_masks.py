"""Masks of texts: LERF-OVS, 3D-OVS, LEGaussians. The folders are written here as those data sets have them."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import refused, tells
from PIL import Image
from published.class_lists import load_classes
from published.mask_truth import MaskTruth
from published.truth.find import find_masks
from published.truth.lerf_ovs import load_lerf_ovs
from published.truth.ovs3d import load_3dovs

FRAMES = load_classes("lerf_ovs")["frames"]
LEGAUSSIANS = load_classes("legaussians") | load_classes("legaussians_views")
SQUARE = [[2, 1], [5, 1], [5, 3], [2, 3]]


def _object(category: str, outline: list, box: list | None = None) -> dict:
    return {"category": category, "bbox": box or [2, 1, 5, 3], "segmentation": outline, "group": 0, "iscrowd": 0}


def _lerf(folder: Path, scene: str = "ramen", objects: list[dict] | None = None) -> Path:
    labels = folder / "label" / scene
    labels.mkdir(parents=True, exist_ok=True)
    objects = [_object("egg", SQUARE), _object("sake cup", [[7, 7], [9, 7], [9, 9]])] if objects is None else objects
    for number in FRAMES[scene]:
        info = {"name": f"frame_{number:05d}.jpg", "width": 12, "height": 10}
        (labels / f"frame_{number:05d}.json").write_text(json.dumps({"info": info, "objects": objects}))
    return labels


def test_lerf_ovs_objects_of_one_text_are_one_mask_with_several_boxes(tmp_path: Path) -> None:
    objects = [
        _object("egg", SQUARE),
        _object("bowl", [[0, 0], [1, 0], [1, 1]]),
        _object("egg", [[8, 8], [9, 8], [9, 9]], [8, 8, 9, 9]),
    ]
    truth = load_lerf_ovs(_lerf(tmp_path, objects=objects))
    assert list(truth.frames) == [f"frame_{n:05d}" for n in (6, 24, 60, 65, 81, 119, 128)]
    frame = truth.frames["frame_00024"]
    assert list(frame) == ["egg", "bowl"]
    expected = torch.zeros(10, 12, dtype=torch.bool)
    expected[1:4, 2:6] = True  # borders of the polygon belong to it
    expected[8, 8] = expected[8, 9] = expected[9, 9] = True
    assert torch.equal(frame["egg"].mask, expected)
    assert frame["egg"].boxes.tolist() == [[2, 1, 5, 3], [8, 8, 9, 9]]
    assert int(frame["bowl"].mask.sum()) == 3
    assert truth.texts == ("egg", "bowl")


def _mask(path: Path, box: tuple[int, int, int, int], size: tuple[int, int] = (10, 12), value: int = 255) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    grey = np.zeros(size, np.uint8)
    grey[box[1] : box[3], box[0] : box[2]] = value
    Image.fromarray(grey).save(path)


def _3dovs(folder: Path) -> Path:
    (folder / "segmentations").mkdir(parents=True)
    (folder / "segmentations/classes.txt").write_text("banana\nblack leather shoe\n\n")
    (folder / "images").mkdir()
    for i in range(12):
        Image.new("RGB", (12, 10)).save(folder / f"images/{i:02d}.jpg")
    for view in ("00", "4"):
        _mask(folder / f"segmentations/{view}/banana.png", (1, 2, 3, 4))
        _mask(folder / f"segmentations/{view}/black leather shoe.png", (5, 2, 9, 4), value=1 if view == "4" else 255)
    (folder / "segmentations/4/banana.png").unlink()
    return folder


def test_3dovs(tmp_path: Path) -> None:
    truth = load_3dovs(_3dovs(tmp_path / "bed"))
    assert truth.listed == ("banana", "black leather shoe")
    assert isinstance(truth, MaskTruth)
    assert {stem: list(texts) for stem, texts in truth.frames.items()} == {
        "00": ["banana", "black leather shoe"],
        "04": ["black leather shoe"],
    }
    assert truth.frames["00"]["banana"].mask.nonzero().tolist() == [[2, 1], [2, 2], [3, 1], [3, 2]]
    assert int(truth.frames["04"]["black leather shoe"].mask.sum()) == 8  # a mask of zeros and ones
    assert truth.frames["00"]["banana"].boxes is None
    assert len(load_3dovs(tmp_path / "bed/segmentations").frames) == 2


def _legaussians(folder: Path, scene: str = "kitchen") -> Path:
    texts = LEGAUSSIANS[scene]
    for i, view in enumerate(LEGAUSSIANS["views"][scene]):
        _mask(folder / scene / "segmentations" / view / f"{texts[i % len(texts)]}.png", (1, 2, 3, 4))
    return folder / scene


def test_masks_are_found_by_their_files(tmp_path: Path) -> None:
    _lerf(tmp_path / "lerf")
    (tmp_path / "lerf/ramen/images").mkdir(parents=True)
    scenes = (tmp_path / "lerf/ramen", tmp_path / "lerf/label/ramen", tmp_path / "lerf")
    for place, texts in (
        *((place, ("egg", "sake cup")) for place in scenes),
        (_3dovs(tmp_path / "bed"), ("banana", "black leather shoe")),
        (tmp_path / "bed/segmentations", ("banana", "black leather shoe")),
        (_legaussians(tmp_path), tuple(LEGAUSSIANS["kitchen"])),
    ):
        assert set(find_masks(place).texts) <= set(texts), place
    with pytest.raises(FileNotFoundError, match=tells("truth", "masks", "images", "segmentations/classes.txt", "none")):
        find_masks(tmp_path / "bed/images")
    (tmp_path / "scene/images").mkdir(parents=True)
    (tmp_path / "scene/classes.json").write_text("[]")  # a scene's loose JSON is no ground truth
    refused(lambda: find_masks(tmp_path / "scene"), "truth", "masks", "none", error=FileNotFoundError)
