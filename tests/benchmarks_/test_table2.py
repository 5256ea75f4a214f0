import argparse

import figure6
import table2
from small_task import MIB

from kfgs.quant import PaperCodebook


def row(dim):
    scores = {"miou": 0.7, "accuracy": 0.9, "gaussians": 20_000, "storage": 5 * MIB, "fps_maps": 70.0, "steps": 800}
    return {"dim": dim, "stages": {"codebook": 30.0, "field": 60.0, "answers": 9.0}, **scores}


def test_table_puts_the_paper_beside(tmp_path):
    rows = [row(3), row(7), row(512)]
    lines = table2.table_text(rows, "command").splitlines()
    assert lines[4] == "| 3 | 70.0 | 90.0 | 1.50 | 20.0k | 5.00 | 70.0 | 800 | 73.6, 6, 131.5k, 12.0, 39.6 |"
    assert lines[5].endswith("| - |")
    table2.draw(tmp_path / "table2.png", rows)
    assert (tmp_path / "table2.png").read_bytes()[:4] == b"\x89PNG"


def test_512_is_the_row_without_an_autoencoder():
    args = argparse.Namespace(preset="cpu", quick=True, steps=None, device="cpu")
    config = table2.config_of(512, args)
    assert (config.codebook, config.autoencoder, config.training.steps) == (PaperCodebook(), None, 350)
    config = table2.config_of(6, args)
    assert (config.codebook, config.autoencoder.latent, config.training.steps) == (PaperCodebook(), 6, 800)


def test_codewords_are_drawn_for_every_scene(tmp_path):
    limit = {"paper": 100, "default": 255}
    scenes = [{"scene": name, "limit": limit, "paper": [8, 60, 90], "default": [2, 4, 9]} for name in ("a", "b")]
    figure6.draw(tmp_path / "figure6.png", scenes)
    assert (tmp_path / "figure6.png").read_bytes()[:4] == b"\x89PNG"
