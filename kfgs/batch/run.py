"""Many scenes as tasks of Dask, the record of each in its run folder, and the table of all."""

from __future__ import annotations

import time
import traceback
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from .._card import cut, error_line
from .._files import check_output, digest_value, locked, read_json, write_json
from .._notes import hear
from ..pipeline import Uplift
from .scene_list import check_scenes
from .scene_task import BatchOptions, make_scene, stamps

STATE, LOG, LOCK, TOPIC = "state.json", "log.txt", ".batch.lock", "kfgs-batch/2"
MESSAGE = 600  # characters of a failure: sfm's message is long, and its end is advice


@dataclass
class SceneResult:
    """What became of one scene; its `state.json` holds the same."""

    name: str
    key: str = ""
    """Digest of what decides the result."""
    step: str = "start"
    """The step that works, or worked last: cameras, features, fit, segment."""
    seconds: dict[str, float] = field(default_factory=dict)
    """The time of each finished step."""
    value: dict[str, Any] | None = None
    """`gaussians`, `latents`, and `miou` (None without true labels); None if the scene is not finished."""
    failure: str | None = None
    """Why the scene failed; `log.txt` has the traceback."""


def run_batch(
    scenes: Mapping[str, str | Path],
    out: str | Path,
    options: BatchOptions | None = None,
    *,
    client: Any = None,
    report: Callable[[str], None] | None = None,
) -> list[SceneResult]:
    """Find cameras, make features, fit, segment and score many scenes. What is done is not repeated.

    Each scene is a task of Dask and gets a folder `out/<name>`: `scene/` (if its cameras had to be found), `features/`,
    the field, `segmented/`, `scores.json` (if it has true labels), `log.txt`, `state.json`. Dask gives a task whose worker
    died to another worker, which continues after the last finished stage. A scene that fails is recorded, the others
    continue, and the same call again tries it again.

    Args:
        scenes: folders by the names of their runs (`read_scenes`); each with a COLMAP model, a transforms.json, or photos.
        out: the folder of the runs. Paths must mean the same in all workers.
        options: what is done with each scene.
        client: a `distributed.Client` whose workers run one task at a time (`open_client`); None: one scene after the other
            in this process.
        report: called with a line for each step of a scene.

    Returns:
        A result per scene, in their order.

    Raises:
        ValueError: if there are no scenes, a run would be in the folder of a scene, or another batch works in `out`.
        OSError: if `out` cannot be written to.
    """
    root = check_output("out", out, "a folder").absolute()
    places, options, say = check_scenes(scenes, root), options or BatchOptions(), report or (lambda line: None)
    told = say if client is None else None
    tasks = {name: (source, root / name, options, told) for name, source in places.items()}
    results = dict[str, SceneResult]()
    with locked(root, LOCK):
        for name, result in run_tasks(_run_scene, tasks, client, say):
            if isinstance(result, Exception):  # the folder is not ours, or Dask gave up, as the scene's workers died
                failure = str(result) or error_line(result)
                say(f"{name} failed: {failure}")
                known = read_state(root / name)
                result = replace(known or SceneResult(name), value=None, failure=failure)
                if known is not None:
                    write_json(root / name / STATE, asdict(result))
            results[name] = result
    return [results[name] for name in places]


def run_tasks(
    function: Callable[..., Any], tasks: Mapping[str, tuple[Any, ...]], client: Any, report: Callable[[str], None]
) -> Iterator[tuple[str, Any]]:
    """Call a function with each task's arguments, here or in Dask's workers; yields (name, result or error) as they end."""
    if client is None:
        for name, given in tasks.items():
            try:
                yield name, function(*given)
            except Exception as error:
                yield name, error
        return
    from distributed import as_completed

    client.subscribe_topic(TOPIC, lambda event: report(event[1]))
    once = uuid.uuid4().hex  # Dask would return an older call's result for an equal key
    futures = {client.submit(function, *tasks[name], key=f"{name}-{once}", pure=False): name for name in tasks}
    for future in as_completed(futures, loop=client.loop):
        yield futures[future], future.exception() or future.result()


def _run_scene(source: Path, run: Path, options: BatchOptions, report: Callable[[str], None] | None) -> SceneResult:
    """The task of a scene. An error of its work is part of the result."""
    known = read_state(run)
    if known is None and run.is_dir() and any(run.iterdir()):
        raise FileExistsError(f"{run}: expected a new folder, or a run of kfgs batch, got other files; move them")
    files = [Path(path) for path in (options.weights, options.text) if path is not None and Path(path).is_file()]
    marks = [stamps(source, "features" if options.teacher else None), [file.stat().st_mtime_ns for file in files]]
    plain = asdict(replace(options, method=Uplift())) | {"method": options.method.options()}
    key = digest_value([marks, plain, version("kfgs")])
    if known is not None and known.key == key and known.value is not None:
        return known
    state = SceneResult(run.name, key)
    write_json(run / STATE, asdict(state))

    def say(line: str) -> None:
        with (run / LOG).open("a", encoding="utf-8") as file:
            file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {line}\n")
        (report or _tell_client)(f"{run.name}: {line.splitlines()[0]}")

    @contextmanager
    def step(name: str) -> Iterator[None]:
        state.step, start = name, time.perf_counter()
        write_json(run / STATE, asdict(state))
        yield
        state.seconds[name] = round(time.perf_counter() - start, 3)
        say(f"{name} done in {state.seconds[name]:.1f} s")

    threads = torch.get_num_threads()
    torch.set_num_threads(options.threads)
    try:
        with hear(lambda note: say(f"note: {note}"), strict=options.strict):
            state.value = make_scene(source, run, options, step, say)
    except Exception as error:
        state.failure = str(error) or error_line(error)
        say(f"{state.step} failed: {cut(state.failure, MESSAGE)}\n{traceback.format_exc()}")
    finally:
        torch.set_num_threads(threads)
    write_json(run / STATE, asdict(state))
    return state


def _tell_client(line: str) -> None:
    from distributed import get_worker

    get_worker().log_event(TOPIC, line)


def read_state(run: Path) -> SceneResult | None:
    """The `state.json` of a run; None if there is none, or it was not written by this version of `kfgs batch`."""
    try:
        return SceneResult(**read_json(run / STATE))
    except (OSError, ValueError, TypeError):
        return None


def describe_batch(folder: Path) -> str | None:
    """A line for each scene that a batch has begun in a folder, and one that counts them; None if there is none."""
    states = [state for file in sorted(folder.glob(f"*/{STATE}")) if (state := read_state(file.parent)) is not None]
    if not states:
        return None
    lines, ends = [f"{folder}: a batch"], list[str]()
    for state in states:
        ends.append("finished" if state.value else "failed" if state.failure else "unfinished")
        miou = state.value["miou"] if state.value else None
        what = f" in {state.step}" if state.value is None else "" if miou is None else f", mIoU {miou:.3f}"
        lines.append(f"  {state.name}: {ends[-1]}{what}, {sum(state.seconds.values()):.0f} s")
        lines += [f"    {cut(state.failure, MESSAGE)}"] if state.failure else []
    scores = [state.value["miou"] for state in states if state.value and state.value["miou"] is not None]
    words = [f"{count} {ended}" for ended, count in Counter(ends).items()]
    words += [f"mean mIoU {sum(scores) / len(scores):.3f} of {len(scores)}"] if scores else []
    lines.append(f"{len(states)} scene{'s' * (len(states) != 1)}: {', '.join(words)}")
    return "\n".join(lines)
