"""Masks of photos and transparent pixels: found, read, and carried to every view of a scene."""

import json
import unicodedata
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import refused
from PIL import Image

from kfgs import Camera
from kfgs.cameras import Distortion, undistort
from kfgs.scenes import Scene, SceneError, list_images, load_scene
from kfgs.scenes.files import write_colmap_masks

POSE = [[1, 0, 0, 0], [0, 0, -1, -2], [0, 1, 0, 1], [0, 0, 0, 1]]
KEPT = np.zeros((24, 32), bool)
KEPT[:, 12:] = True


def save(path, pixels, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)


def make_scene(folder: Path, names: list[str], **frames) -> Path:
    """A transforms.json with grey photos of 32x24; `frames` are more values of each frame."""
    for name in names:
        save(folder / "images" / name, np.full((24, 32, 3), 99, np.uint8))
    listed = [{"file_path": f"images/{name}", "transform_matrix": POSE} | frames for name in names]
    (folder / "transforms.json").write_text(json.dumps({"w": 32, "h": 24, "fl_x": 30, "frames": listed}))
    return folder


def test_black_is_ignored_whatever_kind_of_picture_the_mask_is(tmp_path):
    grey, clear = KEPT.astype(np.uint8) * 255, np.full((24, 32, 4), 255, np.uint8)
    clear[..., 3] = grey
    red = np.zeros((24, 32, 3), np.uint8)
    red[KEPT] = 200, 0, 0
    kinds = {
        "a.png": Image.fromarray(grey),
        "b.png": Image.fromarray(KEPT.astype(np.uint8)),  # 0 and 1
        "c.png": Image.fromarray(KEPT),  # one bit
        "d.png": Image.fromarray(clear),
        "e.png": Image.fromarray(red),
        "f.png": Image.fromarray(red).quantize(2),
        "g.png": Image.fromarray(grey.astype(np.uint16) * 257),
        "h.jpg": Image.fromarray(grey),  # with grey values near black and white
    }
    scene = make_scene(tmp_path, [name.replace(".jpg", ".png") for name in kinds])
    (tmp_path / "masks").mkdir()
    for name, picture in kinds.items():
        picture.save(tmp_path / "masks" / name)
    loaded = load_scene(scene)
    assert f"masks: 8 of 8 photos have one in {tmp_path / 'masks'}; black is ignored" in loaded.notes
    for i in range(8):
        assert np.array_equal(loaded.mask(i).numpy(), KEPT), loaded.cameras[i].name
    save(tmp_path / "masks/a.png", np.zeros((24, 32), np.uint8))
    assert not loaded.mask(0).any()


def test_a_mask_has_the_name_of_its_photo_in_any_spelling(tmp_path):
    composed = "K\u00fcche.png"
    photos = ["left/a.jpg", "right/a.jpg", "IMG_1.JPG", "b.jpg", composed, "none.jpg"]
    masks = ["left/a.jpg.png", "right/a.png", "img_1.jpg.PNG", "b.jpg", unicodedata.normalize("NFD", composed), "x.png"]
    make_scene(tmp_path, photos)
    for name in masks:
        save(tmp_path / "masks" / name, KEPT.astype(np.uint8) * 255)
    scene = load_scene(tmp_path)
    given = {camera.name: mask for camera, mask in zip(scene.cameras, scene.masks, strict=True)}
    want = dict(zip(photos, [*masks[:5], None], strict=True))
    assert given == {photo: None if mask is None else tmp_path / "masks" / mask for photo, mask in want.items()}
    (note,) = (note for note in scene.notes if note.startswith("masks:"))
    assert note.endswith("black is ignored; 1 more have the name of no photo, or of several: x.png")
    assert "5 of 6 photos" in note
    assert scene.select(["b.jpg"]).masks == [tmp_path / "masks/b.jpg"]


def test_photos_that_differ_by_case_alone_have_their_own_masks(tmp_path):
    make_scene(tmp_path, ["a.jpg", "A.jpg"])
    if len(list_images(tmp_path / "images")) < 2:
        pytest.skip("this disk does not tell upper case from lower case")
    for names in (["A.png", "a.png"], ["A.jpg.png", "a.jpg.png"]):
        for name in names:
            save(tmp_path / "masks" / name, KEPT.astype(np.uint8) * 255)
        scene = load_scene(tmp_path)
        given = {camera.name: mask.name for camera, mask in zip(scene.cameras, scene.masks, strict=True)}
        assert given == {"A.jpg": names[0], "a.jpg": names[1]}
        for name in names:
            (tmp_path / "masks" / name).unlink()


def test_names_that_match_nothing_are_told(tmp_path):
    make_scene(tmp_path, ["a.png", "b.png"])
    save(tmp_path / "masks/c.png", KEPT.astype(np.uint8))
    scene = load_scene(tmp_path)
    assert scene.masks is None
    words = "none of 1 masks (c.png) has the name of one photo, such as a.png; none is used"
    assert f"{tmp_path / 'masks'}: {words}" in scene.notes
    (tmp_path / "masks/c.png").rename(tmp_path / "masks/a.png")  # what the note says
    assert load_scene(tmp_path).masks == [tmp_path / "masks/a.png", None]


def test_a_smaller_or_larger_mask_is_resized_and_another_shape_refused(tmp_path):
    make_scene(tmp_path, ["a.png"])
    large = np.ones((48, 64), np.uint8)
    large[10, 21] = 0  # half of pixel (5, 10): it does not count
    save(tmp_path / "masks/a.png", large * 255)
    want = np.ones((24, 32), bool)
    want[5, 10] = False
    assert np.array_equal(load_scene(tmp_path).mask(0).numpy(), want)
    save(tmp_path / "masks/a.png", KEPT[::2, ::2].astype(np.uint8) * 255)
    assert np.array_equal(load_scene(tmp_path).mask(0).numpy(), KEPT)
    save(tmp_path / "masks/a.png", np.ones((32, 32), np.uint8) * 255)
    refused(lambda: load_scene(tmp_path), "a.png:", "expected a mask", "got 32x32", "take it away", error=SceneError)
    (tmp_path / "masks/a.png").unlink()
    assert load_scene(tmp_path).masks is None


def test_mask_path_is_read_and_a_missing_one_counted(tmp_path):
    folder = make_scene(tmp_path, ["a.png", "b.png", "c.png"], mask_path="hidden\\m.png")
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][1]["mask_path"] = "hidden/lost.png"
    del content["frames"][2]["mask_path"]
    (folder / "transforms.json").write_text(json.dumps(content))
    save(folder / "hidden/m.png", KEPT.astype(np.uint8) * 255)
    for options in ({}, {"images": folder / "images"}):
        scene = load_scene(folder, **options)
        assert scene.masks == [folder / "hidden/m.png", None, None]
        assert np.array_equal(scene.mask(0).numpy(), KEPT)
        assert scene.mask(2).all()
        assert "masks: 1 of 3 frames have a mask_path; black is ignored" in scene.notes
        assert "1 files of mask_path are missing, and those frames have no mask: 'hidden/lost.png'" in scene.notes


def test_masks_beside_linked_pictures_are_found_and_are_no_photos(tmp_path):
    """`kfgs sfm` links `images` to the photos; masks lie beside them, or in a folder `masks` among them."""
    make_scene(tmp_path / "photos", ["a.png"])
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene/images").symlink_to(tmp_path / "photos/images")
    (tmp_path / "scene/transforms.json").write_text((tmp_path / "photos/transforms.json").read_text())
    save(tmp_path / "photos/masks/a.png", KEPT.astype(np.uint8))
    assert np.array_equal(load_scene(tmp_path / "scene").mask(0).numpy(), KEPT)
    (tmp_path / "photos/masks").rename(tmp_path / "photos/images/masks")
    assert np.array_equal(load_scene(tmp_path / "scene").mask(0).numpy(), KEPT)
    assert list_images(tmp_path / "photos/images") == ["a.png"]


def test_a_mask_and_transparency_go_through_the_lens(tmp_path):
    lens = Distortion("brown_conrady", (0.3, 0.05, 0.001, -0.002))
    K = torch.tensor([[26.0, 0, 16.5], [0, 26.0, 11.5], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, 32, 24, name="a.png", distortion=lens)
    pixels = np.full((24, 32, 4), 200, np.uint8)
    pixels[..., 3] = KEPT * 255
    save(tmp_path / "a.png", pixels)
    save(tmp_path / "m.png", KEPT.astype(np.uint8))
    empty = torch.zeros(0, 3)
    taken = Scene([camera], [tmp_path / "a.png"], empty, empty.byte(), masks=[tmp_path / "m.png"])
    scene = taken.undistorted()
    share, _, recorded = undistort(torch.from_numpy(~KEPT).float()[..., None], camera)
    assert torch.equal(scene.mask(0), recorded & (share[..., 0] < 1e-3))
    torch.testing.assert_close(scene.alpha(0)[recorded], 1 - share[..., 0][recorded])
    assert np.array_equal(taken.mask(0).numpy(), KEPT)
    black = scene.image(0)[..., 0] * 255
    torch.testing.assert_close(black[recorded], 200 * (1 - share[..., 0])[recorded], atol=1e-3, rtol=0)
    bare = replace(scene, masks=None)
    assert torch.equal(bare.mask(0), recorded)


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P"])
def test_transparent_pixels_are_black_and_do_not_count(tmp_path, mode):
    make_scene(tmp_path, ["a.png", "b.png"])
    pixels = np.full((24, 32, 4), 200, np.uint8)
    pixels[..., 3] = KEPT * 255
    picture = Image.fromarray(pixels)
    if mode == "P":
        indexed = Image.fromarray(KEPT.astype(np.uint8), "L").convert("P")
        indexed.putpalette([255, 255, 255, 200, 200, 200])
        indexed.save(tmp_path / "images/a.png", transparency=0)
    else:
        picture.convert(mode).save(tmp_path / "images/a.png")
    scene = load_scene(tmp_path)
    assert np.array_equal((scene.image(0)[..., 0] * 255).round().numpy(), KEPT * 200)
    assert np.array_equal(scene.alpha(0).numpy(), KEPT)
    assert scene.mask(0).all()  # empty, and not unknown
    assert np.array_equal(scene.counted(0, (12, 16)).numpy(), KEPT[::2, ::2])
    assert scene.alpha(1) is None
    assert scene.counted(1, (12, 16)) is None


def test_pycolmap_gets_a_mask_of_every_photo_or_of_none(tmp_path):
    make_scene(tmp_path, ["left/a.jpg", "b.png"])
    photos = {name: (tmp_path / "images" / name, None) for name in ("left/a.jpg", "b.png")}
    assert write_colmap_masks(tmp_path / "out", photos) is None
    save(tmp_path / "m.png", KEPT.astype(np.uint8))
    photos["left/a.jpg"] = (photos["left/a.jpg"][0], tmp_path / "m.png")
    assert write_colmap_masks(tmp_path / "out", photos) == str(tmp_path / "out")
    assert np.array_equal(np.asarray(Image.open(tmp_path / "out/left/a.jpg.png")), KEPT * np.uint8(255))
    assert (np.asarray(Image.open(tmp_path / "out/b.png.png")) == 255).all()
