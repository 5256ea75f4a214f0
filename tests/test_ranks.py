"""One field by several processes: the same bits as by one, and an end for all when one fails."""

import json
import os
import shutil
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
import ranks_work
import small_room
import torch
from messages import tells

from kfgs import _ranks
from kfgs.cli import main
from kfgs.features import FeatureFolder
from kfgs.fields import uplift_maps
from kfgs.pipeline import together
from kfgs.scenes import load_scene

HERE = Path(__file__).resolve().parent


def environment(**more):
    paths = os.pathsep.join(map(str, (HERE.parent, HERE)))
    return {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", **more}


def start(size, *arguments):
    """Processes as torchrun starts them, without waiting."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    meeting = {"WORLD_SIZE": str(size), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    return [
        subprocess.Popen(
            [sys.executable, *map(str, arguments)],
            env=environment(RANK=str(rank), LOCAL_RANK=str(rank), **meeting),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(size)
    ]


def finish(processes):
    return [(*process.communicate(timeout=600), process.returncode) for process in processes]


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A toy room, with a second folder of maps of which one is broken: it has a NaN, which is noticed when it is read."""
    made = small_room.make_room(tmp_path_factory.mktemp("ranks") / "room")
    shutil.copytree(made / "features", made / "broken")
    file = FeatureFolder(made / "broken").of(load_scene(made), "train").files[1]
    values = torch.load(file)
    values[0, 0, 0] = torch.nan
    torch.save(values, file)
    return made


@pytest.fixture(scope="module")
def runs(room, tmp_path_factory):
    """What one, two and three processes found, their folders, and their exit codes."""
    folders = {size: tmp_path_factory.mktemp(f"by{size}") for size in (1, 2, 3)}
    started = {size: start(size, HERE / "ranks_work.py", "work", folders[size], room) for size in (2, 3)}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        alone = ranks_work.shared(folders[1], room) | ranks_work.scene_run(folders[1], room)
    finally:
        torch.set_num_threads(threads)
    found, codes = {1: [alone]}, {}
    for size, processes in started.items():
        ended = finish(processes)
        codes[size] = [code for *_, code in ended]
        written = sorted(folders[size].glob("*.json"))
        assert len(written) >= 2, ended
        found[size] = [json.loads(one.read_text()) for one in written]
    return found, folders, codes


def stages(folder):
    """The bytes of every file of a run, without the times in the descriptions."""
    found = {}
    for file in sorted((folder / "run").rglob("*")):
        if file.is_file() and file.name not in ("digests.json", ".run.lock"):
            text = file.read_bytes()
            if file.suffix == ".json":
                text = json.dumps(timeless(json.loads(text)))
            found[str(file.relative_to(folder))] = text
    return found


def timeless(value):
    if isinstance(value, list):
        return [timeless(one) for one in value]
    times = ("seconds", "history.json")  # the size of the history depends on the times in it
    return {k: timeless(v) for k, v in value.items() if k not in times} if isinstance(value, dict) else value


def test_with_one_process_nothing_is_imported_and_everything_is_done_here():
    code = """
import sys
from kfgs import _ranks
with _ranks.together():
    parts = list(_ranks.in_order([3, 4], lambda i: {"i": i}))
    _ranks.meet()
    _ranks.agree("nothing", lambda: 1 / 0)
    print(parts, _ranks.once(lambda: (1, 2)), _ranks.first(), _ranks.place(), "torch" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment())
    assert done.stdout.strip() == "[{'i': 3}, {'i': 4}] (1, 2) True (0, 1) False"


@pytest.mark.parametrize("name", ["field", "losses", "uplift", "codebook", "paper", "index", "answers"])
def test_two_and_three_processes_find_the_bits_of_one(runs, name):
    (alone,), two, three = (runs[0][size] for size in (1, 2, 3))
    assert alone["grown"]
    assert [one[name] for one in (*two, *three)] == [json.loads(json.dumps(alone[name]))] * (len(two) + len(three))


def test_the_order_of_the_views_matters_to_these_bits(room):
    """Otherwise the test above would prove nothing."""
    start, views, maps = ranks_work.inputs(room)
    found = [
        uplift_maps(start.activated().detach(), [views[i] for i in order], [maps[i] for i in order]).pixels
        for order in ([0, 1, 2, 3, 4], [4, 3, 2, 1, 0])
    ]
    assert not torch.equal(*found)
    torch.testing.assert_close(*found)


@pytest.mark.parametrize("size", [2, 3])
def test_a_run_by_several_processes_has_the_files_of_one(runs, size):
    found, folders, _ = runs
    expected, got = stages(folders[1]), stages(folders[size])
    assert len(expected) >= 8
    assert sorted(got) == sorted(expected)
    assert [name for name in expected if got[name] != expected[name]] == []
    for one in found[size]:
        assert one["reused"] == found[1][0]["reused"] == [[False, False], [True, True]]


def test_only_the_first_process_reports_and_works_once(runs):
    for size in (2, 3):
        lines = [one["lines"] for one in runs[0][size]]
        rows = [one["rows"] for one in runs[0][size]]
        assert lines[0] == runs[0][1][0]["lines"] > 0
        assert rows[0] == 4
        assert set(lines[1:]) == set(rows[1:]) == {0}
        assert all(one["once"] == {"rank": 0, "alone": True} for one in runs[0][size])


def test_an_error_of_one_process_ends_all_with_its_words(runs):
    words = "maps[1]: this one is broken: ä"
    for size in (2, 3):
        kinds = [one["broken"] for one in runs[0][size]]
        assert kinds[1] == ["ValueError", words]
        others = [kind for rank, kind in enumerate(kinds) if rank != 1]
        assert others == [["PeerError", f"process 1 of {size} failed: ValueError: {words}"]] * len(others)
        assert all(one["in step again"] == [0, 1, 2, 3, 4] for one in runs[0][size])


def test_processes_that_start_from_other_gaussians_or_part_ways_are_told(runs):
    for one in (*runs[0][2], *runs[0][3]):
        kind, message = one["other start"]
        assert kind == "ValueError"
        assert message.startswith("the start of a fit: expected the same in all")
        kind, message = one["parted"]
        assert "work of the first process (process 0), a meeting (process 1)" in message


def test_a_killed_process_ends_the_others_at_once(runs):
    found, _, codes = runs
    assert codes[3] == [0, 0, -9]
    for one in found[3]:
        kind, message = one["lost"]
        assert kind == "LostError"
        assert message.startswith("processes: expected all of them to go on, lost one (")
        assert one["seconds"] < 30


def test_a_process_that_does_not_answer_ends_the_wait(runs):
    assert runs[0][2][0]["lost"][0] == "LostError"


def test_after_a_kill_torchrun_goes_on_from_the_checkpoint_to_the_same_bits(room, tmp_path):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    (tmp_path / "one").mkdir()
    (tmp_path / "two").mkdir()
    try:
        command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--max-restarts", "3"]
        command += ["--monitor-interval", "0.1", "--standalone"]
        script = [HERE / "ranks_work.py", "colors", tmp_path / "two", room]
        torchrun = subprocess.Popen([*command, *map(str, script)], env=environment(), stderr=subprocess.PIPE, text=True)
        assert ranks_work.colors(tmp_path / "one", room)["first step"] == 0
        _, log = torchrun.communicate(timeout=600)
    finally:
        torch.set_num_threads(threads)
    assert torchrun.returncode == 0, log
    assert "exitcode: -9" in log
    assert [json.loads((tmp_path / "two" / f"{rank}.json").read_text()) for rank in (0, 1)] == [{"first step": 14}] * 2
    expected, got = stages(tmp_path / "one"), stages(tmp_path / "two")
    assert len(expected) == 4
    assert got == expected


def test_the_command_line_says_an_error_once_and_refuses_what_is_not_shared(room, tmp_path, monkeypatch, capsys):
    for rank, said in (
        ("0", "error: expected one process for `kfgs info`, got 2 by torchrun; start it without\n"),
        ("1", ""),
    ):
        monkeypatch.setenv("WORLD_SIZE", "2")
        monkeypatch.setenv("RANK", rank)
        assert main(["info", str(room)]) == 1
        assert capsys.readouterr().err == said


@pytest.mark.parametrize("word", ["--help", "--version", "no-such-command"])
def test_the_first_process_alone_prints_help_and_what_is_no_command(word, monkeypatch, capsys):
    said = []
    for rank in ("0", "1"):
        monkeypatch.setenv("WORLD_SIZE", "2")
        monkeypatch.setenv("RANK", rank)
        with suppress(SystemExit):
            main([word])
        said.append("".join(capsys.readouterr()))
    assert said[0]
    assert said[1] == ""


@pytest.mark.parametrize(("words", "code"), [(["--help"], 0), (["--no-such-option"], 2), ([], 2)])
def test_the_first_process_alone_prints_the_help_of_a_command_and_wrong_usage(words, code):
    (out, error, first), other = finish(start(2, "-m", "kfgs", "fit", *words))
    assert "kfgs fit" in out + error
    assert other == ("", "", code)
    assert first == code


@pytest.mark.parametrize("size", [2, 3])
def test_a_command_by_several_processes_prints_one_error(runs, size):
    """The map of the second view is broken, which the second process reads."""
    head, *others = runs[0][size]
    assert [one["code"] for one in (head, *others)] == [1] * (2 if size == 3 else size)
    assert "color: done" in head["output"]
    (error,) = (line for line in head["errors"].splitlines() if line.startswith("error: "))
    assert error.startswith(f"error: process 1 of {size} failed: ValueError: ")
    assert "expected finite features, got 1 NaN" in error
    assert "note: a training step has 1 view(s), so only as many of the" in head["output"]
    for one in others:
        assert (one["errors"], one["output"]) == ("", "")


def test_together_is_off_again_after_it_ended(monkeypatch):
    with together():
        assert _ranks._group is None
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "1")
    assert _ranks.place() == (1, 2)
    assert _ranks.first()  # outside `together` each process works for itself
    monkeypatch.setenv("MASTER_ADDR", "127.0.0.1")
    monkeypatch.setenv("MASTER_PORT", "no port")
    with pytest.raises(_ranks.LostError, match=tells("2 of them", "MASTER_PORT")), together():
        pass
