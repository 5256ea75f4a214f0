"""A scene in blocks: its fields join to what one field of the whole scene says, and only what is needed is read."""

import json
import shutil

import numpy as np
import pytest
import torch
from cases_clouds import balls
from messages import refused, tells
from PIL import Image

from benchmarks.toy_town import make_toy_town
from kfgs._files import read_json, write_json
from kfgs.batch import fit_blocks, join_blocks
from kfgs.cli import main
from kfgs.fields import SemanticField, UpliftConfig, uplift_maps
from kfgs.fields.store import recall_scene
from kfgs.formats import read_splats, write_splats
from kfgs.pipeline import Uplift
from kfgs.quant import LinearLatents
from kfgs.scenes import FeatureFolder, SceneError, load_scene
from kfgs.toy.room_folder import ToyConfig

ROOM = ToyConfig(
    train_views=8, test_views=2, size=(60, 80), feature_size=(30, 40), feature_dim=24, surface_points=3_000, sparse_points=800
)  # fmt: skip
EVERY = Uplift(uplift=UpliftConfig(corrections=0))


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    return make_toy_town(tmp_path_factory.mktemp("town") / "town", (2, 1), ROOM)


@pytest.fixture(scope="module")
def splat(town):
    """A small ball on each true surface point."""
    points = torch.from_numpy(np.load(town / "surface.npz")["points"])
    cloud = balls(points, scale=0.04, opacity=0.95, sh=torch.zeros(len(points), 1, 3))
    write_splats(cloud, town.parent / "splat.ply")
    return town.parent / "splat.ply"


@pytest.fixture(scope="module")
def city(town, splat):
    """The folder of three fitted blocks."""
    facts = fit_blocks(town, town.parent / "blocks", 3, EVERY, splat=splat, latents=12)
    assert list(facts) == ["block00", "block01", "block02"]
    return town.parent / "blocks"


def ordered(means):
    return np.lexsort(means.numpy().T)


def test_blocks_join_to_what_the_whole_scene_says(city, town, splat):
    scene, joined = load_scene(town), join_blocks(city)
    cameras = [scene.cameras[i] for i in scene.views("train")]
    latents = LinearLatents.load(city / "latents.safetensors")
    maps = FeatureFolder(town / "features").of(scene, "train")
    whole = uplift_maps(read_splats(splat), cameras, maps, EVERY.uplift, latents=latents).gaussians
    assert len(joined) == len(whole)  # each Gaussian has one block
    one, other = ordered(joined.gaussians.means), ordered(whole.means)
    assert torch.equal(joined.gaussians.means[one], whole.means[other])
    a, b = joined.gaussians.features[one], whole.features[other]
    known = a.any(1) & b.any(1)
    assert float(known.float().mean()) > 0.95
    assert float((a.any(1) == b.any(1)).float().mean()) > 0.99
    cosines = torch.nn.functional.cosine_similarity(a[known], b[known], dim=1)
    assert float((cosines > 0.99).float().mean()) > 0.99  # a view of which a block has less than 1 % is left out
    assert float(cosines.min()) > 0.7
    assert recall_scene(joined.info) == town.resolve()
    assert joined.classes is not None


def test_only_blocks_that_touch_the_box_are_read(city, monkeypatch):
    reads, load, joined = [], SemanticField.load, join_blocks(city)
    monkeypatch.setattr(SemanticField, "load", staticmethod(lambda path: reads.append(path.parent.name) or load(path)))
    part = join_blocks(city, [-4, -4, -1], [4, 4, 4])  # the first room
    assert 0 < len(part) < len(joined)
    assert len(reads) < 3
    means = joined.gaussians.means
    inside = ((means >= -4) & (means <= 4)).all(1) & (means[:, 2] >= -1)
    assert len(part) == int(inside.sum())
    reads.clear()
    for low, high, word in (([500] * 3, [501] * 3, "all of them lie in"), ([1] * 3, [0] * 3, "low corner")):
        refused(lambda high=high, low=low: join_blocks(city, low, high), "low, high", word)
    assert reads == []


def test_a_second_call_repeats_nothing_and_other_blocks_are_refused(city, town, splat):
    stages = {path: path.stat().st_mtime_ns for path in city.glob("*/.run/stages/*")}
    fit_blocks(town, city, 3, EVERY, splat=splat, latents=12)
    assert {path: path.stat().st_mtime_ns for path in city.glob("*/.run/stages/*")} == stages
    for count, latents in ((4, 12), (3, 8)):
        with pytest.raises(ValueError, match=tells("out", "others")):
            fit_blocks(town, city, count, EVERY, splat=splat, latents=latents)


def test_a_block_that_fails_is_named_and_the_others_are_finished(town, splat, tmp_path):
    fit_blocks(town, tmp_path, 2, EVERY, splat=splat, latents=12)
    expected = join_blocks(tmp_path)
    shutil.rmtree(tmp_path / "block01/.run")
    good = (tmp_path / "block01/splat.ply").read_bytes()
    (tmp_path / "block01/splat.ply").write_bytes(b"damaged")
    refused(lambda: fit_blocks(town, tmp_path, 2, EVERY, splat=splat, latents=12), "block01", "splat.ply")
    assert (tmp_path / "block00/core.json").is_file()
    (tmp_path / "block01/core.json").unlink(missing_ok=True)
    refused(lambda: join_blocks(tmp_path), "block01", "core.json", "fit_blocks", error=FileNotFoundError)
    (tmp_path / "block01/splat.ply").write_bytes(good)
    fit_blocks(town, tmp_path, 2, EVERY, splat=splat, latents=12)
    assert torch.equal(join_blocks(tmp_path).gaussians.features, expected.gaussians.features)
    facts = read_json(tmp_path / "block00/core.json")
    write_json(tmp_path / "block00/core.json", facts | {"options": "others"})
    refused(lambda: join_blocks(tmp_path), "same options")


def test_masks_go_with_the_photos(town, splat, tmp_path):
    masked = shutil.copytree(town, tmp_path / "town", symlinks=True)
    mask = np.full((60, 80), 255, np.uint8)
    mask[:, :30] = 0
    for camera in load_scene(town).cameras:
        (masked / "masks" / camera.name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(masked / "masks" / f"{camera.name}.png")
    fit_blocks(masked, tmp_path / "blocks", 2, EVERY, splat=splat, latents=4)
    for name in ("block00", "block01"):
        part = load_scene(tmp_path / "blocks" / name)
        assert all(part.mask(i).sum() == 60 * 50 for i in range(len(part)))


def test_what_cannot_be_cut(tmp_path, town):
    shutil.copytree(town, tmp_path / "town", ignore=shutil.ignore_patterns("sparse"))
    K = {"fl_x": 60, "w": 80, "h": 60, "transform_matrix": np.eye(4).tolist()}
    frames = [{"file_path": f"images/{file.name}", **K} for file in (tmp_path / "town/images").iterdir()]
    (tmp_path / "town/transforms.json").write_text(json.dumps({"frames": frames}))
    refused(lambda: fit_blocks(tmp_path / "town", tmp_path / "o", 2), "scene", "COLMAP", error=SceneError)
    refused(lambda: join_blocks(tmp_path), "blocks.json", "fit_blocks", error=FileNotFoundError)


def test_a_part_of_space_may_be_empty(town, splat, tmp_path):
    cloud = read_splats(splat)
    write_splats(cloud.select(cloud.means[:, 0] < 4), tmp_path / "room.ply")  # the first room
    facts = fit_blocks(town, tmp_path / "city", 2, EVERY, splat=tmp_path / "room.ply", latents=4)
    assert sorted(fact["box"] is None for fact in facts.values()) == [False, True]
    assert len(join_blocks(tmp_path / "city")) == int((cloud.means[:, 0] < 4).sum())


def test_the_command(town, splat, tmp_path, capsys):
    out = tmp_path / "city"
    assert main(["batch", str(town), "--out", str(out), "--blocks", "2", "--splat", str(splat)]) == 0
    assert "block01: " in capsys.readouterr().out
    assert len(SemanticField.load(out / "field.kfgs")) == len(join_blocks(out))
    assert main(["convert", str(out / "field.kfgs")]) == 0
