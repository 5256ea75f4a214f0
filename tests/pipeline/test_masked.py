"""A person walks through a third of the photos, and photos are cut out: what is left of that in colours, features and scores."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from cases_color import make_splat, surface
from cases_training import changed
from PIL import Image
from small_room import ROOM, stages

from kfgs import Camera, FeatureFolder, Uplift, fit, load_scene, rasterize
from kfgs.evaluation import LabelTruth, score_views
from kfgs.fields import UpliftConfig
from kfgs.pipeline import evaluate, open_question
from kfgs.pipeline.color import ColorConfig, TrainingPictures, fit_color
from kfgs.scenes import Scene
from kfgs.toy.room_folder import make_toy_room

FIELD = changed(ColorConfig.quick().training.with_steps(150), every=10, maximum=3_000)
QUICK = replace(ColorConfig.quick(), training=FIELD)
PERSON = slice(8, 56), slice(24, 60)  # rows and columns of 60x80 pixels
CELLS = slice(4, 28), slice(12, 30)  # the same of 30x40 features
SHIRT = (255, 0, 255)


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    return make_toy_room(tmp_path_factory.mktemp("clean") / "room", replace(ROOM, train_views=9))


@pytest.fixture
def crowded(clean, tmp_path):
    """The room, a person in every third training photo and its features, and masks of them in `hidden`."""
    room = shutil.copytree(clean, tmp_path / "room")
    scene = load_scene(room)
    for i in scene.views("train")[::3]:
        photo = np.array(Image.open(scene.image_paths[i]))
        features, mask = FeatureFolder(room / "features", [scene.stem(i)])[0], np.full(photo.shape[:2], 255, np.uint8)
        photo[PERSON], mask[PERSON], features[CELLS] = SHIRT, 0, person(features.shape[2])
        (room / "hidden").mkdir(exist_ok=True)
        Image.fromarray(photo).save(scene.image_paths[i])
        Image.fromarray(mask).save(room / "hidden" / f"{scene.cameras[i].name}.png")
        for file in (room / "features").glob(f"{scene.stem(i)}*"):
            file.unlink()
        np.save(room / "features" / f"{scene.stem(i)}.npy", features.numpy())
    return room


def person(channels):
    return torch.nn.functional.normalize(torch.randn(channels, generator=torch.Generator().manual_seed(9)), dim=0)


def with_masks(room):
    (room / "hidden").rename(room / "masks")
    return load_scene(room)


def test_the_ghost_of_a_masked_person_is_gone(clean, crowded, tmp_path):
    truth = load_scene(clean)
    views = truth.views("train")[::3]

    def look(scene, folder):
        """Where the person is: RMS against the photos without it, and how much pinker than these; and the score of all views."""
        found = fit_color(scene, folder, QUICK)
        pairs = [(rasterize(found, truth.cameras[i]).map[PERSON], truth.image(i)[PERSON]) for i in views]
        off = torch.stack([drawn - photo for drawn, photo in pairs])
        pink = off[..., 0] + off[..., 2] - 2 * off[..., 1]
        return float(off.square().mean().sqrt()), float(pink.mean() / 2), score_views(found, scene, "train").psnr.value

    ghost, shirt, worse = look(load_scene(crowded), tmp_path / "without")
    room, none, better = look(with_masks(crowded), tmp_path / "with")
    assert ghost > 1.3 * room
    assert shirt > 0.05 > 5 * abs(none)
    assert better > worse  # what is masked is not scored


def test_features_of_a_masked_person_count_nothing(clean, crowded):
    cloud, _ = surface(clean)
    method = Uplift(cloud, UpliftConfig(corrections=0))

    def fused(scene):
        maps = FeatureFolder(scene.folder / "features").of(scene, "train")
        field = fit(scene, maps, method)
        return field.decode(field.latents) @ person(maps.shape[2])

    want, polluted, masked = fused(load_scene(clean)), fused(load_scene(crowded)), fused(with_masks(crowded))
    assert polluted.max() > want.max() + 0.3
    assert masked.max() < want.max() + 0.05


def test_a_changed_mask_makes_the_stages_again(crowded, tmp_path):
    make_splat(crowded, tmp_path / "my.ply")
    brief = replace(QUICK, training=replace(FIELD, steps=2))

    def look():
        scene, lines = load_scene(crowded), []
        maps = FeatureFolder(crowded / "features").of(scene, "train")
        fit(scene, maps, Uplift(tmp_path / "my.ply"), folder=tmp_path / "run", report=lines.append)
        fit_color(scene, tmp_path / "run", brief, report=lines.append)
        return stages(lines)

    done, found = ({"uplift": word, "color": word} for word in ("done", "found"))
    assert look() == done
    (crowded / "hidden").rename(crowded / "masks")
    assert look() == done
    assert look() == found
    file = next((crowded / "masks").iterdir())
    Image.fromarray(np.full((60, 80), 255, np.uint8)).save(file)
    assert look() == done
    shutil.rmtree(crowded / "masks")
    assert look() == found


def test_masked_and_transparent_pixels_are_void_in_scores(crowded):
    scene = with_masks(crowded)
    i = scene.views("train")[0]
    with pytest.raises(TypeError, match=r"question: expected a Question, got str; call open_question\("):
        evaluate("field", str(crowded))
    question = open_question(crowded, split="train")
    assert isinstance(question.truth, LabelTruth)
    labels = question.truth.maps[scene.stem(i)]
    want = torch.zeros(60, 80, dtype=torch.bool)
    want[PERSON] = True
    assert torch.equal(labels == -1, want)
    photo = Image.open(scene.image_paths[i]).convert("RGBA")
    photo.putalpha(Image.fromarray(np.uint8(255) * (np.arange(80) >= 70)[None].repeat(60, 0)))
    photo.save(scene.image_paths[i])
    want[:, :70] = True
    assert torch.equal(open_question(crowded, split="train").truth.maps[scene.stem(i)] == -1, want)


@pytest.mark.parametrize("shade", [0.0, 0.7])
def test_a_field_is_empty_where_photos_are_transparent_also_around_a_black_ball(tmp_path, shade):
    K, cameras = torch.tensor([[36.0, 0, 16], [0, 36.0, 16], [0, 0, 1]]), []
    rows = torch.arange(32) - 15.5
    disc = rows[:, None] ** 2 + rows**2 < 8**2
    pixels = torch.zeros(32, 32, 4)
    pixels[disc] = torch.tensor([shade, shade, shade, 1.0])
    pixels[~disc] = torch.tensor([0.2, 0.9, 0.4, 0.0])  # a colour that nobody sees
    for i in range(8):  # around a ball
        turn, a = torch.eye(4), torch.tensor(i * torch.pi / 4)
        turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = a.cos(), a.sin(), -a.sin(), a.cos()
        turn[2, 3] = 3.0
        cameras.append(Camera(turn, K, 32, 32, name=f"{i}.png"))
        Image.fromarray((pixels * 255).byte().numpy()).save(tmp_path / f"{i}.png")
    points = torch.randn(400, 3, generator=torch.Generator().manual_seed(0)) * 0.8
    paths = [tmp_path / camera.name for camera in cameras]
    colors = torch.full((400, 3), int(255 * shade), dtype=torch.uint8)
    scene = Scene(cameras, paths, points, colors, {"train": list(range(8))})
    assert torch.equal(TrainingPictures(scene, [0], cameras[:1])[0][..., 3], disc.float())
    found = fit_color(scene, tmp_path / "run", QUICK)
    drawn = rasterize(found, cameras[0])
    assert drawn.alpha[~disc].mean() < 0.1
    assert drawn.alpha[disc].mean() > 0.8
    assert drawn.map[disc].mean() == pytest.approx(shade, abs=0.1)
    assert score_views(found, scene, "train").psnr.value > 20  # before black, of photos on black
