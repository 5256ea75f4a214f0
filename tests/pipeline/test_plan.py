"""What a plan foretells: disk by closed form, stages by mode, the verdict in words, and real runs within its bounds."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_room import CONFIG, ROOM, make_room

from kfgs.cameras import Camera
from kfgs.features import FeatureFolder
from kfgs.features.manifest import Manifest, MapRecord
from kfgs.fields import FieldConfig
from kfgs.pipeline import FitConfig, fit_scene, plan_stages
from kfgs.pipeline.machine import Speed, disk_free, measure_speed, memory_free
from kfgs.pipeline.plan import Plan
from kfgs.pipeline.plan import plan_scene as plan_any
from kfgs.pipeline.work import gaussian_counts, render_pixels
from kfgs.quant import CodebookConfig
from kfgs.scenes import Scene, load_scene
from kfgs.teachers.costs import TeacherCost

GB = 1e9


def plan_scene(*args, config=None, **options):
    """Plans of the paper's method, with its schedule unless another is given."""
    config = FitConfig.paper() if config is None else replace(config, method="paper")
    return plan_any(*args, config=config, **options)


@pytest.fixture(autouse=True)
def a_known_speed(request, monkeypatch):
    """The machine is always as fast, except where a real run is compared."""
    if "real_speed" not in request.fixturenames:
        monkeypatch.setattr(plan_stages, "measure_speed", lambda device="cpu": Speed(4e11, 2))


@pytest.fixture
def real_speed():
    """Ask for the machine's own speed."""


@pytest.fixture
def big(monkeypatch):
    """A machine with room for everything."""
    machine(monkeypatch, disk=10**13, memory=10**12)


def machine(monkeypatch, *, disk, memory):
    monkeypatch.setattr("kfgs.pipeline.plan.disk_free", lambda folder: disk)
    monkeypatch.setattr("kfgs.pipeline.plan.memory_free", lambda: memory)


def scene(views=90, size=(479, 639), points=18_543):
    height, width = size
    K = torch.tensor([[500.0, 0, width / 2], [0, 500.0, height / 2], [0, 0, 1]])
    cameras = [Camera(torch.eye(4), K, width, height, name=f"{i}.png") for i in range(views)]
    paths = [Path(f"{i}.png") for i in range(views)]
    return Scene(
        cameras, paths, torch.zeros(points, 3), torch.zeros(points, 3, dtype=torch.uint8), {"train": list(range(views))}
    )


def stages(plan):
    return {stage.name: stage for stage in plan.stages}


def test_the_papers_90_views_take_15_9_gigabytes(big):
    plan = plan_scene(scene(), config=FitConfig.cpu())
    assert [stage.name for stage in plan.stages] == [
        "features",
        "codebook",
        "index maps",
        "autoencoder",
        "field",
        "answers",
    ]
    maps = 90 * 360 * 480 * 512 * 2
    assert stages(plan)["features"].disk_bytes == stages(plan)["features"].kept_bytes == maps
    assert stages(plan)["index maps"].disk_bytes == 90 * 360 * 480
    assert maps / GB == pytest.approx(15.9, abs=0.05)
    assert plan.disk_bytes == sum(stage.disk_bytes for stage in plan.stages)
    assert plan.peak_bytes == max(stage.peak_bytes for stage in plan.stages) < 4 * GB
    assert plan.seconds == pytest.approx(sum(stage.seconds for stage in plan.stages))
    assert plan.fits


def test_recomputing_takes_the_samples_disk_and_twice_the_teacher(big):
    paper = replace(FitConfig.cpu(), codebook=CodebookConfig.paper())
    keep, anew = (stages(plan_scene(scene(), config=paper, dense=dense)) for dense in ("keep", "recompute"))
    assert anew["features"].disk_bytes == 90 * 180 * 160 * 512 * 2  # 2.65 GB
    assert anew["features"].kept_bytes == 0
    extra = anew["index maps"].seconds - keep["index maps"].seconds
    assert extra == pytest.approx(keep["features"].seconds, rel=0.1)
    assert anew["index maps"].peak_bytes > keep["index maps"].peak_bytes


def test_the_adaptive_codebook_looks_at_fewer_features_once(big):
    config, paper = FitConfig.cpu(), replace(FitConfig.cpu(), codebook=CodebookConfig.paper())
    few, many = (stages(plan_scene(scene(), config=each, dense="recompute")) for each in (config, paper))
    assert few["features"].disk_bytes == 90 * 16 * 22 * 512 * 2  # rows 11::22, columns 11::22 of 360 x 480
    assert few["codebook"].what == "1 pass over 352 features a map"
    assert many["codebook"].what == "29 passes over 28,800 features a map"
    assert few["codebook"].seconds < many["codebook"].seconds / 20
    dense = replace(config, codebook=CodebookConfig(grid_step=(1, 1)))
    assert stages(plan_scene(scene(), config=dense))["codebook"].what == "1 pass over 365 features a map"
    unknown = plan_scene(scene(), teacher="mine:encode", config=config)
    assert stages(unknown)["codebook"].what == "1 pass over unknown maps"


def test_blends_make_the_autoencoder_longer(big):
    config = FitConfig.cpu()
    plain = replace(config, autoencoder=replace(config.autoencoder, blends=0))
    with_blends, without = (stages(plan_scene(scene(), config=each))["autoencoder"] for each in (config, plain))
    assert with_blends.seconds > 1.2 * without.seconds


def test_maps_so_small_that_recomputing_saves_nothing_are_named(big):
    told = "keeping them takes no more disk, and half the time"
    assert told in str(plan_scene(scene(), teacher="clip", dense="recompute"))
    assert told not in str(plan_scene(scene(), dense="recompute"))


def test_discarded_maps_need_the_disk_only_for_a_while(big):
    plan = plan_scene(scene(), config=FitConfig.cpu(), dense="discard")
    assert plan.disk_bytes > 15.9 * GB > 0.1 * GB > plan.kept_bytes
    assert "(for a while)" in next(line for line in str(plan).splitlines() if line.startswith("features"))


def test_fast_is_26_times_faster_and_takes_the_same_disk(big):
    slow, fast = (stages(plan_scene(scene(), options=options))["features"] for options in ({}, {"fast": True}))
    assert 20 < slow.seconds / fast.seconds <= 26
    assert slow.disk_bytes == fast.disk_bytes


@pytest.mark.parametrize(
    ("mode", "names"),
    [
        ("decouple", ["features", "field", "answers"]),
        ("adc", ["features", "codebook", "index maps", "field", "answers"]),
    ],
)
def test_modes_have_their_own_stages(big, mode, names):
    plan = plan_scene(scene(), config=FitConfig(mode=mode))
    assert [stage.name for stage in plan.stages] == names
    nine = stages(plan_scene(scene(), config=FitConfig()))["field"]
    assert stages(plan)["field"].seconds > 10 * nine.seconds  # 512 channels instead of 9
    assert stages(plan)["field"].peak_bytes > nine.peak_bytes


def test_maps_that_exist_need_no_teacher(big):
    plan = plan_scene(scene(), teacher=TeacherCost.of_maps("folder", (90, 120, 512)), config=FitConfig.cpu())
    assert plan.stages[0].name == "codebook"
    assert plan.disk_bytes < 0.1 * GB


def manifest(folder, teacher, shapes, **more):
    """A folder of maps as `extract_features` leaves it, of which only the records count here."""
    folder.mkdir()
    records = {}
    for stem, shape in shapes.items():
        (folder / f"{stem}.npy").write_bytes(b"map")
        records[stem] = MapRecord(f"{stem}.npy", shape, 3, 1, "0" * 64, f"{stem}.png", "0" * 64, 1.0)
    Manifest({"name": teacher, **more}, records).save(folder)


def test_maps_that_the_teacher_has_made_are_not_made_again(big, tmp_path):
    none = plan_scene(scene(), folder=tmp_path)
    manifest(tmp_path / "features", "lseg", {str(i): (360, 480, 512) for i in range(60)})
    some = plan_scene(scene(), folder=tmp_path)
    assert "60 of 90 maps exist and are not made again" in str(some)
    made, both = stages(some)["features"], stages(none)["features"]
    assert made.disk_bytes == 30 * 360 * 480 * 512 * 2 == both.disk_bytes / 3
    assert made.seconds == pytest.approx(both.seconds / 3)
    assert "30 pictures of" in made.what
    assert stages(some)["codebook"] == stages(none)["codebook"]
    assert some.disk_recomputed == none.disk_recomputed
    anew = plan_scene(scene(), folder=tmp_path, dense="recompute")  # which keeps none
    assert stages(anew)["features"].seconds > 2 * made.seconds
    (tmp_path / "features" / "0.npy").unlink()
    assert "59 of 90 maps exist" in str(plan_scene(scene(), folder=tmp_path))
    assert plan_scene(scene(59), folder=tmp_path).stages[0].name == "features"  # one lacks its map
    (tmp_path / "features" / "0.npy").write_bytes(b"map")
    assert plan_scene(scene(60), folder=tmp_path).stages[0].name == "codebook"


def test_all_maps_of_a_teacher_of_ones_own_are_known(big, tmp_path):
    shapes = {str(i): (90, 120, 512) for i in range(60)}
    manifest(tmp_path / "features", "mine", shapes, source="mine:Teacher")
    assert plan_scene(scene(60), teacher="mine:Teacher", folder=tmp_path).stages[0].name == "codebook"
    for others in ({"teacher": "mine:Other"}, {"teacher": "mine:Teacher", "dense": "recompute"}):
        assert plan_scene(scene(60), folder=tmp_path, **others).stages[0].name == "features"
    assert plan_scene(scene(61), teacher="mine:Teacher", folder=tmp_path).stages[0].name == "features"


def test_maps_of_others_do_not_count(big, tmp_path):
    manifest(tmp_path / "features", "lseg", {"0": (360, 480, 512), "1": (90, 120, 512)})
    told = f"{tmp_path / 'features'} holds maps of another shape, (90, 120, 512); `kfgs features` asks for --out"
    all_of_them = stages(plan_scene(scene()))["features"]
    plan = plan_scene(scene(), folder=tmp_path)
    assert told in str(plan)
    assert stages(plan)["features"] == all_of_them
    assert f"{tmp_path / 'features'} holds maps by 'lseg'; " in str(
        plan_scene(scene(), teacher="clip", folder=tmp_path)
    )
    assert "holds maps" not in str(plan_scene(scene(), teacher="mine:encode", folder=tmp_path))


def test_an_assumed_size_is_told(big):
    assert "clip is counted with 12 blocks of 768 channels, patches of 16, since no weights are named" in str(
        plan_scene(scene(), teacher="clip")
    )
    assert "counted with" not in str(plan_scene(scene(), teacher="clip", weights="openai/clip-vit-large-patch14"))
    assert "counted with" not in str(plan_scene(scene()))


def test_weights_that_cannot_be_loaded_are_refused(big, tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"no\.ckpt: expected a checkpoint file of teacher 'lseg', got no such file"
    ):
        plan_scene(scene(2), weights=tmp_path / "no.ckpt")


def test_views_of_two_sizes_are_added_up(big):
    both = scene(6)
    half = [camera.resized(240, 320) for camera in both.cameras[4:]]
    both.cameras[4:] = half
    one, other, mixed = (
        stages(plan_scene(s, teacher="clip"))["features"] for s in (scene(4), scene(2, (240, 320)), both)
    )
    assert mixed.disk_bytes == one.disk_bytes + other.disk_bytes
    assert mixed.seconds == pytest.approx(one.seconds + other.seconds)


def test_times_follow_the_measured_speed(big, monkeypatch):
    fast = plan_scene(scene())
    monkeypatch.setattr(plan_stages, "measure_speed", lambda device="cpu": Speed(2e11, 2))
    assert plan_scene(scene()).seconds == pytest.approx(2 * fast.seconds)


def test_an_unknown_teacher_is_said_to_be_unknown(big):
    plan = plan_scene(scene(), teacher="mine:encode")
    assert plan.seconds is plan.disk_bytes is plan.peak_bytes is plan.fits is None
    text = str(plan)
    assert "the cost of 'mine:encode' is unknown" in text
    assert "unknown whether it fits" in text
    known = plan_scene(scene(), teacher=TeacherCost("mine", 64, (90, 120), None, None, None))
    assert known.disk_bytes > 90 * 90 * 120 * 64 * 2
    assert known.seconds is None
    assert stages(known)["field"].seconds > 0


def test_too_little_disk_is_said_with_what_helps(monkeypatch):
    machine(monkeypatch, disk=int(12.3e9), memory=10**11)
    plan = plan_scene(scene())
    assert plan.fits is False
    assert re.search(
        r"does not fit: needs 16\.1 GB on disk, 12\.3 GB free; --fast does not change that; recompute instead of storing: "
        r"2\.8 GB on disk.*kfgs fit SCENE --teacher",
        plan.verdict,
    )
    machine(monkeypatch, disk=10**8, memory=10**11)
    assert "--fast" not in plan_scene(scene(), teacher="clip").verdict  # which has one pass only
    assert "smaller maps (--size), or use a larger disk" in plan_scene(scene(), dense="recompute").verdict


def test_too_little_memory_is_said(monkeypatch):
    machine(monkeypatch, disk=10**13, memory=10**9)
    plan = plan_scene(scene())
    assert plan.fits is False
    assert re.search(
        r"does not fit: needs .* GB of memory \(features\), 1\.0 GB free; ask for smaller maps", plan.verdict
    )
    machine(monkeypatch, disk=10**13, memory=None)
    assert plan_scene(scene()).fits


def test_the_table_is_aligned_and_the_json_complete(big):
    plan = plan_scene(scene(), config=FitConfig.cpu())
    lines = str(plan).splitlines()
    table = lines[2 : 2 + 1 + 5 + 2]
    column = table[0].index("memory") + len("memory")
    assert [line[column] for line in table] == [" "] * len(table)  # the end of a right-aligned column
    assert all(line[column - 1] != " " for line in table)
    assert lines[0].startswith("90 views of 639x479, lseg (512 channels at 360x480, kept), adc+sc, 2000 steps")
    read = json.loads(json.dumps(plan.to_json()))
    assert read["disk_bytes"] == plan.disk_bytes
    assert read["stages"][0]["name"] == "features"
    assert read["verdict"] == "fits"


def test_a_gpus_times_are_called_estimates(big, monkeypatch):
    monkeypatch.setattr("kfgs.pipeline.plan.training_device", lambda device: torch.device("cuda"))
    monkeypatch.setattr(
        plan_stages,
        "measure_speed",
        lambda device="cpu": Speed(4e13 if torch.device(device).type == "cuda" else 4e11, 2),
    )
    plan = plan_scene(scene(), device="cuda")
    assert "assumed efficiency; none was measured" in str(plan)
    assert stages(plan)["features"].seconds < 600


def test_a_scene_without_points_is_told(big):
    assert "the scene has 0 points" in str(plan_scene(scene(points=0)))


def test_dense_maps_of_decouple_must_be_kept():
    with pytest.raises(ValueError, match=r"dense: expected 'keep' with mode 'decouple', .* got 'discard'; keep them"):
        plan_scene(scene(2), config=FitConfig(mode="decouple"), dense="discard")
    with pytest.raises(ValueError, match=r"dense: expected one of 'keep', 'discard', 'recompute', got 'none'"):
        plan_scene(scene(2), dense="none")


def test_gaussians_grow_while_it_densifies():
    config = FieldConfig(steps=100, densify_from=20, densify_until=60)
    mean, last = gaussian_counts(config, 1000)
    assert last == 6000
    assert mean == pytest.approx((20 * 1000 + 40 * 3500 + 40 * 6000) / 100)
    assert gaussian_counts(FieldConfig(steps=100, max_gaussians=2000, densify_from=20), 1000)[1] == 2000
    assert gaussian_counts(FieldConfig(steps=100, max_gaussians=500, densify_from=20), 1000)[1] == 1000
    assert gaussian_counts(FieldConfig(steps=100, densify_from=500), 1000) == (1000, 1000)


def test_rendered_pixels_follow_scale_and_coarse_steps():
    assert render_pixels(FieldConfig(), (479, 639), (360, 480)) == 479 * 639
    assert render_pixels(FieldConfig(render_scale=2.0), (479, 639), (90, 120)) == 180 * 240
    assert render_pixels(FieldConfig(render_scale=2.0), (479, 639), (360, 480)) == 479 * 639  # the camera's at most
    coarse = FieldConfig(steps=100, coarse=((50, 2),))
    assert render_pixels(coarse, (40, 60), (40, 60)) == pytest.approx(2400 * (0.5 / 4 + 0.5))


def test_the_machine_is_looked_at(tmp_path):
    assert measure_speed(seconds=0.05).flops > 1e8
    assert disk_free(tmp_path / "not" / "there") > 0
    assert memory_free() is None or memory_free() > 10**7


def test_a_real_run_writes_what_was_planned(tmp_path, real_speed):
    """Disk to a tenth; time within a factor that bounds slips of units, not the noise of a busy machine."""
    room = load_scene(make_room(tmp_path / "scene"))
    maps = FeatureFolder(tmp_path / "scene" / "features", [room.stem(i) for i in room.views("train")])
    plan = plan_scene(room, teacher=TeacherCost.of_maps("folder", maps.shape), config=CONFIG, folder=tmp_path)
    assert isinstance(plan, Plan)
    result = fit_scene(room, maps, tmp_path / "run", CONFIG)
    assert [stage.name.replace(" ", "_") for stage in plan.stages] == [stage.name for stage in result.stages]
    written = sum(path.stat().st_size for path in (tmp_path / "run").rglob("*.safetensors"))
    assert plan.kept_bytes == pytest.approx(written, rel=0.25)
    assert plan.seconds / 20 < result.seconds < plan.seconds * 20
    assert ROOM.feature_dim == maps.shape[2]


def test_the_default_method_trains_colours_and_uplifts_once(big):
    found = plan_any(scene(), teacher="clip")
    assert [stage.name for stage in found.stages] == ["features", "color", "uplift"]
    assert "at most 30000 left" in found.stages[-1].what
    assert found.disk_bytes > found.kept_bytes  # the working maps are a temporary file
    more = plan_any(scene(views=180), teacher="clip").stages
    assert more[2].seconds == pytest.approx(2 * found.stages[2].seconds, rel=0.01)
    assert more[1].seconds == found.stages[1].seconds  # steps, not views
    again = plan_any(scene(), teacher="clip", dense="recompute")
    assert again.stages[-1].seconds > found.stages[-1].seconds


def test_a_real_default_run_stays_within_its_plan(tmp_path, real_speed):
    loaded = load_scene(make_room(tmp_path / "scene"))
    maps = FeatureFolder(tmp_path / "scene" / "features", [loaded.stem(i) for i in loaded.views("train")])
    few = FitConfig()
    few = replace(few, color=replace(few.color, field=replace(few.color.field.with_steps(60), max_gaussians=3_000)))
    cost = TeacherCost.of_maps("letters", maps.shape)
    planned = {stage.name: stage for stage in plan_any(loaded, teacher=cost, config=few, folder=tmp_path).stages}
    made = fit_scene(loaded, maps, tmp_path / "run", few)
    assert [stage.name for stage in made.stages] == list(planned)
    written = sum(file.stat().st_size for file in made.stages[-1].folder.iterdir())
    assert written <= planned["uplift"].kept_bytes
