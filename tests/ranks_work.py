"""What the processes of `test_ranks.py` do: one job by any number of processes, and the ways in which one of them may fail.

    python ranks_work.py WORK FOLDER    # RANK and WORLD_SIZE say which process this is

Each process writes FOLDER/<rank>.json, what it found by name.
"""

import dataclasses
import io
import json
import os
import signal
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import small_room
import torch

from kfgs import _ranks, cli
from kfgs.features import FeatureFolder
from kfgs.fields import FieldConfig, GaussianParams, UpliftConfig, fit_field, fused_answers, uplift_maps
from kfgs.fields.trainer import Trainer
from kfgs.pipeline import ColorConfig, fit_color, fit_scene, together
from kfgs.pipeline.stages import digest_tensors
from kfgs.quant import CodebookConfig, fit_codebook, quantize_maps
from kfgs.scenes import load_scene

FIELD = FieldConfig(
    steps=12, views_per_step=3, densify_from=2, densify_until=11, densify_every=4, densify_gradient=1e-7,
    reset_every=6, report_every=3, max_gaussians=900,
)  # fmt: skip
COLOR = ColorConfig(sh_degree=1, field=dataclasses.replace(small_room.FIELD, steps=40, views_per_step=2))


def inputs(room, seed=0):
    """The start of a field with 300 Gaussians, five views, and their maps of 8 channels."""
    scene = load_scene(room)
    views = scene.views("train")[:5]
    maps = FeatureFolder(room / "features").of(scene, "train")
    start = GaussianParams.from_points(scene.points, 8, max_points=300, generator=torch.Generator().manual_seed(seed))
    return start, [scene.cameras[i].resized(30, 40) for i in views], [maps[i][..., :8].float() for i in range(5)]


def shared(folder, room):
    """Digests of all that several processes compute together, without files."""
    (start, views, maps), found, rows = inputs(room), {}, []
    cloud = start.activated().detach()
    fit = fit_field(start, views, maps, FIELD, progress=rows.append)
    found["rows"] = len(rows)
    found["grown"] = len(fit.params) > len(start)
    found["field"] = digest_tensors(*fit.params.to_tensors().values())
    found["losses"] = [row["loss"] for row in fit.history]
    up = uplift_maps(cloud, views, maps, UpliftConfig(max_gaussians=100))
    found["uplift"] = digest_tensors(
        up.gaussians.features, up.gaussians.means, up.latents.basis, up.pixels, up.agreement
    )
    book = fit_codebook(maps, CodebookConfig(maximum=16)).codebook
    found["codebook"] = digest_tensors(book.codewords)
    paper = CodebookConfig.paper(maximum=12, initial=3, epochs=3, eager_epochs=1, step_every=2)
    fitted = fit_codebook(maps, paper)
    found["paper"] = digest_tensors(fitted.codebook.codewords, fitted.usage)
    index = quantize_maps(maps, book, scratch=folder / "index")
    found["index"] = [one.tolist() for one in index]
    field = fit.params.activated().detach()
    answers = fused_answers(field, book, None, views)
    found["answers"] = digest_tensors(answers.latents, answers.linear.basis, *answers.seen)
    return found


def scene_run(folder, room):
    """A whole run, default method; the number of stages that were made."""
    scene = load_scene(room)
    maps = FeatureFolder(room / "features").of(scene, "train")
    config = dataclasses.replace(small_room.CONFIG, method="fuse", color=COLOR)
    lines = []
    stages = [fit_scene(scene, maps, folder / "run", config, report=lines.append).stages for _ in range(2)]
    return {"reused": [[stage.reused for stage in some] for some in stages], "lines": len(lines)}


class Broken(list):
    """Maps of which one cannot be read."""

    def __getitem__(self, i):
        if i == 1:
            raise ValueError("maps[1]: this one is broken: ä")
        return super().__getitem__(i)


def told(function, *kinds):
    try:
        function()
    except kinds as error:
        return [type(error).__name__, str(error)]
    return None


def work(folder, room):
    rank = _ranks.place()[0]
    with together():
        found = shared(folder, room)
        found |= scene_run(folder, room)
        found["once"] = _ranks.once(lambda: {"rank": rank, "alone": _ranks._group is None})

    def break_one():
        with together():
            start, views, maps = inputs(room)
            uplift_maps(start.activated().detach(), views, Broken(maps))

    def disagree():
        with together():
            fit_field(*inputs(room, seed=rank), FIELD)

    def part_ways():
        with together():
            _ranks.meet() if rank else _ranks.once(lambda: 1)

    with redirect_stderr(io.StringIO()) as errors, redirect_stdout(io.StringIO()) as output:
        arguments = ["fit", room, "--features", room / "broken", "--out", folder / "failed", "--steps", "2"]
        found["code"] = cli.main([str(word) for word in arguments])
    found["errors"], found["output"] = errors.getvalue(), output.getvalue()
    found["broken"] = told(break_one, ValueError, _ranks.PeerError)
    found["other start"] = told(disagree, ValueError)
    found["parted"] = told(part_ways, _ranks.LostError)
    with together():
        found["in step again"] = [
            int(part["i"]) for part in _ranks.in_order(range(5), lambda i: {"i": torch.tensor(i)})
        ]
    return found


def lose(folder, room):
    """The last process is killed; or, of two, does not answer."""
    rank, size = _ranks.place()

    def last():
        with together(timeout=60 if size > 2 else 1):
            _ranks.meet()
            if rank == size - 1:
                if size > 2:
                    os.kill(os.getpid(), signal.SIGKILL)
                time.sleep(3)
            _ranks.meet()

    started = time.time()
    return {"lost": told(last, _ranks.LostError), "seconds": time.time() - started}


def colors(folder, room):
    """A colour field. Under torchrun, the last process is killed after the first checkpoint of the first attempt."""
    rank, size = _ranks.place()
    steps, usual = [], Trainer.advance_

    def advance_(self):
        if size > 1 and rank == size - 1 and self.step == 17 and os.environ["TORCHELASTIC_RESTART_COUNT"] == "0":
            os.kill(os.getpid(), signal.SIGKILL)
        steps.append(self.step)
        return usual(self)

    Trainer.advance_ = advance_
    try:
        with together():
            fit_color(load_scene(room), folder / "run", COLOR)
    finally:
        Trainer.advance_ = usual
    return {"first step": steps[0]}


def main():
    do, folder = globals()[sys.argv[1]], Path(sys.argv[2])
    found = do(folder, Path(sys.argv[3]))
    if do is work:
        found |= lose(folder, None)
    (folder / f"{_ranks.place()[0]}.json").write_text(json.dumps(found))


if __name__ == "__main__":
    main()
