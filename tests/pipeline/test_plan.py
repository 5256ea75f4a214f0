"""What a plan says before a run: disk by closed form, which maps and stages exist, the verdict, and real runs within it."""

import json
import re
from dataclasses import replace

import pytest
import torch
from messages import tells
from PIL import Image
from small_room import CONFIG, make_room

from kfgs.features import FeatureFolder, extract_features, pictures_of, save_feature_map
from kfgs.fields import FieldConfig
from kfgs.pipeline import FitConfig, NamedTeacher, Plan, fit_color, fit_scene, plan_scene
from kfgs.pipeline.estimate import GROWTH, MARGIN, Sizes, gaussian_counts, plan_stages
from kfgs.pipeline.plan import notes_on
from kfgs.pipeline.trial import PeakMemory, Timing
from kfgs.quant import CodebookConfig
from kfgs.scenes import load_scene
from kfgs.teachers import CallableTeacher

GB = 1e9
PAPER = FitConfig.cpu(method="paper")
NAMES = ("color", "uplift", "codebook", "index_maps", "autoencoder", "field", "answers")


def sizes(config=PAPER, *, views=90, shape=(360, 480, 512), made=False, **changes):
    """room_0 by its numbers; each view or step takes a second."""
    known = Sizes(
        config=config,
        dense="keep",
        points=18_543,
        pictures=((479, 639),) * views,
        shapes=(shape,) * views,
        made=(made,) * views,
        picture_seconds=10.0 * views,
        teacher_peak=3 * 10**9,
        teacher_bytes=2 * 10**9,
        timings=dict.fromkeys(NAMES, Timing(1.0, 1.0, 10**9)),
    )
    return replace(known, **changes)


def stages(found):
    return {stage.name: stage for stage in (found.stages if isinstance(found, Plan) else plan_stages(found))}


def plan(found, *, disk=10**13, memory=10**12):
    return Plan("room_0", tuple(plan_stages(found)), tuple(notes_on(found)), found.dense, disk, memory)


def test_the_papers_90_views_take_15_9_gigabytes():
    found = plan(sizes())
    assert list(stages(found)) == ["features", "codebook", "index maps", "autoencoder", "field", "answers"]
    maps = 90 * 360 * 480 * 512 * 2
    assert stages(found)["features"].disk_bytes == stages(found)["features"].kept_bytes == maps
    assert stages(found)["index maps"].disk_bytes == 90 * 360 * 480
    assert maps / GB == pytest.approx(15.9, abs=0.05)
    assert found.disk_bytes == sum(stage.disk_bytes for stage in found.stages)
    assert found.peak_bytes == max(stage.peak_bytes for stage in found.stages) == round(MARGIN * 3 * 10**9)
    assert found.seconds == pytest.approx(sum(stage.seconds for stage in found.stages))
    assert found.fits


def test_times_are_a_line_through_views_or_steps():
    found = stages(sizes())
    assert found["features"].seconds == 900
    assert found["index maps"].seconds == found["answers"].seconds == 91
    assert found["field"].seconds == 2_001
    assert found["autoencoder"].seconds == 1 + PAPER.autoencoder.steps


def test_recomputing_takes_the_samples_disk_and_twice_the_teacher():
    paper = replace(PAPER, codebook=CodebookConfig.paper())
    keep, again = (stages(sizes(paper, dense=dense)) for dense in ("keep", "recompute"))
    assert again["features"].disk_bytes == 90 * 180 * 160 * 512 * 2  # 2.65 GB
    assert again["features"].kept_bytes == 0
    assert again["index maps"].seconds - keep["index maps"].seconds == keep["features"].seconds
    assert again["index maps"].peak_bytes - keep["index maps"].peak_bytes == 2 * 10**9
    fused, twice = (stages(sizes(FitConfig(), dense=dense)) for dense in ("keep", "recompute"))
    assert twice["uplift"].seconds - fused["uplift"].seconds == keep["features"].seconds


def test_the_adaptive_codebook_looks_at_fewer_features_once():
    paper = replace(PAPER, codebook=CodebookConfig.paper())
    few, many = (stages(sizes(each, dense="recompute")) for each in (PAPER, paper))
    assert few["features"].disk_bytes == 90 * 16 * 22 * 512 * 2  # rows 11::22, columns 11::22 of 360 x 480
    assert few["codebook"].what == "1 pass over 352 features a map"
    assert many["codebook"].what == "29 passes over 28,800 features a map"
    dense = replace(PAPER, codebook=CodebookConfig(grid_step=(1, 1)))
    assert stages(sizes(dense))["codebook"].what == "1 pass over 365 features a map"


def test_maps_so_small_that_recomputing_saves_nothing_are_named():
    told = "keeping them takes no more disk, and half the time"
    assert told in str(plan(sizes(shape=(15, 20, 512), dense="recompute")))
    assert told not in str(plan(sizes(dense="recompute")))


def test_discarded_maps_need_the_disk_only_for_a_while():
    found = plan(sizes(dense="discard"))
    assert found.disk_bytes > 15.9 * GB > 0.1 * GB > found.kept_bytes
    assert "(for a while)" in next(line for line in str(found).splitlines() if line.startswith("features"))


@pytest.mark.parametrize(
    ("mode", "names"),
    [
        ("decouple", ["features", "field", "answers"]),
        ("adc", ["features", "codebook", "index maps", "field", "answers"]),
    ],
)
def test_modes_have_their_own_stages(mode, names):
    found = stages(sizes(replace(PAPER, mode=mode)))
    assert list(found) == names
    assert found["field"].disk_bytes > 10 * stages(sizes())["field"].disk_bytes  # 512 channels instead of 9
    untried = {"timings": {}}
    assert (
        stages(sizes(replace(PAPER, mode=mode), **untried))["field"].peak_bytes
        > stages(sizes(**untried))["field"].peak_bytes
    )


def test_the_default_method_trains_colours_and_uplifts_once():
    found = plan(sizes(FitConfig()))
    assert list(stages(found)) == ["features", "color", "uplift"]
    assert "at most 50,000 are kept" in found.stages[-1].what
    assert found.disk_bytes > found.kept_bytes  # the working maps are a temporary file
    more = stages(sizes(FitConfig(), views=180))
    assert more["uplift"].seconds == 181
    assert more["color"].seconds == stages(found)["color"].seconds  # steps, not views


def test_what_is_made_and_what_is_done_costs_nothing():
    some = sizes(made=True, shape=(90, 120, 512))
    assert list(stages(some)) == ["codebook", "index maps", "autoencoder", "field", "answers"]
    some = replace(some, made=(True,) * 60 + (False,) * 30)
    assert stages(some)["features"].disk_bytes == 30 * 90 * 120 * 512 * 2
    assert "60 of 90 maps exist and are not made again" in str(plan(some))
    done = stages(replace(some, done=frozenset({"codebook", "index_maps"})))
    assert "features" not in done  # nothing looks at the maps again
    assert (done["index maps"].what, done["index maps"].seconds, done["index maps"].disk_bytes) == (
        "done already",
        0,
        0,
    )
    assert done["field"] == stages(some)["field"]


def test_an_unknown_map_size_is_said_to_be_unknown():
    found = plan(sizes(FitConfig(), shape=None, picture_seconds=None, teacher_peak=None))
    assert found.seconds is found.disk_bytes is found.peak_bytes is found.fits is None
    assert "unknown whether it fits" in str(found)
    assert stages(found)["color"].seconds > 0
    assert plan(sizes(FitConfig(), shape=None), disk=10**3).fits is False  # the colours alone are more


def test_too_little_disk_is_said_with_what_helps():
    less = replace(plan(sizes(), disk=int(12.3e9)), disk_recomputed=int(2.8e9))
    assert less.fits is False
    assert re.search(
        r"does not fit: needs 16\.0 GB on disk, 12\.3 GB free; recompute instead of storing: 2\.8 GB on disk.*kfgs fit "
        r"SCENE --teacher",
        less.verdict,
    )
    assert "smaller maps (--size), or use a larger disk" in plan(sizes(dense="recompute"), disk=10**7).verdict


def test_too_little_memory_is_said():
    found = plan(sizes(), memory=10**9)
    assert found.fits is False
    assert re.search(
        r"does not fit: needs 3\.[78] GB of memory \(features\), 1\.0 GB free; ask for smaller", found.verdict
    )
    assert plan(sizes(), memory=None).fits


def test_the_table_is_aligned_and_the_json_complete():
    found = plan(sizes())
    table = str(found).splitlines()[2 : 2 + 1 + 6 + 2]
    column = table[0].index("memory") + len("memory")
    assert [line[column] for line in table] == [" "] * len(table)  # the end of a right-aligned column
    assert all(line[column - 1] != " " for line in table)
    read = json.loads(json.dumps(found.to_json()))
    assert read["disk_bytes"] == found.disk_bytes
    assert read["stages"][0]["name"] == "features"
    assert read["verdict"] == "fits"


def test_gaussians_grow_while_it_densifies():
    config = FieldConfig(steps=100, densify_from=20, densify_until=60)
    mean, last = gaussian_counts(config, 1000)
    assert last == 1000 * GROWTH["low"]
    assert mean == pytest.approx((20 * 1000 + 40 * 3500 + 40 * 6000) / 100)
    limited = FieldConfig(steps=100, max_gaussians=2000, densify_from=20)
    assert gaussian_counts(limited, 1000)[1] == gaussian_counts(limited, 100, full=True)[1] == 2000
    assert gaussian_counts(limited, 100)[1] == 600
    assert gaussian_counts(FieldConfig(steps=100, max_gaussians=500, densify_from=20), 1000)[1] == 1000
    assert gaussian_counts(FieldConfig(steps=100, densify_from=500), 1000) == (1000, 1000)


# From here on a real room; the small runs are left out where times do not matter.


@pytest.fixture
def untimed(monkeypatch):
    for name in ("time_color", "time_fit"):
        monkeypatch.setattr(f"kfgs.pipeline.plan.{name}", lambda *_: {})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_room(tmp_path_factory.mktemp("plan") / "scene")


@pytest.fixture(scope="module")
def room(folder):
    return load_scene(folder)


def thumbnails(image):
    return torch.cat([image[:, ::4, ::4]] * 2) + 0.1


def unused(image):
    raise AssertionError("a teacher was run")


def stored(room, target, views):
    """Maps in the layout of Feature 3DGS."""
    for i in views:
        save_feature_map(target, room.stem(i), torch.rand(15, 20, 6))


@pytest.mark.parametrize("where", ["features", "scene"])
def test_maps_that_exist_in_any_layout_need_no_teacher(untimed, room, tmp_path, where):
    views = room.views("train")
    if where == "features":
        stored(room, tmp_path / "maps", views)
    options = {"features": tmp_path / "maps"} if where == "features" else {}
    found = plan_scene(room, teacher=unused, **options)
    assert [stage.name for stage in found.stages] == ["color", "uplift"]
    assert "6 of 6 maps exist" in str(found)
    assert ("6 channels at 15x20" if options else "32 channels at 30x40") in found.title
    assert "maps of another program" in found.title


def test_maps_that_the_teacher_has_made_are_not_made_again(untimed, room, tmp_path):
    teacher, views = CallableTeacher(thumbnails, name="thumbnails"), room.views("train")
    extract_features(teacher, pictures_of(room, views[:4]), tmp_path / "maps")
    some = plan_scene(room, teacher=teacher, features=tmp_path / "maps")
    assert "4 of 6 maps exist and are not made again" in str(some)
    assert some.stages[0].disk_bytes == 2 * 15 * 20 * 6 * 2
    assert some.stages[0].what.startswith("2 pictures, ")
    again = plan_scene(room, teacher=teacher, features=tmp_path / "maps", dense="recompute")  # which keeps none
    assert again.stages[0].what.startswith("6 pictures, ")
    assert some.disk_recomputed == again.disk_bytes
    named = CallableTeacher(unused, name="thumbnails")
    extract_features(teacher, pictures_of(room, views), tmp_path / "maps")
    assert plan_scene(room, teacher=named, features=tmp_path / "maps").stages[0].name == "color"


def test_the_planned_bytes_of_maps_are_those_on_disk(untimed, room, tmp_path):
    found = plan_scene(room, teacher=thumbnails, features=tmp_path / "maps")
    assert not (tmp_path / "maps").exists()
    extract_features(thumbnails, pictures_of(room, room.views("train")), tmp_path / "maps")
    header = 128  # of a .npy file
    on_disk = sum(file.stat().st_size - header for file in (tmp_path / "maps").glob("*.npy"))
    assert found.stages[0].disk_bytes == on_disk
    assert found.stages[0].seconds > 0


def test_maps_that_do_not_count_are_told(untimed, room, tmp_path):
    views = room.views("train")
    extract_features(CallableTeacher(thumbnails, name="other"), pictures_of(room, views), tmp_path / "other")
    found = plan_scene(room, teacher=thumbnails, features=tmp_path / "other")
    assert f"{tmp_path / 'other'} holds maps by 'other'; `kfgs features` asks for --out" in str(found)
    assert found.stages[0].what.startswith("6 pictures, ")

    def smaller(image):
        return thumbnails(image)[:, ::2, ::2]

    extract_features(CallableTeacher(smaller, name="thumbnails"), pictures_of(room, views[:3]), tmp_path / "small")
    found = plan_scene(room, teacher=thumbnails, features=tmp_path / "small")
    assert "maps that exist are not counted: they have the shape (8, 10, 6)" in str(found)
    assert found.stages[0].disk_bytes == 6 * 15 * 20 * 6 * 2

    stored(room, tmp_path / "some", views[:3])
    found = plan_scene(room, teacher=thumbnails, features=tmp_path / "some")
    assert "maps that exist are not counted" in str(found)
    (tmp_path / "some" / f"{room.stem(views[0])}_fmap_CxHxW.pt").write_bytes(b"damaged")
    for i in views[3:]:
        stored(room, tmp_path / "some", [i])
    found = plan_scene(room, teacher=thumbnails, features=tmp_path / "some")
    assert f"maps that exist are not counted: {tmp_path / 'some'}" in str(found)


def test_views_of_two_sizes_are_added_up(untimed, room, tmp_path):
    views = room.views("train")
    half = [camera.resized(30, 40) if i in views[:2] else camera for i, camera in enumerate(room.cameras)]
    small = tmp_path / "small.png"
    with Image.open(room.image_paths[0]) as picture:
        picture.resize((40, 30)).save(small)
    paths = [small if i in views[:2] else path for i, path in enumerate(room.image_paths)]
    mixed = replace(room, cameras=half, image_paths=paths)
    found = plan_scene(mixed, teacher=thumbnails, features=tmp_path / "none", config=PAPER)
    assert found.stages[0].disk_bytes == 2 * 6 * (4 * 15 * 20 + 2 * 8 * 10)


class Moving:
    """A teacher that writes down where it is told to go, and where it is when it looks at a picture."""

    name = "moving"

    def __init__(self):
        self.device, self.seen = "meta", []

    def to(self, device):
        self.device = str(device)
        return self

    def encode_image(self, image):
        self.seen.append(self.device)
        return thumbnails(image)

    def encode_text(self, prompts):
        raise NotImplementedError


def test_a_teacher_stays_on_its_device(untimed, room, tmp_path, monkeypatch):
    teacher = Moving()
    found = plan_scene(room, teacher=teacher, features=tmp_path / "none", config=FitConfig(device="cpu"))
    assert (set(teacher.seen), teacher.device) == ({"meta"}, "meta")
    assert found.stages[0].seconds > 0
    named = Moving()  # loaded for the plan alone
    monkeypatch.setattr(NamedTeacher, "load", lambda self: (named, None))
    plan_scene(room, teacher="own:moving", features=tmp_path / "none", config=FitConfig(device="cpu"))
    assert set(named.seen) == {"cpu"}


def test_a_teacher_that_cannot_be_run_is_told(untimed, room, tmp_path):
    missing = {"features": tmp_path / "none"}
    found = plan_scene(room, teacher="clip", **missing)
    assert found.fits is None
    assert re.search("clip was not run.*no weights are named", str(found))
    hub = plan_scene(room, teacher=NamedTeacher("clip", "nobody/has-this"), **missing)  # nothing is downloaded
    assert re.search("clip was not run.*nobody/has-this", str(hub))
    found = plan_scene(room, teacher=NamedTeacher("sam"), **missing)
    assert "sam was not run" in str(found)
    with pytest.raises(FileNotFoundError, match=tells("no.ckpt")):
        plan_scene(room, teacher=NamedTeacher("lseg", tmp_path / "no.ckpt"), **missing)
    with pytest.raises(ValueError, match=tells("teacher", "clop", "clip")):
        plan_scene(room, teacher="clop", **missing)
    unneeded = plan_scene(room, teacher=NamedTeacher("lseg", tmp_path / "no.ckpt"))
    assert "no map is missing, so lseg and its weights were not looked at" in str(unneeded)


def test_a_scene_without_points_is_told(room, tmp_path):
    empty = replace(room, points=room.points[:0], colors=room.colors[:0])
    found = plan_scene(empty)
    assert "the scene has 0 points" in str(found)
    assert found.seconds is None


def test_what_does_not_fit_into_memory_is_not_tried(room, monkeypatch):
    monkeypatch.setattr("kfgs.pipeline.plan.memory_free", lambda: 10**6)
    for name in ("time_color", "time_fit"):
        monkeypatch.setattr(f"kfgs.pipeline.plan.{name}", lambda *_: pytest.fail("it was tried"))
    found = plan_scene(room)
    assert found.fits is False
    assert found.seconds is None
    assert "of memory" in found.verdict


def test_dense_maps_of_decouple_must_be_kept(room):
    with pytest.raises(ValueError, match=tells("dense", "'keep'", "decouple", "'discard'", "keep them")):
        plan_scene(room, config=replace(PAPER, mode="decouple"), dense="discard")
    with pytest.raises(ValueError, match=tells("dense", "'keep', 'discard', 'recompute'", "'none'")):
        plan_scene(room, dense="none")


@pytest.mark.parametrize("method", ["fuse", "paper"])
def test_a_real_run_stays_within_its_plan(room, tmp_path, method):
    """Its disk and memory; how long it takes is for the benchmark."""
    few = FitConfig()
    few = replace(few, color=replace(few.color, field=replace(few.color.field.with_steps(60), max_gaussians=3_000)))
    config, folder = (few if method == "fuse" else CONFIG), tmp_path / "run"
    planned = plan_scene(room, config=config, run=folder)
    assert planned.fits
    assert not folder.exists()
    maps = FeatureFolder(room.folder / "features", [room.stem(i) for i in room.views("train")])
    with PeakMemory() as memory:
        made = fit_scene(room, maps, folder, config)
    assert [stage.name for stage in made.stages] == [stage.name.replace(" ", "_") for stage in planned.stages]
    written = sum(path.stat().st_size for path in folder.rglob("*") if path.suffix in (".safetensors", ".ply"))
    assert (
        0.25 * planned.kept_bytes < written <= planned.kept_bytes * 1.1
    )  # headers; Gaussians and codewords are bounds
    if memory.bytes is not None:
        assert memory.bytes < planned.peak_bytes + 10**8
    assert all(stage.seconds > 0 for stage in planned.stages)
    done = plan_scene(room, config=config, run=folder, teacher=unused)
    assert {stage.what for stage in done.stages} == {"done already"}
    assert (done.seconds, done.disk_bytes) == (0, 0)
    before = sorted(folder.rglob("*"))
    other = plan_scene(room, config=replace(config, seed=1), run=folder, teacher=unused)
    assert other.seconds > 0
    assert sorted(folder.rglob("*")) == before


def test_colours_that_are_there_need_not_be_trained(untimed, room, tmp_path):
    few = FitConfig()
    few = replace(few, color=replace(few.color, field=few.color.field.with_steps(3)))
    fit_color(room, tmp_path, replace(few.color, field=few.color.field.with_steps(5)))
    found = stages(plan_scene(room, config=few, run=tmp_path))
    assert (found["color"].what, found["uplift"].what[:6]) == ("done already", "6 maps")
    unmade = plan_scene(room, config=few, run=tmp_path, features=tmp_path / "none", teacher=thumbnails)
    assert [(stage.name, stage.what == "done already") for stage in unmade.stages] == [
        ("features", False),
        ("color", True),
        ("uplift", False),
    ]
