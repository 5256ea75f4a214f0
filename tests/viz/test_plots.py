import sys

import numpy as np
import pytest
import torch
from PIL import Image

from kfgs.quant import fit_codebook
from kfgs.viz import palette, plot_codebook_history, plot_confusion, plot_training, plots
from kfgs.viz.plots import plot_iou

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


def test_codebook_panels_of_an_adaptive_fit_have_no_loss(tmp_path, figures):
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(5, 16, generator=generator), dim=1)
    history = fit_codebook([directions[torch.randint(0, 5, (20, 30), generator=generator)]]).history
    plot_codebook_history(history, tmp_path / "codebook.png")
    panels = figures[0].axes
    assert [axes.get_title() for axes in panels] == ["size", "added", "mean_similarity", "pruned", "coverage"]
    np.testing.assert_array_equal(panels[0].lines[0].get_xydata(), [(row["epoch"], row["size"]) for row in history])
    assert len(history) > 2
    assert history[-1]["size"] == 5


def test_training_starts_with_the_loss_and_skips_gaps(tmp_path, figures):
    rows = [{"step": 0, "count": 5, "loss": 0.5}, {"step": 100, "count": 7, "loss": 0.25, "psnr": 20.0}]
    plot_training(rows, tmp_path / "training.png")
    panels = figures[0].axes
    assert [axes.get_title() for axes in panels] == ["loss", "count", "psnr"]
    np.testing.assert_array_equal(panels[2].lines[0].get_xydata(), [(100, 20)])


def test_the_clock_is_drawn_only_when_asked_for(tmp_path, figures):
    rows = [{"step": i, "count": 5, "seconds": 0.1 * i, "loss": 0.5} for i in range(3)]
    plot_training(rows, tmp_path / "a.png")
    plot_training(rows, tmp_path / "a.png", leave_out=())
    plot_training(rows, tmp_path / "a.png", leave_out=["count"])
    titles = [[axes.get_title() for axes in figure.axes] for figure in figures]
    assert titles == [["loss", "count"], ["loss", "count", "seconds"], ["loss", "seconds"]]
    with pytest.raises(ValueError, match="history: expected rows with numbers to draw, got keys"):
        plot_training(rows, tmp_path / "a.png", leave_out=["count", "seconds", "loss"])


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


def test_misses_are_a_last_column_and_count_in_their_row(tmp_path, figures):
    matrix, misses = torch.tensor([[3, 1, 0], [0, 0, 0], [0, 0, 0]]), torch.tensor([4, 0, 5])
    plot_confusion(matrix, ["wall", "rug", "lamp"], tmp_path / "a.png", misses=misses)
    axes = figures[0].axes[0]
    np.testing.assert_allclose(axes.images[0].get_array(), [[37.5, 12.5, 0, 50], [0, 0, 0, 0], [0, 0, 0, 100]])
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["wall", "rug", "lamp", "no class"]
    plot_confusion(matrix, ["wall", "rug", "lamp"], tmp_path / "b.png", misses=torch.zeros(3))
    assert figures[1].axes[0].images[0].get_array().shape == (2, 2)


def test_iou_bars_are_sorted_and_coloured_by_class(tmp_path, figures):
    iou = torch.tensor([0.5, float("nan"), 0.9, 0.25])
    theirs = torch.tensor([0.4, 0.1, float("nan"), 0.6])
    plot_iou(iou, ["a", "b", "c", "d"], tmp_path / "iou.png", reference=theirs, reference_name="teacher")
    axes = figures[0].axes[0]
    np.testing.assert_allclose([bar.get_width() for bar in axes.patches], [90, 50, 25])
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["c", "a", "d"]
    assert axes.get_ylim()[0] > axes.get_ylim()[1]  # the best on top
    colors = palette(np.array([2, 0, 3])) / 255
    np.testing.assert_allclose([bar.get_facecolor()[:3] for bar in axes.patches], colors)
    np.testing.assert_allclose(axes.lines[-1].get_xdata(), 55, rtol=1e-6)  # (90 + 50 + 25) / 3
    np.testing.assert_allclose(np.ma.getdata(axes.collections[0].get_offsets()), [(np.nan, 0), (40, 1), (60, 2)])
    entries = [text.get_text() for text in figures[0].legends[0].get_texts()]
    assert entries == ["mIoU 55.0", "teacher (mIoU 36.7)"]
    assert "do not occur: 1 of 4" in axes.get_xlabel()
    assert len(np.unique(picture(tmp_path / "iou.png").reshape(-1, 3), axis=0)) > 20


def test_counts_start_at_zero_with_room_above(tmp_path, figures):
    rows = [{"step": i, "loss": 1.0, "count": 18_000 + i, "pruned": 0} for i in range(5)]
    plot_training(rows, tmp_path / "a.png")
    _, count, pruned = figures[0].axes
    assert count.get_ylim() == (0, pytest.approx(1.06 * 18_004))
    assert pruned.get_ylim() == (0, pytest.approx(1.06))  # not from -0.05 to 0.05
    assert all(float(tick).is_integer() for tick in pruned.get_yticks())


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
    with pytest.raises(ValueError, match=r"misses: expected \[C\] with C = 2 \(from matrix\)"):
        plot_confusion(torch.zeros(2, 2), ["a", "b"], tmp_path / "a.png", misses=torch.zeros(3))
    with pytest.raises(ValueError, match=r"names: expected 2 class names \(from iou\), got 1; pass one name"):
        plot_iou(torch.zeros(2), ["a"], tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"iou: expected fractions in \[0, 1\] or NaN, got 76.6; divide"):
        plot_iou(torch.tensor([76.6]), ["a"], tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"reference: expected \[C\] with C = 1"):
        plot_iou(torch.zeros(1), ["a"], tmp_path / "a.png", reference=torch.zeros(2))
    with pytest.raises(ValueError, match="iou: expected a class that occurs, got 1 NaN"):
        plot_iou(torch.tensor([torch.nan]), ["a"], tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"ends in .png, got 'a.pdf'"):
        plot_training(HISTORY, tmp_path / "a.pdf")
    assert list(tmp_path.iterdir()) == []


def test_missing_matplotlib_names_the_install_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match="pip install matplotlib"):
        plot_training(HISTORY, tmp_path / "a.png")
