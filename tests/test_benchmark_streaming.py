"""The benchmark of streamed maps: one run of a tiny configuration, the first stage in a process of its own as all are."""

import importlib
import json
from argparse import Namespace
from pathlib import Path

import pytest
from small_room import make_room

from kfgs.fields import GaussianParams
from kfgs.formats import write_splats
from kfgs.quant import IndexMaps
from kfgs.scenes import load_scene

ROOT = Path(__file__).resolve().parents[1]
if not (ROOT / "benchmarks" / "streaming.py").is_file():  # a source distribution comes without them
    pytest.skip("no folder benchmarks", allow_module_level=True)
if not Path("/proc/self/status").exists():
    pytest.skip("the highest memory is read from /proc", allow_module_level=True)


def test_each_stage_is_measured_and_the_maps_stay_only_where_asked(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    streaming = importlib.import_module("streaming")
    apart = streaming.run_apart  # a process costs seconds of imports

    def run(args, stage):
        return (
            apart(args, stage) if stage == "start" else streaming.run_stage(Namespace(**vars(args) | {"stage": stage}))
        )

    monkeypatch.setattr(streaming, "run_apart", run)
    scene, table = make_room(tmp_path / "scene"), tmp_path / "table.json"
    read = load_scene(scene)
    splat = GaussianParams.from_points(read.points, colors=read.colors, sh_degree=0).activated()
    write_splats(splat, tmp_path / "splat.ply")
    options = [
        "--splat",
        str(tmp_path / "splat.ply"),
        "--images",
        "11",
        "--size",
        "12",
        "16",
        "--channels",
        "7",
        "--epochs",
        "2",
        "--json",
        str(table),
    ]
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(streaming.tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setattr("sys.argv", ["streaming.py", str(scene), *options, "--folder", str(tmp_path / "kept")])
    streaming.main()
    found = json.loads(table.read_text())
    assert found["dense_bytes"] == 11 * 12 * 16 * 7 * 2
    assert [row["stage"] for row in found["stages"]] == ["start", "extract", "codebook", "index maps", "uplift"]
    assert 5e7 < found["stages"][0]["peak"] < 2e9
    assert len(list((tmp_path / "kept" / "maps").glob("*.npy"))) == 11  # more than the room has pictures
    maps = IndexMaps.load(tmp_path / "kept" / "index_maps.safetensors")
    assert (len(maps), maps[0].shape) == (11, (12, 16))
    assert list((tmp_path / "temporary").iterdir()) == []
    assert "| extract |" in capsys.readouterr().out
