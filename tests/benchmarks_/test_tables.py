"""The tables of the documentation: a run writes one and resumes, the leaderboard keeps it without paths, and is up to date."""

import argparse
import json
import sys
from pathlib import Path

import leaderboard
import pytest
import table1
import table1_report
import table1_rows
import table2
from small_room import ROOM
from small_task import cloud

from kfgs.formats import write_splats
from kfgs.quant import PaperCodebook
from kfgs.toy.room_folder import make_toy_room

DOCS = Path(leaderboard.__file__).resolve().parents[1] / "docs"


def run(monkeypatch, module, *words):
    monkeypatch.setattr(sys, "argv", [f"{module.__name__}.py", *map(str, words)])
    module.main()


def test_published_figures_are_those_of_the_paper():
    paper = [row.paper["miou"] for row in table1_rows.ROWS.values() if row.paper]
    assert paper == [32.0, 58.5, 73.4, 73.9, 73.5, 77.9, 76.6]


def test_a_run_writes_table_and_pictures_resumes_and_joins_the_leaderboard(tmp_path, monkeypatch, capsys):
    room, out = make_toy_room(tmp_path / "room", ROOM), tmp_path / "out"
    means = cloud(300).means * 2
    write_splats(cloud(300).replace(means=means, sh=means[:, None, :].clone()), tmp_path / "splat.ply")
    words = [room, room / "features", out, "--splat", tmp_path / "splat.ply", "--quick", "--rows", "uplift"]
    words += ["--truth", "labels"]
    run(monkeypatch, table1, *words)
    assert "| plain uplift |" in capsys.readouterr().out
    report = json.loads((out / "table1.json").read_text())
    (row,) = report["rows"]
    assert row["request"]["config"] == {"pixels": 80_000, "keep": 0.995}
    assert row["peak"] > 10**8
    assert row["storage"] < row["disk"]
    for name in ("quality_storage", "quality_time", "labels"):
        assert (out / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    assert row["miou_nearest"] == row["miou"]  # its own rule
    assert 0 < row["miou_votes"] < 1
    assert 0.9 < row["codec_cosine"] <= 1
    assert len(row["teacher"]["rows"]) == row["views"]
    monkeypatch.setattr(table1.subprocess, "run", lambda *args, **kwargs: pytest.fail("made again"))
    run(monkeypatch, table1, *words)
    assert json.loads((out / "table1.json").read_text())["rows"] == report["rows"]
    row_of_rooms = "| plain uplift | {0} | {0} | {0} ({0} to {0}) |".format(f"{100 * row['miou']:.1f}")
    assert row_of_rooms in table1_report.rooms_text([out, out])
    runs, page = tmp_path / "runs", tmp_path / "page.md"
    run(monkeypatch, leaderboard, runs, page, "--add", out, "--name", "room-quick", "--about", "A tiny room.")
    kept = (runs / "room-quick.json").read_text()
    assert "A tiny room." in page.read_text()
    assert not [word for word in (str(tmp_path), "history", "confusion") if word in kept + page.read_text()]
    run(monkeypatch, leaderboard, runs, page, "--check")
    (room / "features" / "more.txt").write_text("other data")
    with pytest.raises(pytest.fail.Exception, match="made again"):
        run(monkeypatch, table1, *words)


def test_the_page_in_the_docs_is_that_of_its_runs(monkeypatch):
    run(monkeypatch, leaderboard, DOCS / "runs", DOCS / "leaderboard.md", "--check")


def test_512_is_the_row_of_table_2_without_an_autoencoder():
    args = argparse.Namespace(preset="cpu", quick=True, steps=None, device="cpu")
    config = table2.config_of(512, args)
    assert (config.codebook, config.autoencoder, config.training.steps) == (PaperCodebook(), None, 350)
    config = table2.config_of(6, args)
    assert (config.codebook, config.autoencoder.latent, config.training.steps) == (PaperCodebook(), 6, 800)
