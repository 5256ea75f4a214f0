"""The Triton engine: interpreted on the CPU, compiled for GPUs that are not there, and run on one that is."""

import json
import os
import subprocess
import sys
from pathlib import Path

import cases_triton
import pytest
import torch

triton = pytest.importorskip("triton", reason="the Triton engine needs `pip install triton`")

from messages import refused  # noqa: E402

from kfgs.splat import accumulate_pixels, composite  # noqa: E402
from kfgs.splat.engines.table import choose  # noqa: E402
from kfgs.splat.engines.triton import engine as triton_gpu  # noqa: E402 - only where triton is installed

ROOT = Path(__file__).resolve().parents[2]
every_case = pytest.mark.parametrize("case", cases_triton.CASES)


def _report(*arguments, interpret=False):
    """What the script says, in a process where triton has not been imported yet."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    if interpret:
        environment["TRITON_INTERPRET"] = "1"
    command = [sys.executable, "-W", "error", str(ROOT / "tests" / "cases_triton.py"), *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def _assert_agrees(reports, name):
    """Maps are of values of about 1; gradients are compared with the largest."""
    assert "failed" not in reports[name], reports[name]["failed"]
    assert cases_triton.find_faults(name, reports[name]) == {}


@pytest.fixture(scope="module")
def interpreted():
    return _report("run", "cpu", interpret=True)


@every_case
def test_interpreted_kernels_agree_with_the_reference(interpreted, case):
    _assert_agrees(interpreted, case)


def test_interpreted_frame_agrees_with_the_reference(interpreted):
    _assert_agrees(interpreted, "frame")


every_projection = pytest.mark.parametrize("case", cases_triton.PROJECTIONS)


@every_projection
def test_interpreted_projection_and_tiles_agree_with_kornia_and_torch(interpreted, case):
    _assert_agrees(interpreted, f"projection, {case}")


@pytest.fixture(scope="module")
def on_gpu():
    return _report("run", "cuda")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
class TestOnGpu:
    @every_case
    def test_agrees_with_the_reference(self, on_gpu, case):
        _assert_agrees(on_gpu, case)

    def test_frame_agrees_with_the_reference(self, on_gpu):
        _assert_agrees(on_gpu, "frame")

    @every_projection
    def test_projection_and_tiles_agree_with_kornia_and_torch(self, on_gpu, case):
        _assert_agrees(on_gpu, f"projection, {case}")

    def test_is_what_auto_takes(self):
        inputs, index, tiles, *_ = cases_triton.make_scene(cases_triton.CASES["indexed"], "cuda")
        auto, named = (composite(*inputs[:4], tiles, index=index, engine=engine) for engine in ("auto", "triton"))
        assert all(torch.equal(a, b) for a, b in zip(auto, named, strict=True))

    def test_does_not_wait_for_the_gpu(self):
        inputs, index, tiles, *cotangents = cases_triton.make_scene(cases_triton.CASES["indexed"], "cuda")
        inputs = [value.requires_grad_() for value in inputs]
        torch.cuda.set_sync_debug_mode("error")
        try:
            with pytest.raises(RuntimeError, match="synchronizing"):  # torch reports a wait
                cotangents[0].sum().item()
            outputs = composite(*inputs[:4], tiles, background=inputs[4], index=index, engine="triton")
            grads = torch.autograd.grad(outputs, inputs, cotangents)
            sums = accumulate_pixels(*inputs[:3], cotangents[0], tiles, engine="triton")
        finally:
            torch.cuda.set_sync_debug_mode("default")
        assert all(value.is_cuda and bool(value.isfinite().all()) for value in (*outputs, *grads, *sums))


# compiled for GPUs that are not there ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def compiled():
    return _report("compile")


@pytest.mark.parametrize("build", cases_triton.BUILDS)
def test_kernels_compile_ahead_of_time(compiled, build):
    facts = compiled[build]
    assert "failed" not in facts, facts["failed"]
    assert facts["cubin"] > 1000
    assert bool(facts["products"]) == (cases_triton.BUILDS[build].channels > 16), "wide products take the tensor cores"
    assert facts["shared"] <= 99 * 1024  # what a program may have on GPUs of sm_86, sm_89 and sm_120
    if "stack" in facts:
        # bytes; twice as many took longer on an H200, a few hundred not
        assert facts["stack"] <= 700, "registers spill"


# the host side --------------------------------------------------------------------------------------------------------


def test_devices():
    engine = triton_gpu.ENGINE
    assert engine.devices == (("cuda", "cpu") if os.environ.get("TRITON_INTERPRET") == "1" else ("cuda",))
    refused(lambda: choose("triton", "cuda", torch.float64), "engine:", "torch.float64", "got 'triton'")
    assert choose("auto", "cuda", torch.float64).dtypes[-1] is torch.float64  # it passes on to another
