import sys

import numpy as np
import pytest
import torch
from PIL import Image

from kfgs.viz import plot_codebook_history, plot_confusion, plot_training, plots

HISTORY = [{"epoch": i, "size": 8 + 2 * i, "loss": 1 / (i + 1), "coverage": i / 9, "note": "text"} for i in range(10)]


@pytest.fixture
def figures(monkeypatch):
    """The figures that were drawn, beside their files."""
    drawn = []
    save = plots._save
    monkeypatch.setattr(plots, "_save", lambda figure, path: (drawn.append(figure), save(figure, path))[1])
    return drawn


def picture(path):
    return np.asarray(Image.open(path).convert("RGB"))


def test_codebook_panels_hold_the_history(tmp_path, figures):
    plot_codebook_history(HISTORY, tmp_path / "codebook.png")
    panels = figures[0].axes
    assert [axes.get_title() for axes in panels] == ["size", "loss", "coverage"]
    np.testing.assert_array_equal(panels[0].lines[0].get_xydata(), [(i, 8 + 2 * i) for i in range(10)])
    assert panels[0].get_ylim()[0] == 0
    assert panels[0].get_xlabel() == "epoch"
    assert len(np.unique(picture(tmp_path / "codebook.png").reshape(-1, 3), axis=0)) > 20


def test_training_starts_with_the_loss_and_skips_gaps(tmp_path, figures):
    rows = [{"step": 0, "count": 5, "loss": 0.5}, {"step": 100, "count": 7, "loss": 0.25, "psnr": 20.0}]
    plot_training(rows, tmp_path / "training.png")
    panels = figures[0].axes
    assert [axes.get_title() for axes in panels] == ["loss", "count", "psnr"]
    np.testing.assert_array_equal(panels[2].lines[0].get_xydata(), [(100, 20)])


def test_confusion_is_in_per_cent_of_the_true_class(tmp_path, figures):
    matrix = torch.tensor([[3, 1, 0], [0, 0, 0], [2, 0, 2]])
    plot_confusion(matrix, ["wall", "unused?", "rug"], tmp_path / "confusion.png")
    axes = figures[0].axes[0]
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["wall", "unused?", "rug"]  # 1 was predicted once
    np.testing.assert_allclose(axes.images[0].get_array(), [[75, 25, 0], [0, 0, 0], [50, 0, 50]])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("predicted class", "true class")
    plot_confusion(matrix[[0, 2]][:, [0, 2]].numpy(), ["wall", "rug"], tmp_path / "small.png")
    np.testing.assert_allclose(figures[1].axes[0].images[0].get_array(), [[100, 0], [50, 50]])


def test_classes_that_never_occur_are_left_out(tmp_path, figures):
    matrix = torch.zeros(4, 4, dtype=torch.int64)
    matrix[1, 1], matrix[3, 1] = 4, 6
    plot_confusion(matrix, list("abcd"), tmp_path / "confusion.png")
    assert [tick.get_text() for tick in figures[0].axes[0].get_xticklabels()] == ["b", "d"]


def test_global_state_of_matplotlib_is_untouched(tmp_path):
    before = sys.modules.get("matplotlib.pyplot")
    plot_training(HISTORY, tmp_path / "a.png")
    assert sys.modules.get("matplotlib.pyplot") is before


def test_wrong_input_is_named(tmp_path):
    with pytest.raises(ValueError, match="history: expected at least one row"):
        plot_training([], tmp_path / "a.png")
    with pytest.raises(ValueError, match="history: expected rows with numbers"):
        plot_codebook_history([{"epoch": 0, "note": "x"}], tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"matrix: expected \[C, C\]"):
        plot_confusion(torch.zeros(2, 3), ["a", "b"], tmp_path / "a.png")
    with pytest.raises(ValueError, match="names: expected 2 class names"):
        plot_confusion(torch.zeros(2, 2), ["a"], tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"ends in .png, got 'a.pdf'"):
        plot_training(HISTORY, tmp_path / "a.pdf")
    assert list(tmp_path.iterdir()) == []


def test_missing_matplotlib_names_the_install_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match="pip install matplotlib"):
        plot_training(HISTORY, tmp_path / "a.png")
