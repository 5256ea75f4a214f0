"""Damaged files that a campaign found: each is refused by an error that names it, never by another one."""

import json

import numpy as np
import pytest
import torch
from messages import refused, tells
from PIL import Image

from kfgs._arrays import save_tensors
from kfgs.evaluation.coco import load_coco_labels
from kfgs.fields.examples import read_examples
from kfgs.labels import load_label_set
from kfgs.quant import Autoencoder, Codebook
from kfgs.quant.maps import IndexMaps
from kfgs.scenes import SceneError, read_image

HUGE = 10**400  # a whole number that no float holds


@pytest.mark.parametrize(
    "example",
    [
        {"gaussians": {"x": 2}},
        {"gaussians": ["a"]},
        {"view": "a", "points": ["12", "x"]},
        {"view": "a", "points": [[1, 2, 3]]},
        {"view": "a", "points": [[HUGE, 1]]},
        {"view": "a", "box": "abcd"},
        {"view": "a"},
        {"points": [[1, 2]]},
        7,
    ],
)
def test_wrong_examples_are_named_by_file_and_place(tmp_path, example):
    file = tmp_path / "clicks.json"
    file.write_text(json.dumps({"chair": [example]}))
    refused(lambda: read_examples(file), file, "'chair'[0]", "expected an example")


def test_coordinates_beyond_every_float(tmp_path):
    square = [[HUGE, 1, 5, 1, 5, 4]]
    annotation = {"id": 1, "image_id": 1, "category_id": 1, "segmentation": square, "bbox": [1, 1, 4, 3]}
    images = [{"id": 1, "file_name": "a.png", "width": 8, "height": 6}]
    whole = {"images": images, "categories": [{"id": 1, "name": "chair"}], "annotations": [annotation]}
    (tmp_path / "annotations.json").write_text(json.dumps(whole))
    refused(lambda: dict(load_coco_labels(tmp_path / "annotations.json").maps), "annotations.json", "annotation 1")


@pytest.mark.parametrize(
    ("kind", "reader", "tensors"),
    [
        ("index maps", IndexMaps.load, {"map.0": torch.zeros(4, dtype=torch.uint8), "size": torch.tensor(3)}),
        ("index maps", IndexMaps.load, {"map.0": torch.zeros(2, 2, dtype=torch.uint8), "other": torch.tensor(3)}),
        ("codebook", Codebook.load, {"codewords": torch.zeros(2, 3)}),
        ("codebook", Codebook.load, {"rows": torch.ones(2, 3)}),
        ("autoencoder", Autoencoder.load, {"range": torch.tensor([1.0, 0.0])}),
    ],
)
def test_tensors_that_do_not_fit_name_the_file(tmp_path, kind, reader, tensors):
    file = tmp_path / "a.safetensors"
    save_tensors(file, tensors, {"kfgs": kind, "version": "1"})
    refused(lambda: reader(file), file, kind)


def test_class_names_that_repeat_name_the_file(tmp_path):
    (tmp_path / "classes.json").write_text('["chair", "chair"]')
    np.save(tmp_path / "text.npy", np.ones((2, 3), np.float32))
    refused(lambda: load_label_set(tmp_path / "classes.json", tmp_path / "text.npy"), "classes.json", "different")


@pytest.mark.parametrize("ending", ["png", "gif", "tiff"])
def test_a_small_picture_of_many_colours_is_refused_and_a_mask_of_a_photos_size_is_not(tmp_path, ending):
    from kfgs.scenes.files import open_picture

    file = tmp_path / f"a.{ending}"
    Image.new("L", (4032, 3024)).save(file, **({"compression": "tiff_deflate"} if ending == "tiff" else {}))
    assert file.stat().st_size < 60_000
    with pytest.raises(SceneError, match=tells(file, "4032x3024")):  # 380 MB as floats
        read_image(file)
    with open_picture(file) as picture:
        assert picture.size == (4032, 3024)
