"""Batches: what several workers make, kills included, is what one process makes; nothing is done twice."""

import dataclasses
import os
import re
import shutil
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from messages import tells
from PIL import Image
from small_batch import OPTIONS, make_rooms, one_process, results

from kfgs._files import read_json
from kfgs.cli import main
from kfgs.scale import BatchOptions, open_client, run_batch
from kfgs.scale.board import event_line, table

FIT_STAGES = ["scene", "features", "features", "fit", "segment", "evaluate"]


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    return make_rooms(tmp_path_factory.mktemp("rooms"), 2)


@pytest.fixture(scope="module")
def alone(rooms):
    """The results of one process."""
    return {room.name: results(one_process(room, room.parent / "alone" / room.name)) for room in rooms}


@pytest.fixture(scope="module")
def client():
    """Dask sets variables for its workers in this process, too, which the programs that it starts later must not get."""
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "PYTHONHASHSEED", "MALLOC_TRIM_THRESHOLD_")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "2")
        before = [os.environ.get(name) for name in names]
        with open_client(workers=2) as found:
            yield found
        assert [os.environ.get(name) for name in names] == before


class Events(list):
    def __call__(self, event, rows):
        self.append(event)
        self.rows = rows

    def stages(self, name, kind="done"):
        return [event.stage for event in self if event.name == name and event.kind == kind]


def kill_fit(run: Path, killed: list):
    """Kill the process that fits a scene, whose id is in the lock of the run."""
    end = time.monotonic() + 100
    while not killed and time.monotonic() < end:
        lock = run / ".run.lock"
        found = re.match(r"process (\d+) ", lock.read_text()) if lock.is_file() else None
        if found and (run / "unfinished").is_dir():
            os.kill(int(found[1]), signal.SIGKILL)
            killed.append(int(found[1]))
        time.sleep(0.01)


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL")
def test_killed_workers_change_no_byte_and_a_second_batch_does_nothing(rooms, alone, client, tmp_path):
    runs, events, killed = rooms[0].parent / "runs", Events(), []
    (tmp_path / "broken").mkdir()
    deadly = dataclasses.replace(OPTIONS, teacher_options={"deadly": str(tmp_path)})
    killer = threading.Thread(target=kill_fit, args=(runs / "room1", killed))
    killer.start()
    found = run_batch([tmp_path / "broken", *rooms], runs, deadly, client=client, report=events)
    killer.join()
    assert (tmp_path / "killed").exists()
    assert os.getpid() not in killed
    assert len(killed) == 1
    assert {"features", "fit"} <= {event.stage for event in events if event.kind == "lost"}
    for room in rooms:
        assert results(runs / room.name) == alone[room.name]
        assert events.stages(room.name) == FIT_STAGES
    assert [one.failure is None for one in found] == [False, True, True]
    assert found[0].failure.stage == "scene"
    assert "expected a COLMAP model, a transforms.json, or photos" in found[0].failure.message
    assert read_json(runs / "broken" / "state.json")["failure"]["message"] == found[0].failure.message
    assert "Traceback" in (runs / "broken" / "log.txt").read_text()
    assert "a worker died" in (runs / "room1" / "log.txt").read_text()

    before = {path: path.stat().st_mtime_ns for path in runs.rglob("*") if path.is_file()}
    more = Events()
    second = run_batch([tmp_path / "broken", *rooms], runs, deadly, client=client, report=more)
    assert [one.value for one in second] == [one.value for one in found]
    assert [more.stages(name) for name in ("broken", "room0", "room1")] == [[], ["scene"], ["scene"]]
    changed = {path.name for path, when in before.items() if path.stat().st_mtime_ns != when}
    assert changed <= {"state.json", "log.txt", ".batch.lock", ".at_work"}
    assert second[0].failure == found[0].failure


def test_a_failed_scene_is_tried_again_when_asked(rooms, tmp_path):
    scene, events = tmp_path / "room", Events()
    shutil.copytree(rooms[0], scene, ignore=shutil.ignore_patterns("images", "depth", "features"))
    with ThreadPoolExecutor(1) as pool:
        first = run_batch([scene], tmp_path / "runs", OPTIONS, client=pool)
        shutil.copytree(rooms[0] / "images", scene / "images")
        skipped = run_batch([scene], tmp_path / "runs", OPTIONS, client=pool, report=events)
        assert first[0].failure == skipped[0].failure
        assert first[0].failure is not None
        assert events == []
        tried = run_batch([scene], tmp_path / "runs", OPTIONS, client=pool, retry_failed=True, report=events)
    assert tried[0].failure is None
    assert read_json(tmp_path / "runs" / "room" / "state.json")["failure"] is None
    assert events.stages("room") == FIT_STAGES


def test_only_what_depends_on_a_change_is_done_again(rooms, alone, tmp_path):
    scene, runs = tmp_path / "room0", tmp_path / "runs"
    shutil.copytree(rooms[0], scene)

    def batch(**changes):
        events = Events()
        with ThreadPoolExecutor(1) as pool:
            found = run_batch([scene], runs, dataclasses.replace(OPTIONS, **changes), client=pool, report=events)
        assert found[0].failure is None, found[0].failure.traceback
        return events.stages("room0"), events.rows[0].stages

    assert batch()[0] == FIT_STAGES
    assert {name: data for name, data in results(runs / "room0").items() if name != "field.kfgs"} == {
        name: data for name, data in alone["room0"].items() if name != "field.kfgs"
    }
    assert batch(pictures=1)[0] == ["scene", "segment"]
    assert (runs / "room0" / "segmented" / "sheets").is_dir()
    shutil.rmtree(runs / "room0" / "field.kfgs")
    assert batch(pictures=1) == (
        ["scene", "fit"],
        {"scene": "done", "features": "found", "fit": "done", "segment": "found", "evaluate": "found"},
    )
    one = next((runs / "room0" / "features").glob("*.npy"))
    whole = one.read_bytes()
    one.write_bytes(whole[:100])
    assert batch(pictures=1)[0] == ["scene"]  # the field is there: its maps are not asked
    (runs / "room0" / "done" / "fit.json").unlink()
    assert batch(pictures=1)[0] == ["scene", "features", "features", "fit"]
    assert one.read_bytes() == whole
    picture = scene / "images" / f"{one.stem}.png"
    Image.open(picture).rotate(180).save(picture)
    assert batch(pictures=1)[0] == FIT_STAGES
    assert one.read_bytes() != whole


def test_maps_are_deleted_when_asked_and_not_missed(rooms, tmp_path):
    less, events = dataclasses.replace(OPTIONS, discard_features=True), Events()
    with ThreadPoolExecutor(1) as pool:
        for _ in range(2):
            run_batch(rooms[:1], tmp_path, less, client=pool, report=events)
    assert list((tmp_path / "room0" / "features").glob("*.npy")) == []
    assert events.stages("room0") == [*FIT_STAGES, "scene"]


@pytest.mark.parametrize("kind", ["memory", "file"])
def test_scenes_and_runs_in_an_object_store(rooms, alone, tmp_path, kind):
    fsspec = pytest.importorskip("fsspec")
    root = f"memory://{tmp_path.name}" if kind == "memory" else f"file://{tmp_path}/store"
    files, _ = fsspec.core.url_to_fs(root)
    files.put(str(rooms[0]), f"{root}/scenes/room0", recursive=True)
    check_store(root, files, alone, tmp_path)


def test_an_s3_server(rooms, alone, tmp_path, monkeypatch):
    server_module = pytest.importorskip("moto.server")
    s3fs = pytest.importorskip("s3fs")
    server = server_module.ThreadedMotoServer(port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        for name, value in {
            "AWS_ENDPOINT_URL": f"http://{host}:{port}",
            "AWS_ACCESS_KEY_ID": "one",
            "AWS_SECRET_ACCESS_KEY": "two",
            "AWS_DEFAULT_REGION": "us-east-1",
        }.items():
            monkeypatch.setenv(name, value)
        files = s3fs.S3FileSystem()
        files.mkdir("captures")
        files.put(str(rooms[0]), "s3://captures/scenes/room0", recursive=True)
        check_store("s3://captures", files, alone, tmp_path)
    finally:
        server.stop()


def check_store(root, files, alone, tmp_path):
    """Two batches from a store to a store: the results of one process, and nothing done twice."""
    events, scenes = Events(), [f"{root}/scenes/room0"]
    with ThreadPoolExecutor(2) as pool:
        first = run_batch(scenes, f"{root}/runs", OPTIONS, client=pool, report=events)
        assert first[0].failure is None, first[0].failure.traceback
        assert run_batch(scenes, f"{root}/runs", OPTIONS, client=pool, report=events)[0].value == first[0].value
    assert events.stages("room0") == [*FIT_STAGES, "scene"]
    files.get(f"{root}/runs/room0", str(tmp_path / "got"), recursive=True)
    found = results(tmp_path / "got")
    for name in set(alone["room0"]) - {"field.kfgs"}:  # which says where the scene was
        assert found[name] == alone["room0"][name], name
    assert set(found) == set(alone["room0"])
    assert (tmp_path / "got" / "state.json").is_file()
    assert "fit: color: done" in (tmp_path / "got" / "log.txt").read_text()


def test_photos_get_their_cameras_first(rooms, tmp_path, monkeypatch):
    """What sfm itself does is tested elsewhere; here it finds the cameras of the room."""
    from kfgs.scale import stages
    from kfgs.scenes.sfm import SfmReport

    calls = []

    def found(images, out, *, config, replace):
        calls.append((Path(images).name, config.num_threads, replace))
        shutil.copytree(rooms[0] / "sparse", Path(out) / "sparse")
        return SfmReport(6, 6, 1500, 0.5)

    monkeypatch.setattr(stages, "run_sfm", found)
    photos, table_ = tmp_path / "photos", tmp_path / "text"
    shutil.copytree(rooms[0] / "images", photos)
    with ThreadPoolExecutor(1) as pool:
        for _ in range(2):
            result = run_batch([photos], tmp_path / "runs", OPTIONS, client=pool)[0]
            assert result.failure is None, result.failure.traceback
    assert calls == [("photos", 1, True)]
    run = tmp_path / "runs" / "photos"
    assert f"note: no poses in {photos}: " in (run / "log.txt").read_text()
    assert (run / "scene" / "images").resolve() == photos
    assert (run / "field.kfgs").is_file()
    assert not (run / "segmented").exists()  # no classes are known
    assert not table_.exists()


def test_an_error_of_sfm_says_where_its_options_are(rooms, tmp_path, monkeypatch):
    from kfgs.scale import stages
    from kfgs.scenes import SceneError

    def fails(images, *_, **__):
        raise SceneError(f"{images}: expected 6 images, got 2; pass single_camera=False (--no-single-camera)")

    monkeypatch.setattr(stages, "run_sfm", fails)
    photos, capture = tmp_path / "photos", tmp_path / "capture"
    shutil.copytree(rooms[0] / "images", photos)
    shutil.copytree(rooms[0] / "images", capture / "images")
    with ThreadPoolExecutor(1) as pool:
        found = run_batch([photos, capture], tmp_path / "runs", OPTIONS, client=pool)
    told = [one.failure.message.split(". sfm says: ") for one in found]
    assert f"`kfgs sfm {photos} --out SCENE`, and write SCENE into the list" in told[0][0]
    assert f"`kfgs sfm {capture}/images --out {capture}`, then this again with --retry-failed" in told[1][0]
    assert all(said.startswith("expected 6 images, got 2; pass ") for _, said in told)


def test_a_scene_without_maps_or_teacher_says_what_to_name(rooms, tmp_path):
    scene = tmp_path / "room"
    shutil.copytree(rooms[0], scene, ignore=shutil.ignore_patterns("features"))
    with ThreadPoolExecutor(1) as pool:
        found = run_batch([scene], tmp_path / "runs", dataclasses.replace(OPTIONS, teacher=None), client=pool)
    assert found[0].failure.stage == "fit"
    assert re.search(tells("features/", "--teacher"), found[0].failure.message)


def test_two_batches_in_one_folder_are_refused(rooms, tmp_path):
    from kfgs._files import locked

    with locked(tmp_path, ".batch.lock"), pytest.raises(ValueError, match=tells("in use by")):
        run_batch(rooms, tmp_path, OPTIONS, client=ThreadPoolExecutor(1))


def test_options_are_checked():
    with pytest.raises(ValueError, match=tells("share", 0)):
        BatchOptions(share=0)
    with pytest.raises(ValueError, match=tells("share", 1.5)):
        BatchOptions(share=1.5)
    with pytest.raises(ValueError, match=tells("discard_features", "decouple")):
        BatchOptions(discard_features=True, fit=dataclasses.replace(OPTIONS.fit, method="paper", mode="decouple"))
    with (
        pytest.raises(ValueError, match=tells("scheduler", "leave one out")),
        open_client(scheduler="tcp://a:1", workers=2),
    ):
        pass
    for wrong in (0, -1, 1.5, "2"):
        with pytest.raises(ValueError, match=tells("workers", wrong)), open_client(workers=wrong):
            pass


@pytest.mark.parametrize(
    ("options", "error", "parts"),
    [
        ({"slurm": "gpu"}, OSError, ("slurm", "sbatch")),
        ({"slurm": "gpu", "memory": "much"}, ValueError, ("memory", "16GB", "'much'")),
    ],
)
def test_slurm_that_is_not_there_and_sizes_that_are_none_are_refused(options, error, parts, tmp_path, monkeypatch):
    if find_spec("dask_jobqueue") is None:
        pytest.skip("needs dask-jobqueue")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(error, match=tells(*parts)), open_client(**options):
        pass


def test_the_command_takes_a_list_to_the_end_and_fails_if_a_scene_does(rooms, client, tmp_path, capsys):
    (tmp_path / "garden").mkdir()
    (tmp_path / "scenes.txt").write_text(f"garden\nkitchen = {rooms[0]}\n")
    line = ["batch", str(tmp_path / "scenes.txt"), "--out", str(tmp_path / "runs"), "--teacher", "tiny_teacher:Tiny"]
    line += ["--steps", "20", "--max-gaussians", "800", "--pictures", "0", "--scheduler", client.scheduler.address]
    assert main(line) == 1
    said = capsys.readouterr()
    assert "kitchen: fit done in " in said.out
    for stage in ("scene", "features", "fit", "segment", "evaluate"):
        assert said.out.count(f"kitchen: {stage} started\n") <= 1  # one that took less than a second is only done
    log = (tmp_path / "runs" / "kitchen" / "log.txt").read_text().splitlines()
    assert [line[20:] for line in log].count("fit: submitted") == 1
    times = [line[:19] for line in log if line[20:].startswith("fit: ")]
    assert times == sorted(times)
    assert log.index(next(one for one in log if "fit: submitted" in one)) < log.index(
        next(one for one in log if "color:" in one)
    )
    assert read_json(tmp_path / "runs" / "kitchen" / "scores.json")["scene"] == "kitchen"
    spent = read_json(tmp_path / "runs" / "kitchen" / "state.json")["seconds"]
    assert "garden: scene failed: " in said.out
    assert "2 scenes: 1 finished, 1 failed, mean mIoU" in said.out
    assert re.search(tells("SCENES", "1 failed (garden)", "log.txt", "--retry-failed"), said.err)
    assert main(["info", str(tmp_path / "runs")]) == 0
    told = capsys.readouterr().out
    assert f"{tmp_path / 'runs'}: a batch" in told
    assert re.search(r"kitchen +done +done +done +done +done", told)
    assert re.search(tells("2 scenes: 1 finished, 1 failed", "next: ", "--retry-failed"), told)
    (tmp_path / "scenes.txt").write_text(f"kitchen = {rooms[0]}\n")
    assert main(line) == 0
    said = capsys.readouterr().out
    assert "kitchen: fit" not in said
    assert re.search(r"kitchen +done +found +found +found +found", said)
    kept = read_json(tmp_path / "runs" / "kitchen" / "state.json")["seconds"]
    assert {name: kept[name] for name in kept if name != "scene"} == {
        name: spent[name] for name in spent if name != "scene"
    }
    assert kept["fit"] > 0


@pytest.mark.parametrize(
    ("line", "parts"),
    [
        ("nothing.txt --out runs", ("no such file",)),
        ("nothing.txt --out runs --teacher lsegg --workers 0", ("--workers", "0")),
        ("nothing.txt --out runs --workers=-2", ("--workers", "-2")),
        ("nothing.txt --out runs --threads 0", ("--threads", "0")),
        ("scenes.txt --out room/runs --teacher dinov2", ("--out", "apart from all scenes", "room")),
        ("scenes.txt --out runs --teacher lsegg", ("teacher", "lseg")),
        ("scenes.txt --out runs --weights a.ckpt", ("--weights", "without --teacher")),
        ("scenes.txt --out runs --discard-features", ("--discard-features", "without --teacher")),
        ("scenes.txt --out runs --scheduler tcp://a:1 --workers 2", ("--scheduler", "leave one out")),
        ("scenes.txt --out runs --share 0", ("--share", "0")),
    ],
)
def test_wrong_use_is_one_line_before_any_work(line, parts, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes.txt").write_text("room\n")
    (tmp_path / "room").mkdir()
    assert main(["batch", *line.split()]) == 1
    assert re.search(tells(*parts), capsys.readouterr().err)
    assert not (tmp_path / "runs").exists()


def test_the_table_keeps_to_its_height_and_shows_failures_first():
    from kfgs.scale.batch import Row
    from kfgs.scale.driver import Event, Failure

    rows = [Row(f"room{i}", "") for i in range(9)]
    rows[7].failure = failure = Failure("fit", "no space " * 60)
    rows[7].stages = {"scene": "done", "fit": "failed"}
    rows[5].stages = {"scene": "running"}
    rows[3].value = {"miou": 0.5}
    rows[1].stages = {"scene": "waits"}
    rows[3].seconds = {"fit": 3.0, "scene": 1.5}
    text = table(rows, most=2)
    assert [line.split()[0] for line in text.splitlines()] == ["name", "room5", "room7", "fit:", "9"]
    assert "9 scenes: 1 finished, 1 failed, 1 at work, 6 waiting, mean mIoU 0.500 of 1" in text
    assert [line.split()[0] for line in table(rows, most=3).splitlines()][1:4] == ["room1", "room5", "room7"]
    assert table(rows[:1]).endswith("\n1 scene: 1 waiting")
    assert re.search(r"room3 .* 4\.5 0\.500", table(rows))
    assert event_line(Event("room7", "failed", "fit", failure=failure), rows).startswith("room7: fit failed: no space")
    assert event_line(Event("room5", "started", "scene"), rows) == "room5: scene started"
    assert event_line(Event("room5", "finished"), rows) is None


def test_the_folder_says_what_waits_what_is_at_work_and_what_was_stopped(tmp_path, monkeypatch, capsys):
    """Four scenes, one worker: one scene is at work, the others wait for it; a second later the command says so."""
    from kfgs.scale import stages
    from kfgs.scale.driver import Event

    going, asked = threading.Event(), threading.Event()

    threads = []

    def slow(job, *, report):
        torch.set_num_threads(2)
        with stages._work(job):
            threads.append(torch.get_num_threads())
            going.set()
            assert asked.wait(60)
        threads.append(torch.get_num_threads())
        raise ValueError("no scene")

    monkeypatch.setattr(stages, "find_scene", slow)
    places = [tmp_path / name for name in "abcd"]
    for place in places:
        place.mkdir()
    events, runs = Events(), tmp_path / "runs"

    def look():
        assert main(["info", str(runs)]) == 0
        return capsys.readouterr().out

    with ThreadPoolExecutor(1) as pool, ThreadPoolExecutor(1) as driver:
        batch = driver.submit(run_batch, places, runs, OPTIONS, client=pool, report=events, at_once=3)
        assert going.wait(60)
        while len([event for event in events if event.kind == "submitted"]) < 3:
            time.sleep(0.05)
        said = look()
        while not events.stages("a", "started"):
            time.sleep(0.05)
        later = dict(events.rows[0].stages)
        shutil.copytree(runs, tmp_path / "killed")  # the copy has no lock: what its driver's death leaves
        asked.set()
        assert [one.failure.message for one in batch.result()] == ["no scene"] * 4
    assert threads == [1, 2] * 4  # later work of the process has its own again
    assert re.search(
        tells(f"{runs}: a batch at work, process {os.getpid()} of ", "3 scenes: 1 at work, 2 waiting"), said
    )
    assert later == {"scene": "running"}
    assert event_line(Event("a", "started", "scene"), events.rows) == "a: scene started"
    assert re.search(tells("4 scenes: 4 failed"), look())
    runs = tmp_path / "killed"
    said = look()
    assert re.search(
        tells("a batch that was stopped", "3 scenes: 3 stopped", "next: the same `kfgs batch` again"), said
    )
    assert len(re.findall("^[abc] +stopped ", said, re.MULTILINE)) == 3


def test_jobs_of_slurm(tmp_path, monkeypatch):
    """A stand-in for sbatch runs the script on this machine, so its contents are right as far as a shell can tell."""
    if find_spec("dask_jobqueue") is None:  # not importorskip: the package replaces the handler of Ctrl-C
        pytest.skip("needs dask-jobqueue")
    handler = signal.getsignal(signal.SIGINT)
    script = tmp_path / "job.sh"
    (tmp_path / "sbatch").write_text(
        f'#!/bin/sh\ncp "$1" {script}\nsetsid bash {script} >{tmp_path}/job.log 2>&1 &\necho "Submitted batch job 1"\n'
    )
    (tmp_path / "scancel").write_text("#!/bin/sh\n")
    for name in ("sbatch", "scancel"):
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    with open_client(slurm="gpu", threads=3, memory="8GB") as found:
        assert found.submit(len, "job").result(timeout=100) == 3
    assert signal.getsignal(signal.SIGINT) is handler
    for part in (
        "#SBATCH -p gpu",
        "#SBATCH --cpus-per-task=3",
        "#SBATCH --mem=8G",
        "#SBATCH -t 24:00:00",
        "--nthreads 1",
    ):
        assert part in script.read_text()


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_ctrl_c_in_a_terminal_does_not_reach_the_workers(client):
    def ignored():
        return signal.getsignal(signal.SIGINT) is signal.SIG_IGN

    assert client.submit(ignored).result(timeout=100)


def test_workers_hold_no_semaphore_that_a_kill_would_leave(client):
    """The driver's Python warned of them after Ctrl-C."""

    def lock():
        from tqdm import tqdm

        return type(tqdm(disable=True).get_lock()).__name__

    assert client.submit(lock).result(timeout=100) == "RLock"


@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_workers_say_nothing_when_they_are_asked_to_end(client):
    def caught():  # in a thread of the worker, as tasks are
        from kfgs.scenes.pycolmap_import import import_pycolmap

        import_pycolmap()
        status = Path("/proc/self/status").read_text()
        return int(status.partition("SigCgt:")[2].split()[0], 16) >> (signal.SIGTERM - 1) & 1

    assert client.submit(caught).result(timeout=100) == 0
