"""A scene in blocks: its fields join to what one field of the whole scene says, and only what is needed is read."""

import dataclasses
import json
import re
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from kfgs.scale import FieldInBlocks, fit_block, fit_blocks, split_scene
from kfgs.scale.blocks import _put
from kfgs.scale.in_blocks import _in_view
from killed import kill_everywhere
from messages import tells
from PIL import Image

from benchmarks.toy_town import make_toy_town
from kfgs.cli import main
from kfgs.evaluation import load_label_map
from kfgs.features import FeatureFolder
from kfgs.fields import (
    Linear,
    SemanticField,
    UpliftConfig,
    join_fields,
    recall_scene,
    sample_latents,
    uplift_maps,
)
from kfgs.formats import read_splats, write_splats
from kfgs.gaussians import Gaussians
from kfgs.labels import transfer_labels
from kfgs.pipeline import Uplift
from kfgs.quant import LinearLatents
from kfgs.scenes import SceneError, load_scene
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
    n = len(points)
    quats, scales = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.full((n, 3), 0.04)
    cloud = Gaussians(points, quats, scales, torch.full((n,), 0.95), sh=torch.zeros(n, 1, 3))
    write_splats(cloud, town.parent / "splat.ply")
    return town.parent / "splat.ply"


@pytest.fixture(scope="module")
def fitted(town, splat):
    folder = town.parent / "blocks"
    split_scene(town, folder, 3, splat=splat, latents=12)
    return fit_blocks(folder, EVERY)


@pytest.fixture(scope="module")
def whole(town, splat, fitted):
    """The same Gaussians with the same latents, fused at once."""
    scene = load_scene(town)
    cameras, maps = (
        [scene.cameras[i] for i in scene.views("train")],
        FeatureFolder(town / "features").of(scene, "train"),
    )
    latents = LinearLatents.load(fitted.folder / "latents.safetensors")
    return uplift_maps(read_splats(splat), cameras, maps, EVERY.uplift, latents=latents)


def ordered(means):
    return np.lexsort(means.numpy().T)


def test_a_town_is_one_scene(town):
    scene = load_scene(town)
    assert len(scene.cameras) == 20
    assert {camera.name[:5] for camera in scene.cameras} == {"r000_", "r001_"}
    assert len(scene.views("train")) == 16
    x = scene.points[:, 0]
    assert int((x.abs() < 4).sum()) > 600
    assert int(((x - 8).abs() < 4).sum()) > 600  # the second room
    assert load_label_map(town / "labels" / f"{scene.stem(19)}.png").shape == (60, 80)


def test_blocks_join_to_what_the_whole_scene_says(fitted, whole):
    joined = fitted.joined()
    assert len(joined) == len(fitted) == len(whole.gaussians)  # each Gaussian has one block
    one, other = ordered(joined.gaussians.means), ordered(whole.gaussians.means)
    assert torch.equal(joined.gaussians.means[one], whole.gaussians.means[other])
    a, b = joined.gaussians.features[one], whole.gaussians.features[other]
    known = a.any(1) & b.any(1)
    assert float(known.float().mean()) > 0.95
    assert float((a.any(1) == b.any(1)).float().mean()) > 0.99
    cosines = torch.nn.functional.cosine_similarity(a[known], b[known], dim=1)
    assert float((cosines > 0.99).float().mean()) > 0.99  # a view of which a block has less than 1 % is left out
    assert float(cosines.min()) > 0.7


def test_questions_read_one_block_at_a_time(fitted, monkeypatch):
    reads = []
    load = SemanticField.load
    monkeypatch.setattr(SemanticField, "load", staticmethod(lambda path: reads.append(path.parent.name) or load(path)))
    found = {name: int(selection.mask.sum()) for name, selection in fitted.query("chair")}
    assert reads == list(found) == [block.name for block in fitted.blocks]
    joined = fitted.joined()
    assert sum(found.values()) == int(joined.query("chair").mask.sum())
    reads.clear()
    part = fitted.within([-4, -4, -1], [4, 4, 4])  # the first room
    assert 0 < len(part) < len(joined)
    assert len(reads) < len(fitted.blocks)
    with pytest.raises(ValueError, match=tells("low, high", "none")):
        fitted.within([500, 500, 500], [501, 501, 501])


def test_a_view_needs_the_blocks_in_its_picture(fitted, town):
    scene = load_scene(town)
    joined = fitted.joined()
    for i in (0, 5, 13, 19):
        seen = fitted.seen_from(scene.cameras[i])
        assert torch.equal(seen.segment(scene.cameras[i]), joined.segment(scene.cameras[i])) or (
            float((seen.segment(scene.cameras[i]) == joined.segment(scene.cameras[i])).float().mean()) > 0.999
        )


@pytest.mark.parametrize("distance", [0.05, 0.5])
def test_labels_are_those_of_the_joined_field(fitted, splat, distance):
    joined, dst = fitted.joined(), read_splats(splat)
    dst = dst.replace(means=dst.means + 0.03 * torch.randn(dst.means.shape, generator=torch.Generator().manual_seed(0)))
    expected = transfer_labels(joined.gaussians, joined.classify().labels, dst, distance).labels
    assert int((expected >= 0).sum()) > 1000
    assert torch.equal(fitted.transfer(dst, distance), expected)


def test_a_second_fit_repeats_nothing(fitted):
    said = []
    fit_block(fitted.folder / "block00", EVERY, report=said.append)
    assert any("found in" in line for line in said)
    assert not any("working" in line for line in said)


def test_any_engine_fits_blocks(fitted, town, splat, tmp_path):
    split_scene(town, tmp_path / "pool", 2, splat=splat, latents=12)
    with ThreadPoolExecutor(2) as pool:
        one = fit_blocks(tmp_path / "pool", EVERY, client=pool)
        shutil.rmtree(tmp_path / "pool/block01/.run")
        (tmp_path / "pool/block01/splat.ply").write_bytes(b"damaged")
        with pytest.raises(ValueError, match=tells("block01", "splat.ply")):
            fit_blocks(tmp_path / "pool", EVERY, client=pool)
    split_scene(town, tmp_path / "alone", 2, splat=splat, latents=12)
    other = fit_blocks(tmp_path / "alone", EVERY)
    assert torch.equal(one.joined().gaussians.features, other.joined().gaussians.features)


def test_masks_go_with_the_photos(town, splat, tmp_path):
    masked = shutil.copytree(town, tmp_path / "town", symlinks=True)
    scene = load_scene(town)
    mask = np.full((60, 80), 255, np.uint8)
    mask[:, :30] = 0
    for camera in scene.cameras:
        (masked / "masks" / camera.name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(masked / "masks" / f"{camera.name}.png")
    for block in split_scene(masked, tmp_path / "blocks", 2, splat=splat, latents=4):
        part = load_scene(tmp_path / "blocks" / block.name)
        assert all(part.mask(i).sum() == 60 * 50 for i in range(len(part)))


def test_other_blocks_are_not_overwritten(fitted, town):
    with pytest.raises(ValueError, match=tells("out", "others")):
        split_scene(town, fitted.folder, 4)


def test_what_cannot_be_cut_or_opened(tmp_path, town):
    shutil.copytree(town, tmp_path / "town", ignore=shutil.ignore_patterns("sparse"))
    K = {"fl_x": 60, "w": 80, "h": 60, "transform_matrix": np.eye(4).tolist()}
    frames = [{"file_path": f"images/{file.name}", **K} for file in (tmp_path / "town/images").iterdir()]
    (tmp_path / "town/transforms.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(SceneError, match=tells("scene", "COLMAP")):
        split_scene(tmp_path / "town", tmp_path / "o", 2)
    with pytest.raises(FileNotFoundError, match=tells("blocks.json", "no such", "kfgs blocks")):
        FieldInBlocks.open(tmp_path)
    split_scene(town, tmp_path / "unfitted", 2)
    with pytest.raises(FileNotFoundError, match=tells("core.json", "kfgs blocks")):
        FieldInBlocks.open(tmp_path / "unfitted")


def test_fields_join_only_if_their_latents_agree(fitted):
    one, other = fitted.field("block00"), fitted.field("block01")
    turned = dataclasses.replace(other, decoder=Linear(LinearLatents(other.decoder.latents.basis.flip(1))))
    with pytest.raises(ValueError, match=tells("fields[1]", "latents")):
        join_fields([one, turned])
    with pytest.raises(ValueError, match=tells("fields", "none")):
        join_fields([])
    half = one.select(torch.arange(len(one)) % 2 == 0)
    assert torch.equal(half.seen.pixels, one.seen.pixels[::2])
    assert torch.equal(half.cosines(torch.eye(24)[:2]), one.cosines(torch.eye(24)[:2])[::2])


def test_sampled_latents_hold_the_features(town):
    scene = load_scene(town)
    maps = FeatureFolder(town / "features").of(scene, "train")
    latents = sample_latents(maps, count=16)
    rows = torch.nn.functional.normalize(maps[3].flatten(0, 1), dim=1)
    assert latents.latent == 16
    assert float(latents.decode(latents.encode(rows)).norm(dim=1).mean()) > 0.93


def test_the_commands(town, splat, tmp_path, capsys):
    out = tmp_path / "city"
    assert main(["blocks", str(town), "--out", str(out), "--count", "2", "--splat", str(splat)]) == 0
    said = capsys.readouterr().out
    assert "block01" in said
    assert "all lie in the box -3" in said
    assert main(["blocks", str(town), "--out", str(tmp_path / "none"), "--count", "2", "--workers", "0"]) == 1
    assert "--workers" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
    assert main(["join", str(out), "--out", str(tmp_path / "field.kfgs")]) == 0
    assert len(SemanticField.load(tmp_path / "field.kfgs")) == len(FieldInBlocks.open(out))
    box = ["--box=-4,-4,-1,4,4,4"]
    assert main(["join", str(out), "--out", str(tmp_path / "part"), *box]) == 0
    assert len(SemanticField.load(tmp_path / "part")) < len(SemanticField.load(tmp_path / "field.kfgs"))
    assert main(["join", str(out), "--out", str(tmp_path / "x"), "--box", "1,2,3"]) == 1
    assert "six numbers" in capsys.readouterr().err
    for command in (["view"], ["select", "chair"]):
        assert main([*command, str(out), "--out", str(tmp_path / "x")]) == 1
        said = capsys.readouterr()
        assert (said.out, said.err.count("\n")) == ("", 1)  # no page was opened
        assert f"kfgs join {out} --out FIELD`" in said.err
        join = said.err.split("`")[3].replace("FIELD", str(tmp_path / command[0])).split()
        assert main(join[1:]) == 0
        assert len(SemanticField.load(tmp_path / command[0])) > 0
        assert f"next: kfgs view {tmp_path / command[0]}" in capsys.readouterr().out
    assert main(["join", str(tmp_path), "--out", str(tmp_path / "x")]) == 1
    assert "blocks.json" in capsys.readouterr().err


def test_a_joined_field_remembers_the_whole_scene(fitted, town, tmp_path):
    fitted.joined().save(tmp_path / "deep/field.kfgs")
    field = SemanticField.load(tmp_path / "deep/field.kfgs")
    assert recall_scene(field.info).samefile(town)
    assert "geometry" not in field.info
    assert field.classes.names == fitted.field("block00").classes.names


@pytest.mark.parametrize(
    ("file", "change", "parts"),
    [
        ("blocks.json", {"scene": None}, ("blocks.json", "scene None is no path", "cut the scene again")),
        ("blocks.json", {"scene": 5}, ("blocks.json", "scene 5 is no path")),
        (
            "block00/core/core.json",
            {"box": [[0, 0], [1, 1]]},
            ("core.json", "the facts of a block", "fit the block again"),
        ),
    ],
)
def test_a_damaged_description_is_named_when_a_city_is_opened(fitted, tmp_path, file, change, parts):
    for name in ("blocks.json", *(f"{block.name}/core/core.json" for block in fitted.blocks)):
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        shutil.copy(fitted.folder / name, tmp_path / name)
    assert len(FieldInBlocks.open(tmp_path)) == len(fitted)
    (tmp_path / file).write_text(json.dumps(json.loads((tmp_path / file).read_text()) | change))
    with pytest.raises(ValueError, match=tells(*parts)):
        FieldInBlocks.open(tmp_path)
    if file == "blocks.json":
        (tmp_path / file).write_text('{"format": "kfgs.blocks", "version": 1, "blocks": []}')
        with pytest.raises(ValueError, match=tells(file, "KeyError: 'scene'", "cut the scene again")):
            FieldInBlocks.open(tmp_path)


def test_other_inputs_are_refused_also_after_a_kill(town, splat, tmp_path):
    split_scene(town, tmp_path / "city", 2, splat=splat, latents=4)
    for path in (tmp_path / "city").glob("block*"):
        if path.is_dir():
            shutil.rmtree(path)  # killed before the first block
    split_scene(town, tmp_path / "city", 2, splat=splat, latents=4)
    shutil.copytree(town / "features", tmp_path / "maps")
    for other in ({}, {"splat": splat, "latents": 5}, {"splat": splat, "features": tmp_path / "maps"}):
        with pytest.raises(ValueError, match=tells("out", "others", "delete")):
            split_scene(town, tmp_path / "city", 2, **{"latents": 4} | other)
    with pytest.raises(ValueError, match=tells("out")):
        split_scene(town, town, 2, latents=4)


def test_a_part_of_space_may_be_empty(town, splat, tmp_path):
    half = read_splats(splat)
    half = half.select(half.gaussians.means[:, 0] < 4)  # the first room
    write_splats(half, tmp_path / "half.ply")
    split_scene(town, tmp_path / "city", 4, splat=tmp_path / "half.ply", latents=4)
    made = fit_blocks(tmp_path / "city", EVERY)
    assert 0 < len(made.blocks) < 4
    assert len(made) == len(made.joined()) == len(half)


def test_what_may_be_in_a_picture_is_read(town):
    camera = load_scene(town).cameras[0]
    generator = np.random.default_rng(0)
    viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    for scale in (0.1, 1, 10, 300):
        for _ in range(50):
            low = generator.normal(0, scale, 3)
            high = low + generator.exponential(scale, 3) * generator.choice([0.01, 1], 3)
            points = generator.uniform(low, high, (2000, 3))
            x, y, z = K @ (viewmat[:3, :3] @ points.T + viewmat[:3, 3:])
            seen = (z > camera.near) & (x > 0) & (y > 0) & (x < camera.width * z) & (y < camera.height * z)
            assert _in_view(camera, low.tolist(), high.tolist()) or not seen.any()
    assert not _in_view(camera, [500, 500, 500], [501, 501, 501]) or not _in_view(camera, [-501] * 3, [-500] * 3)


def test_a_city_is_not_joined_into_itself(fitted, capsys):
    before = sorted(fitted.folder.rglob("*"))
    for place in ("block00/core", "block01", "field"):
        assert main(["join", str(fitted.folder), "--out", str(fitted.folder / place)]) == 1
        assert "--out" in capsys.readouterr().err
    assert sorted(fitted.folder.rglob("*")) == before


@pytest.mark.parametrize(
    ("box", "words"),
    [
        ("", ("--box", "empty")),
        ("all", ("--box", "six numbers", "'all'")),
        ("nan,0,0,1,1,1", ("--box", "three numbers", "nan")),
        ("0,4,0,1,-4,1", ("--box", "y from 4 down to -4", "exchange")),
        ("500,0,0,501,1,1", ("--box", "none", "choose a part")),
        ("0,0,0,0,0,0", ("--box", "none", "choose a part")),
    ],
)
def test_wrong_boxes_are_one_line(fitted, tmp_path, box, words, capsys):
    assert main(["join", str(fitted.folder), "--out", str(tmp_path / "x"), f"--box={box}"]) == 1
    error = capsys.readouterr().err
    assert re.search(tells(*words), error)
    assert error.count("\n") == 1
    assert not (tmp_path / "x").exists()


def test_boxes_are_checked_before_a_field_is_read(fitted, monkeypatch):
    monkeypatch.setattr(SemanticField, "load", staticmethod(lambda path: pytest.fail(f"{path} was read")))
    for low, high in (([500, 0, 0], [501, 1, 1]), ([0, 1, 0], [1, -1, 1]), ([0, 0], [1, 1])):
        with pytest.raises(ValueError, match="low, high"):
            fitted.within(low, high)


def test_a_box_may_have_no_limit(fitted):
    inf = float("inf")
    assert len(fitted.within([-inf] * 3, [inf] * 3)) == len(fitted)
    first, second = fitted.within([-inf] * 3, [4, inf, inf]), fitted.within([4, -inf, -inf], [inf] * 3)
    assert len(first) + len(second) == len(fitted)


def test_two_cities_with_the_same_latents_join(fitted, town, splat, tmp_path, capsys):
    said, file = [], fitted.folder / "latents.safetensors"
    split_scene(town, tmp_path / "second", 2, splat=splat, latents=file, report=said.append)
    assert "12 of this scene's own would hold" in said[0]
    second = fit_blocks(tmp_path / "second", EVERY)
    assert len(join_fields([fitted.joined(), second.joined()])) == len(fitted) + len(second)
    assert split_scene(town, tmp_path / "second", 2, splat=splat, latents=LinearLatents.load(file))  # it goes on
    with pytest.raises(ValueError, match=tells("out", "others")):
        split_scene(town, tmp_path / "second", 2, splat=splat, latents=12)
    LinearLatents(torch.eye(16)[:, :4]).save(tmp_path / "other.safetensors")
    for given, words in (("other.safetensors", ("--latents", "24 channels", "16")), ("none", ("none", "no such"))):
        arguments = [str(town), "--out", str(tmp_path / "x"), "--count", "2", "--latents", str(tmp_path / given)]
        assert main(["blocks", *arguments]) == 1
        assert re.search(tells(*words), capsys.readouterr().err)
        assert not (tmp_path / "x").exists()


def test_a_splat_of_another_scene_is_said(town, splat, tmp_path):
    cloud = read_splats(splat)
    write_splats(cloud.replace(means=cloud.means + 900), tmp_path / "far.ply")
    split_scene(town, tmp_path / "city", 2, splat=tmp_path / "far.ply", latents=4)
    for block in ("block00", "block01"):
        (tmp_path / "city" / block / "core").mkdir()
        (tmp_path / "city" / block / "core" / "core.json").write_text(
            '{"gaussians": 0, "of": 0, "box": null, "seconds": 0}'
        )
    with pytest.raises(ValueError, match=tells("city", "none", "splat")):
        FieldInBlocks.open(tmp_path / "city")


def test_a_city_behind_a_link_remembers_its_scene(town, splat, tmp_path):
    (tmp_path / "deep/er/city").mkdir(parents=True)
    (tmp_path / "city").symlink_to("deep/er/city")
    split_scene(town, tmp_path / "city", 2, splat=splat, latents=4)
    field = fit_blocks(tmp_path / "city", EVERY).joined()
    assert recall_scene(field.info).samefile(town)
    assert field.classes is not None


@pytest.mark.parametrize("name", ["latents.safetensors", "block00/splat.ply", "block00/mine.txt", "block01"])
def test_files_of_somebody_else_are_not_replaced(town, splat, tmp_path, name, capsys):
    file = tmp_path / "city" / name
    file.parent.mkdir(parents=True)
    file.write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    line = ["blocks", str(town), "--out", str(tmp_path / "city"), "--count", "2", "--splat", str(splat)]
    assert main(line) == 1
    place = tmp_path / "city" / name.split("/")[0]
    assert re.search(tells(place, "kfgs blocks", "move it away"), capsys.readouterr().err)
    assert (file.read_text(), sorted(tmp_path.rglob("*"))) == ("mine", before)


def test_a_fit_that_ends_early_leaves_the_old_core(fitted, monkeypatch):
    before = fitted.joined().gaussians.means
    monkeypatch.setattr("kfgs.scale.blocks.fit", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        fit_block(fitted.folder / "block00", EVERY)
    city = FieldInBlocks.open(fitted.folder)
    assert city == fitted
    assert torch.equal(city.joined().gaussians.means, before)


PUT = """
import json, os, shutil, torch
from kfgs.fields import Linear, SemanticField
from kfgs.scale.blocks import _put
from pathlib import Path
city = Path({city!r})
new = SemanticField.load(city / "block00/core")
new = new.select(torch.arange(len(new)) < {count})
facts = json.loads((city / "block00/core/core.json").read_text()) | {{"gaussians": {count}}}
def prepare(folder):
    shutil.copytree(city / "block00/core", folder / "block00/core")
    cut = json.loads((city / "blocks.json").read_text())
    (folder / "blocks.json").write_text(json.dumps(cut | {{"blocks": cut["blocks"][:1]}}))
def work(folder):
    _put(folder / "block00/core", new, facts)
"""


def test_at_every_kill_a_core_and_its_facts_are_both_old_or_both_new(fitted, tmp_path):
    found = []
    for folder in kill_everywhere(PUT.format(city=str(fitted.folder), count=17), tmp_path / "cities"):
        city = FieldInBlocks.open(folder)
        assert len(city) == len(city.field("block00")), folder
        found.append(len(city))
    old = fitted.counts[0]
    switch = found.index(17)
    assert found == [old] * switch + [17] * (len(found) - switch)
    assert 0 < switch < len(found) - 1


def test_a_block_that_becomes_empty_leaves_no_core(fitted, tmp_path):
    place = tmp_path / "core"
    facts = {"gaussians": 1, "options": "a"}
    _put(place, fitted.field("block00"), facts)
    moved = SemanticField.load(place)
    assert recall_scene(moved.info).samefile(fitted.folder / "block00")
    _put(place, None, {"gaussians": 0})
    assert [path.name for path in place.iterdir()] == ["core.json"]
    _put(place, fitted.field("block00"), facts)
    assert json.loads((place / "core.json").read_text()) == facts
    assert len(SemanticField.load(place)) == len(moved)


def test_blocks_of_different_options_are_not_joined(town, splat, tmp_path, capsys):
    """As after a second fit that was interrupted between two blocks."""
    city = tmp_path / "city"
    split_scene(town, city, 2, splat=splat, latents=4)
    fit_blocks(city, EVERY)
    fit_block(city / "block00", dataclasses.replace(EVERY, device="cpu"))  # makes no difference
    assert len(FieldInBlocks.open(city).blocks) == 2
    other = dataclasses.replace(EVERY, seed=7)
    fit_block(city / "block00", other)
    capsys.readouterr()
    assert main(["join", str(city), "--out", str(tmp_path / "field.kfgs")]) == 1
    assert re.search(tells(city, "same options", "block00", "block01", "again"), capsys.readouterr().err)
    assert not (tmp_path / "field.kfgs").exists()
    assert len(fit_blocks(city, other).joined()) > 0
