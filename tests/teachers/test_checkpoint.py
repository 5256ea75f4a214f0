import argparse
import collections
import io
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import refused
from safetensors.torch import save_file

from kfgs.teachers.checkpoint import read_checkpoint

DTYPES = (
    torch.float32,
    torch.float16,
    torch.bfloat16,
    torch.float64,
    torch.int64,
    torch.uint8,
    torch.bool,
    torch.complex64,
)


def make_state() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    state: dict[str, torch.Tensor] = collections.OrderedDict()
    for index, dtype in enumerate(DTYPES):
        state[f"net.{index}.weight"] = (torch.rand(3, 5, generator=generator) * 9).to(dtype)
    base = torch.rand(4, 6, generator=generator)
    state["net.transposed"], state["net.sliced"], state["net.tied"] = base.T, base[1:3, 2:], base
    state["net.scalar"], state["net.empty"] = torch.tensor(2.5), torch.zeros(0, 7)
    state["net.parameter"] = torch.nn.Parameter(torch.rand(2, 2, generator=generator))
    return state


def assert_same(found: dict[str, torch.Tensor], state: dict[str, torch.Tensor]) -> None:
    assert list(found) == list(state)
    for name, value in state.items():
        assert found[name].dtype == value.dtype, name
        assert found[name].device.type == "cpu"
        assert not found[name].requires_grad
        assert torch.equal(found[name], value.detach()), name


class Callback:  # stands for the classes that Lightning's files name
    pass


WRAPPED = {
    "plain": lambda state: state,
    "lightning": lambda state: {
        "epoch": 200,
        "pytorch-lightning_version": "1.4.9",
        "callbacks": {Callback: {"best_model_score": torch.tensor(0.5), "best_model_path": Path("a/b.ckpt")}},
        "optimizer_states": [{"state": {0: {"step": np.float64(3), "exp_avg": torch.ones(4)}}}],
        "hyper_parameters": argparse.Namespace(
            backbone="clip_vitl16_384", scales=[0.5, 1], seen={1, (2, 3)}, big=10**30
        ),
        "state_dict": state,
    },
    "model": lambda state: {"model": state, "epoch": 3},
    "model_state_dict": lambda state: {"optimizer": {}, "model_state_dict": state},
    "nested": lambda state: {"model": {"state_dict": state}},
    "extras": lambda state: collections.defaultdict(list, **state, version=3, note="x"),
}


@pytest.mark.parametrize("wrap", [*WRAPPED, "safetensors"])
@pytest.mark.parametrize("zipped", [True, False], ids=["zip", "legacy"])
def test_reads_what_torch_saves(tmp_path: Path, wrap: str, zipped: bool) -> None:
    """Files of torch before 1.6 are read if they name no class; safetensors by content, whatever their name."""
    if not zipped and wrap in ("lightning", "extras"):
        return
    state = make_state()
    if wrap == "safetensors":
        state = {"a": torch.rand(3, 4), "b": torch.ones(2)}
        save_file(state, tmp_path / "a.ckpt")
    else:
        torch.save(WRAPPED[wrap](state), tmp_path / "a.ckpt", _use_new_zipfile_serialization=zipped)
    assert_same(read_checkpoint(tmp_path / "a.ckpt"), state)


def test_reading_does_not_touch_the_values(tmp_path: Path) -> None:
    """64 MiB of weights are mapped: the process's own memory grows by less than a sixteenth of that."""
    torch.save({"a": torch.zeros(1 << 24)}, tmp_path / "a.pt")
    resident = lambda: int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")  # noqa: E731
    before = resident()
    found = read_checkpoint(tmp_path / "a.pt")
    assert resident() - before < 4 << 20
    assert found["a"].shape == (1 << 24,)


def test_every_truncation_and_many_flips_give_one_line(tmp_path: Path) -> None:
    """Cut anywhere, the file is refused; with one byte changed it is read or refused, never anything else."""
    generator = np.random.default_rng(0)
    state = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.ones(2)}
    for zipped in (True, False):
        buffer = io.BytesIO()
        torch.save({"state_dict": state, "x": argparse.Namespace(a=1)}, buffer, _use_new_zipfile_serialization=zipped)
        whole, path = buffer.getvalue(), tmp_path / f"{zipped}.pt"
        for size in range(0, len(whole), 7):
            path.write_bytes(whole[:size])
            refused(lambda path=path: read_checkpoint(path), "checkpoint")
        for _ in range(400):
            changed = bytearray(whole)
            changed[generator.integers(len(whole))] = generator.integers(256)
            path.write_bytes(changed)
            try:
                assert all(tensor.numel() <= 6 for tensor in read_checkpoint(path).values())
            except ValueError as error:
                assert str(error).startswith(str(path)), changed  # noqa: PT017
                assert "\n" not in str(error)  # noqa: PT017


@pytest.mark.parametrize(
    ("value", "match"),
    [
        (torch.ones(3), ("a.pt:", "Tensor", "state dict")),
        ({"epoch": 3, "loss": [1.0]}, ("a.pt:", "epoch, loss", "state dict")),
        ({}, ("a.pt:", "state dict")),
        ([torch.ones(3)], ("a.pt:", "list")),
        (argparse.Namespace(a=1), ("a.pt:", "state_dict()")),
        (torch.nn.Linear(2, 2), ("a.pt:", "state_dict()")),
        ({"a": torch.eye(2).to_sparse(), "b": torch.ones(1)}, ("a.pt:", "dense tensor for a")),
        ({"a": torch.ones(1).expand(1000)}, ("a.pt: a has [1000]", "only 1", "contiguous")),
    ],
)
def test_what_torch_saves_beside_state_dicts_is_named(tmp_path: Path, value: object, match: str) -> None:
    torch.save(value, tmp_path / "a.pt")
    refused(lambda: read_checkpoint(tmp_path / "a.pt"), *match)


def test_no_file_and_folder(tmp_path: Path) -> None:
    refused(lambda: read_checkpoint(tmp_path / "a.ckpt"), "a.ckpt:", "no such file", error=FileNotFoundError)
    refused(lambda: read_checkpoint(tmp_path), "checkpoint", "got a folder", "weights")
