"""The benchmarks' option `--device`, and what goes with it."""

import argparse
import importlib
from pathlib import Path

import pytest
import torch

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
if not (BENCHMARKS / "devices.py").is_file():  # a source distribution comes without them
    pytest.skip(f"no folder {BENCHMARKS}", allow_module_level=True)
WITH_DEVICE = (
    "codebook", "color_field", "engines", "figure6", "fuse", "growth", "labels", "real_teacher",
    "streaming", "table1", "table2",
)  # fmt: skip


@pytest.fixture
def devices(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("devices")


def parse(devices, *words):
    parser = argparse.ArgumentParser()
    devices.add_device(parser)
    return parser.parse_args(words).device


def test_the_cpu_is_the_default(devices):
    assert parse(devices) == parse(devices, "--device", "cpu") == torch.device("cpu")


@pytest.mark.parametrize("name", ["cuda:99", "tpu", "meta"])
def test_a_device_that_is_not_there_is_an_error_in_one_line(devices, name, capsys):
    with pytest.raises(SystemExit):
        parse(devices, "--device", name)
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert "error: argument --device: expected" in line
    assert repr(name) in line


@pytest.mark.parametrize("name", WITH_DEVICE)
def test_each_of_these_benchmarks_has_the_option(name):
    assert "add_device(" in (BENCHMARKS / f"{name}.py").read_text()


def test_maps_are_moved_when_they_are_read(devices):
    class Maps(list):
        def grid(self, i, step, samples):
            return self[i].flatten(0, 1)[:samples]

    maps = Maps([torch.ones(2, 3, 4)])
    moved = devices.MapsOn(maps, torch.device("meta"))
    assert (len(moved), moved[0].device.type, moved[0].shape) == (1, "meta", (2, 3, 4))
    assert (moved.grid(0, None, 5).device.type, moved.grid(0, None, 5).shape) == ("meta", (5, 4))
    assert not hasattr(devices.MapsOn(list(maps), torch.device("meta")), "grid")
