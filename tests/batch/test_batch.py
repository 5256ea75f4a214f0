"""Batches: what several workers make, kills included, is what one process makes; nothing is done twice."""

import dataclasses
import os
import shutil
import signal
import sys
import threading
import time
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from messages import refused
from small_batch import OPTIONS, make_rooms, one_process, results

from kfgs._files import read_json
from kfgs.batch import BatchOptions, open_client, run_batch
from kfgs.batch.run import describe_batch
from kfgs.batch.scene_task import _teacher, stamps
from kfgs.cli import main
from kfgs.scenes import SceneError, load_scene
from kfgs.scenes.sfm import SfmReport


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    return make_rooms(tmp_path_factory.mktemp("rooms"), 2)


@pytest.fixture(scope="module")
def alone(rooms):
    """The results of the functions for one scene."""
    return {room.name: results(one_process(room, room.parent / "alone" / room.name)) for room in rooms}


@pytest.fixture(scope="module")
def client():
    """Dask sets variables for its workers in this process, too, which the programs that it starts later must not get."""
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "PYTHONHASHSEED", "MALLOC_TRIM_THRESHOLD_")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "2")
        before = [os.environ.get(name) for name in names]
        with open_client(2) as dask:
            yield dask
        assert [os.environ.get(name) for name in names] == before


def kill_fit(client, run: Path, killed: list):
    """Kill the worker that fits a scene."""
    end = time.monotonic() + 200
    while not killed and time.monotonic() < end:
        if (run / "unfinished").is_dir() and read_json(run / "state.json")["step"] == "fit":
            busy = [address for address, tasks in client.processing().items() if any("room1" in key for key in tasks)]
            if len(busy) == 1:
                killed += client.run(os.getpid, workers=busy).values()
                os.kill(killed[0], signal.SIGKILL)
        time.sleep(0.02)


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL")
def test_killed_workers_change_no_byte_and_a_second_batch_does_nothing(rooms, alone, client, tmp_path):
    runs, killed, said = rooms[0].parent / "runs", [], []
    (tmp_path / "broken").mkdir()
    deadly = dataclasses.replace(OPTIONS, teacher_options={"deadly": str(tmp_path)})
    scenes = {folder.name: folder for folder in (tmp_path / "broken", *rooms)}
    killer = threading.Thread(target=kill_fit, args=(client, runs / "room1", killed))
    killer.start()
    first = run_batch(scenes, runs, deadly, client=client, report=said.append)
    killer.join()
    assert (tmp_path / "killed").exists()  # a worker died while it encoded
    assert len(killed) == 1  # and one while it trained
    for room in rooms:
        assert results(runs / room.name) == alone[room.name]
    assert [result.failure is None for result in first] == [False, True, True]
    assert first[0].step == "cameras"
    assert "expected a COLMAP model, a transforms.json or photos" in first[0].failure
    assert "Traceback" in (runs / "broken" / "log.txt").read_text()
    assert {line.partition(" done")[0] for line in said} >= {"room0: fit", "room1: segment"}

    before = {path: path.stat().st_mtime_ns for path in runs.rglob("*") if path.is_file()}
    second = run_batch(scenes, runs, deadly, client=client)
    assert [result.value for result in second] == [result.value for result in first]
    changed = {path for path, when in before.items() if path.stat().st_mtime_ns != when}
    assert {path.parent.name for path in changed} <= {"broken", "runs"}


def test_a_failed_scene_is_tried_again_and_others_are_not_touched(rooms, tmp_path):
    room, runs = tmp_path / "room", tmp_path / "runs"
    shutil.copytree(rooms[0], room)
    scene = load_scene(room)
    photo = scene.image_paths[scene.views("train")[0]]
    good = photo.read_bytes()
    photo.write_bytes(b"damaged")
    first = run_batch({"room": room}, runs, dataclasses.replace(OPTIONS, strict=True))[0]
    assert first.value is None
    assert photo.name in first.failure
    assert "1 failed" in describe_batch(runs)
    photo.write_bytes(good)
    second = run_batch({"room": room}, runs, OPTIONS)[0]
    assert second.failure is None
    assert "1 finished, mean mIoU" in describe_batch(runs)
    kept = (runs / "room/segmented").stat().st_mtime_ns
    text = dataclasses.replace(OPTIONS, pictures=1)  # another option: the field is found, the views are drawn again
    third = run_batch({"room": room}, runs, text)[0]
    assert third.value == second.value
    assert third.seconds["fit"] < second.seconds["fit"]
    assert any((runs / "room/segmented/sheets").iterdir())
    assert kept != (runs / "room/segmented").stat().st_mtime_ns
    gone = run_batch({"room": room}, tmp_path / "gone", dataclasses.replace(OPTIONS, discard_features=True))[0]
    assert gone.failure is None
    assert not list((tmp_path / "gone/room/features").glob("*.npy"))


def test_a_teacher_is_loaded_once_whatever_its_options(tmp_path):
    options = dataclasses.replace(OPTIONS, teacher_options={"deadly": [1.0]})
    first = _teacher(options.teacher, options)
    assert _teacher(options.teacher, dataclasses.replace(options)) is first
    assert _teacher(options.teacher, OPTIONS) is not first


@pytest.mark.skipif(sys.platform == "win32", reason="links")
def test_links_are_followed_but_not_in_circles(tmp_path):
    for name in ("scene/images/a.png", "scene/features/a.npy", "elsewhere/b.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"123")
    for name, target in (("self", "."), ("up", ".."), ("images/more", "../../elsewhere"), ("images/top", "..")):
        (tmp_path / "scene" / name).symlink_to(target)
    (tmp_path / "elsewhere/back").symlink_to("../scene")
    assert next(name for name, *_ in stamps(tmp_path / "scene/images")) == "a.png"
    found = stamps(tmp_path / "scene", "features")
    assert found == sorted(found)
    assert {Path(name).name: size for name, size, _ in found} == {"a.png": 3, "b.png": 3}
    assert len(found) == 2


def test_photos_get_their_cameras_first(rooms, tmp_path, monkeypatch):
    """What sfm itself does is tested elsewhere; here it finds the cameras of the room."""
    calls, said = [], []

    def poses(images, out, *, config, replace):
        calls.append((Path(images).name, config.num_threads))
        shutil.copytree(rooms[0] / "sparse", Path(out) / "sparse")
        return SfmReport(6, 6, 1500, 0.5)

    monkeypatch.setattr("kfgs.batch.scene_task.run_sfm", poses)
    photos = tmp_path / "photos"
    shutil.copytree(rooms[0] / "images", photos)
    for _ in range(2):
        result = run_batch({"photos": photos}, tmp_path / "runs", OPTIONS, report=said.append)[0]
        assert result.failure is None, result.failure
    assert calls == [("photos", 1)]
    assert any(f"note: no poses in {photos}: " in line for line in said)
    assert result.value["miou"] is None  # no classes are known
    assert not (tmp_path / "runs/photos/segmented").exists()


def test_an_error_of_sfm_says_where_its_options_are(rooms, tmp_path, monkeypatch):
    def fails(images, *_, **__):
        raise SceneError(f"{images}: expected 6 images, got 2; pass single_camera=False (--no-single-camera)")

    monkeypatch.setattr("kfgs.batch.scene_task.run_sfm", fails)
    photos = shutil.copytree(rooms[0] / "images", tmp_path / "photos")
    failure = run_batch({"photos": photos}, tmp_path / "runs", OPTIONS)[0].failure
    assert f"`kfgs sfm {photos} --out SCENE`, and put SCENE into the list" in failure
    assert "expected 6 images, got 2" in failure


def test_what_lies_in_the_way_is_not_touched(rooms, tmp_path):
    for scenes, out, parts in (
        ({"..": rooms[0]}, tmp_path, ("scenes", "names of their runs", "'..'")),
        ({"room0": rooms[0]}, rooms[0].parent, ("out", "apart from all scenes", "room0")),
        ({}, tmp_path, ("scenes", "read_scenes")),
    ):
        refused(lambda out=out, scenes=scenes: run_batch(scenes, out, OPTIONS), *parts)
    (tmp_path / "runs/room0").mkdir(parents=True)
    (tmp_path / "runs/room0/state.json").write_text('{"of": "another program"}')
    result = run_batch({"room0": rooms[0]}, tmp_path / "runs", OPTIONS)[0]
    assert "expected a new folder, or a run of kfgs batch" in result.failure
    assert (tmp_path / "runs/room0/state.json").read_text() == '{"of": "another program"}'


def test_maps_and_options_are_checked(rooms, tmp_path):
    room = shutil.copytree(rooms[0], tmp_path / "room", ignore=shutil.ignore_patterns("features"))
    assert "name a teacher (--teacher)" in run_batch({"room": room}, tmp_path / "runs", BatchOptions())[0].failure
    refused(lambda: BatchOptions(threads=0), "threads")
    (tmp_path / "table.safetensors").touch()
    assert Path(dataclasses.replace(OPTIONS, text=os.path.relpath(tmp_path / "table.safetensors")).text).is_absolute()


def test_the_command_takes_a_list_to_the_end_and_fails_if_a_scene_does(tmp_path, monkeypatch, capsys):
    for name in ("kitchen", "hall"):
        (tmp_path / name / "features").mkdir(parents=True)
    (tmp_path / "scenes.txt").write_text("kitchen\nhall\n")
    command = ["batch", str(tmp_path / "scenes.txt"), "--out", str(tmp_path / "runs")]
    assert main(command) == 1
    said = capsys.readouterr()
    assert "0 of 2 scenes are finished" in said.out
    assert "2 failed (kitchen, hall)" in said.err
    assert main(["convert", str(tmp_path / "runs")]) == 0
    assert "hall: failed in cameras" in capsys.readouterr().out
    for extra, word in (
        (["--workers", "0"], "--workers"),
        (["--weights", "x.ckpt"], "--weights"),
        (["--blocks", "2", "--teacher", "lseg"], "--teacher"),
    ):
        assert main([*command, *extra]) == 1
        assert word in capsys.readouterr().err


@pytest.mark.skipif(find_spec("dask_jobqueue") is None, reason="needs dask-jobqueue")
def test_jobs_of_slurm(tmp_path, monkeypatch):
    """A stand-in for sbatch runs the script on this machine, so its contents are right as far as a shell can tell."""
    import dask

    script = tmp_path / "job.sh"
    (tmp_path / "sbatch").write_text(
        f'#!/bin/sh\ncp "$1" {script}\nsetsid bash {script} >{tmp_path}/job.log 2>&1 &\necho "Submitted batch job 1"\n'
    )
    (tmp_path / "scancel").write_text("#!/bin/sh\n")
    for name in ("sbatch", "scancel"):
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    handler = signal.getsignal(signal.SIGINT)
    with dask.config.set({"jobqueue.slurm.memory": "8GB"}), open_client("slurm:gpu:1") as dask_client:
        assert dask_client.submit(len, "job").result(timeout=300) == 3
    assert signal.getsignal(signal.SIGINT) is handler
    for part in ("#SBATCH -p gpu", "#SBATCH --cpus-per-task=1", "#SBATCH --mem=8G", "--nthreads 1"):
        assert part in script.read_text()


def test_ctrl_c_in_a_terminal_does_not_reach_the_workers(client):
    def ignored():
        return signal.getsignal(signal.SIGINT) is signal.SIG_IGN

    assert client.submit(ignored).result(timeout=300)


def test_threads_of_the_caller_stay(tmp_path):
    torch.set_num_threads(1)
    (tmp_path / "nothing").mkdir()
    options = BatchOptions(threads=2)
    assert run_batch({"nothing": tmp_path / "nothing"}, tmp_path / "runs", options)[0].failure is not None
    assert torch.get_num_threads() == 1
