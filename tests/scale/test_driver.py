"""The loop of a batch, with engines of several kinds."""

import multiprocessing
import os
import signal
import sys
import time
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import pytest
from messages import tells

from kfgs.scale import map_scenes, run_batch
from kfgs.scale.driver import AGAIN, Task, drive

SCENES = [f"/data/{name}" for name in ("kitchen", "hall", "attic", "cellar")]


def letters(source):
    if "attic" in source:
        raise OSError("the attic is locked")
    return len(source)


class Dying:
    """An engine some of whose workers die: the futures raise, and the tasks do not run."""

    def __init__(self, deaths):
        self.deaths, self.submitted = deaths, []

    def submit(self, function, *arguments):
        self.submitted.append(arguments)
        future = Future()
        if self.deaths:
            self.deaths -= 1
            future.set_exception(RuntimeError("worker left"))
        else:
            future.set_result(function(*arguments))
        return future


def test_a_failure_is_kept_and_the_others_go_on():
    with ThreadPoolExecutor(2) as pool:
        found = map_scenes(letters, SCENES, client=pool, at_once=2)
    assert [one.value for one in found] == [13, 10, None, 12]
    assert found[2].failure.stage == "call"
    assert found[2].failure.message == "the attic is locked"
    assert "in letters" in found[2].failure.traceback


def test_a_plan_that_cannot_use_a_result_fails_alone():
    def plan(name, key):
        found = (yield "look", [Task(_double, (2,))])[0]
        return {"value": found}[key]

    events = []
    with ThreadPoolExecutor(1) as pool:
        drive({name: plan(name, key) for name, key in (("a", "odd"), ("b", "value"))}, pool, events.append)
    (failed,) = (event for event in events if event.kind == "failed")
    assert (failed.name, failed.stage, failed.failure.stage) == ("a", "look", "look")
    assert "odd" in failed.failure.message
    assert [event.results for event in events if event.kind == "finished"] == [(4,)]


@pytest.mark.parametrize("deaths", [1, AGAIN])
def test_a_task_whose_worker_died_is_submitted_again(deaths):
    engine, events = Dying(deaths), []
    assert map_scenes(len, ["/data/hall"], client=engine, report=events.append)[0].value == 10
    assert [event.kind for event in events] == ["submitted", *["lost"] * deaths, "done", "finished"]
    assert len({arguments[-1] for arguments in engine.submitted}) == deaths + 1  # no two calls are equal


def test_a_task_that_kills_every_worker_fails():
    engine = Dying(AGAIN + 1)
    found = map_scenes(len, ["/data/hall", "/data/attic"], client=engine, at_once=1)
    assert "its worker died 4 times" in found[0].failure.message
    assert "RuntimeError: worker left" in found[0].failure.message
    assert found[1].value == 11
    assert len(engine.submitted) == AGAIN + 2


def test_stages_follow_each_other_and_tasks_of_one_stage_are_joined_in_order():
    events = []

    def plan():
        first = yield "one", [Task(_double, (i,)) for i in range(3)]
        second = yield "two", [Task(_double, (sum(first),))]
        return second[0]

    with ThreadPoolExecutor(3) as pool:
        drive({"scene": plan()}, pool, events.append)
    assert [(event.kind, event.stage, event.results) for event in events] == [
        ("submitted", "one", ()),
        ("done", "one", (0, 2, 4)),
        ("submitted", "two", ()),
        ("done", "two", (12,)),
        ("finished", "", (12,)),
    ]
    assert events[1].lines == ("doubled 0", "doubled 1", "doubled 2")


def _double(number, *, report):
    time.sleep(0.02 * (3 - number % 3))  # the first is the last to end
    report(f"doubled {number}")
    return 2 * number


@pytest.mark.parametrize("at_once", [2, lambda: 2])
def test_no_more_scenes_than_asked_are_in_progress(at_once):
    inside, most = set(), []

    def note(event):
        (inside.add if event.kind == "submitted" else inside.discard)(event.name)
        most.append(len(inside))

    with ThreadPoolExecutor(4) as pool:
        map_scenes(len, SCENES, client=pool, at_once=at_once, report=note)
    assert max(most) == 2


def deadly(folder, source):
    """Kills its process once."""
    killed = Path(folder) / "killed"
    if "hall" in source and not killed.exists():
        killed.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return len(source)


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL")
def test_a_process_pool_that_broke_is_made_again(tmp_path):
    made, context = [], multiprocessing.get_context("spawn")

    def pool():
        made.append(ProcessPoolExecutor(1, mp_context=context))
        return made[-1]

    folder = str(tmp_path)
    found = map_scenes(lambda source: deadly(folder, source), SCENES[:2], client=pool, at_once=1)
    assert [one.value for one in found] == [13, 10]
    assert len(made) == 2


def test_a_broken_pool_that_cannot_be_made_again_ends_the_batch():
    from concurrent.futures import BrokenExecutor

    class Broken:
        def submit(self, function, *arguments):
            raise BrokenExecutor("a process died")

    with pytest.raises(BrokenExecutor, match="a process died"):
        map_scenes(len, SCENES, client=Broken())


def test_submitit_is_an_engine(tmp_path):
    submitit = pytest.importorskip("submitit")
    executor = submitit.LocalExecutor(folder=tmp_path)
    found = map_scenes(len, SCENES[:1], client=executor)
    assert found[0].value == 13


@pytest.mark.parametrize("at_once", [0, -1, 0.5, 2.5, float("inf"), "2", True, None, lambda: -1, lambda: "two"])
def test_a_wrong_number_of_scenes_at_once_is_refused(at_once, tmp_path):
    with pytest.raises(ValueError, match=tells("at_once", at_once() if callable(at_once) else at_once)):
        map_scenes(len, SCENES, client=ThreadPoolExecutor(1), at_once=at_once)
    if not callable(at_once):
        with pytest.raises(ValueError, match=tells("at_once", at_once)):
            run_batch(SCENES, tmp_path / "runs", client=ThreadPoolExecutor(1), at_once=at_once)
        assert not (tmp_path / "runs").exists()


def test_scenes_wait_while_there_are_no_workers():
    answers = [0, 0]
    with ThreadPoolExecutor(1) as pool:
        found = map_scenes(len, SCENES[:1], client=pool, at_once=lambda: answers.pop() if answers else 1)
    assert found[0].value == 13
    assert answers == []
