import itertools
import sys

import numpy as np
import pytest
import torch
from kfgs.viz.figures import new_figure
from messages import tells
from PIL import Image

from kfgs.labels import Selection
from kfgs.quant import fit_codebook
from kfgs.viz import (
    palette,
    plot_codebook_growth,
    plot_codebook_history,
    plot_confusion,
    plot_distances,
    plot_iou,
    plot_largest_confusions,
    plot_quality_storage,
    plot_scores,
    plot_training,
)

HISTORY = [{"epoch": i, "size": 8 + 2 * i, "loss": 1 / (i + 1), "coverage": i / 9, "note": "text"} for i in range(10)]


def picture(path):
    return np.asarray(Image.open(path).convert("RGB"))


def test_codebook_panels_hold_the_history(tmp_path):
    panels = plot_codebook_history(HISTORY, tmp_path / "codebook.png").axes
    assert [axes.get_title() for axes in panels] == ["size", "loss", "coverage"]
    np.testing.assert_array_equal(panels[0].lines[0].get_xydata(), [(i, 8 + 2 * i) for i in range(10)])
    assert panels[0].get_ylim()[0] == 0
    assert panels[0].get_xlabel() == "epoch"
    assert len(np.unique(picture(tmp_path / "codebook.png").reshape(-1, 3), axis=0)) > 20


def test_codebook_panels_of_an_adaptive_fit_have_no_loss(tmp_path):
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(5, 16, generator=generator), dim=1)
    history = fit_codebook([directions[torch.randint(0, 5, (20, 30), generator=generator)]]).report.history
    panels = plot_codebook_history(history, tmp_path / "codebook.png").axes
    assert [axes.get_title() for axes in panels] == ["size", "added", "mean_similarity", "coverage"]
    assert panels[0].figure.get_suptitle() == "Codebook; pruned is always 0"
    np.testing.assert_array_equal(panels[0].lines[0].get_xydata(), [(row["epoch"], row["size"]) for row in history])
    assert len(history) > 2
    assert history[-1]["size"] == 5


def test_training_starts_with_the_loss_and_skips_gaps(tmp_path):
    rows = [{"step": 0, "count": 5, "loss": 0.5}, {"step": 100, "count": 7, "loss": 0.25, "psnr": 20.0}]
    panels = plot_training(rows, tmp_path / "training.png").axes
    assert [axes.get_title() for axes in panels] == ["loss", "count", "psnr"]
    np.testing.assert_array_equal(panels[2].lines[0].get_xydata(), [(100, 20)])


def test_the_clock_is_drawn_only_when_asked_for(tmp_path):
    rows = [{"step": i, "count": 5, "seconds": 0.1 * i, "loss": 0.5} for i in range(3)]
    figures = [plot_training(rows), plot_training(rows, leave_out=()), plot_training(rows, leave_out=["count"])]
    titles = [[axes.get_title() for axes in figure.axes] for figure in figures]
    assert titles == [["loss", "count"], ["loss", "count", "seconds"], ["loss", "seconds"]]
    with pytest.raises(ValueError, match=tells("history:", "numbers", "['step']")):
        plot_training(rows, tmp_path / "a.png", leave_out=["count", "seconds", "loss"])


def test_confusion_is_in_per_cent_of_the_true_class(tmp_path):
    matrix = torch.tensor([[3, 1, 0], [0, 0, 0], [2, 0, 2]])
    axes = plot_confusion(matrix, ["wall", "unused?", "rug"], tmp_path / "confusion.png").axes[0]
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["wall", "unused?", "rug"]  # 1 was predicted once
    np.testing.assert_allclose(axes.images[0].get_array(), [[75, 25, 0], [0, 0, 0], [50, 0, 50]])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("predicted class", "true class")
    small = plot_confusion(matrix[[0, 2]][:, [0, 2]].numpy(), ["wall", "rug"], tmp_path / "small.png")
    np.testing.assert_allclose(small.axes[0].images[0].get_array(), [[100, 0], [50, 50]])


def test_largest_confusions_are_shares_of_all_pixels(tmp_path):
    matrix, names = torch.tensor([[50, 6, 0], [1, 30, 0], [0, 9, 0]]), ["wall", "rug", "lamp"]
    axes = plot_largest_confusions(matrix, names, tmp_path / "a.png", misses=torch.tensor([4, 0, 0]), most=3).axes[0]
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["lamp → rug", "wall → rug", "wall → no class"]
    np.testing.assert_allclose([bar.get_width() for bar in axes.patches], [9, 6, 4])
    colors = palette(np.array([2, 0, 0]), names) / 255
    np.testing.assert_allclose([bar.get_facecolor()[:3] for bar in axes.patches], colors)
    np.testing.assert_allclose(
        axes.collections[0].get_facecolor()[:, :3], palette(np.array([1, 1, -1]), names) / 255, atol=1e-6
    )
    assert [text.get_text() for text in axes.texts][1] == "6.00 %, 10 % of wall"
    assert axes.get_title() == "Largest confusions: 19.0 of 20.0 % wrong pixels"
    perfect = plot_largest_confusions(torch.eye(2), ["a", "b"], tmp_path / "b.png").axes[0]
    assert not perfect.patches
    with pytest.raises(ValueError, match=tells("matrix:", "zeros")):
        plot_largest_confusions(torch.zeros(2, 2), ["a", "b"])


def test_classes_that_never_occur_are_left_out(tmp_path):
    matrix = torch.zeros(4, 4, dtype=torch.int64)
    matrix[1, 1], matrix[3, 1] = 4, 6
    figure = plot_confusion(matrix, list("abcd"), tmp_path / "confusion.png")
    assert [tick.get_text() for tick in figure.axes[0].get_xticklabels()] == ["b", "d"]


def test_misses_are_a_last_column_and_count_in_their_row(tmp_path):
    matrix, misses = torch.tensor([[3, 1, 0], [0, 0, 0], [0, 0, 0]]), torch.tensor([4, 0, 5])
    axes = plot_confusion(matrix, ["wall", "rug", "lamp"], tmp_path / "a.png", misses=misses).axes[0]
    np.testing.assert_allclose(axes.images[0].get_array(), [[37.5, 12.5, 0, 50], [0, 0, 0, 0], [0, 0, 0, 100]])
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["wall", "rug", "lamp", "no class"]
    figure = plot_confusion(matrix, ["wall", "rug", "lamp"], tmp_path / "b.png", misses=torch.zeros(3))
    assert figure.axes[0].images[0].get_array().shape == (2, 2)


def test_iou_bars_are_sorted_and_coloured_by_class(tmp_path):
    iou = torch.tensor([0.5, float("nan"), 0.9, 0.25])
    theirs = torch.tensor([0.4, 0.1, float("nan"), 0.6])
    axes = plot_iou(iou, ["a", "b", "c", "d"], tmp_path / "iou.png", reference=theirs, reference_name="teacher").axes[0]
    np.testing.assert_allclose([bar.get_width() for bar in axes.patches], [90, 50, 25])
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["c", "a", "d"]
    assert axes.get_ylim()[0] > axes.get_ylim()[1]  # the best on top
    colors = palette(np.array([2, 0, 3]), list("abcd")) / 255
    np.testing.assert_allclose([bar.get_facecolor()[:3] for bar in axes.patches], colors)
    np.testing.assert_allclose(axes.lines[-1].get_xdata(), 55, rtol=1e-6)  # (90 + 50 + 25) / 3
    np.testing.assert_allclose(np.ma.getdata(axes.collections[0].get_offsets()), [(np.nan, 0), (40, 1), (60, 2)])
    entries = [text.get_text() for text in axes.figure.legends[0].get_texts()]
    assert entries == ["mIoU 55.0", "teacher (mIoU 36.7)"]
    assert "do not occur: 1 of 4" in axes.get_xlabel()
    assert len(np.unique(picture(tmp_path / "iou.png").reshape(-1, 3), axis=0)) > 20


def test_counts_start_at_zero_with_room_above(tmp_path):
    rows = [{"step": i, "loss": 1.0, "count": 18_000 + i, "pruned": 0} for i in range(5)]
    _, count = plot_training(rows, tmp_path / "a.png").axes
    assert count.get_ylim() == (0, pytest.approx(1.06 * 18_004))
    (pruned,) = plot_training([{"step": i, "pruned": 0} for i in range(5)], tmp_path / "b.png").axes
    assert pruned.get_ylim() == (0, pytest.approx(1.06))  # not from -0.05 to 0.05
    assert all(float(tick).is_integer() for tick in pruned.get_yticks())


def test_global_state_of_matplotlib_is_untouched(tmp_path):
    before = sys.modules.get("matplotlib.pyplot")
    plot_training(HISTORY, tmp_path / "a.png")
    assert sys.modules.get("matplotlib.pyplot") is before


def test_wrong_input_is_named(tmp_path):
    with pytest.raises(ValueError, match=tells("history:", "got none")):
        plot_training([], tmp_path / "a.png")
    with pytest.raises(ValueError, match=tells("history:", "numbers", "['epoch', 'note']")):
        plot_codebook_history([{"epoch": 0, "note": "x"}], tmp_path / "a.png")
    with pytest.raises(ValueError, match=tells("matrix:", "[C, C]", "got (2, 3)")):
        plot_confusion(torch.zeros(2, 3), ["a", "b"], tmp_path / "a.png")
    with pytest.raises(ValueError, match=tells("names:", "expected 2", "matrix", "got 1")):
        plot_confusion(torch.zeros(2, 2), ["a"], tmp_path / "a.png")
    with pytest.raises(ValueError, match=tells("misses:", "[C]", "C = 2", "got (3,)")):
        plot_confusion(torch.zeros(2, 2), ["a", "b"], tmp_path / "a.png", misses=torch.zeros(3))
    with pytest.raises(ValueError, match=tells("names:", "expected 2", "iou", "got 1")):
        plot_iou(torch.zeros(2), ["a"], tmp_path / "a.png")
    with pytest.raises(ValueError, match=tells("iou:", "[0, 1]", "NaN", "got 76.6", "100")):
        plot_iou(torch.tensor([76.6]), ["a"], tmp_path / "a.png")
    with pytest.raises(ValueError, match=tells("reference:", "[C]", "C = 1", "got (2,)")):
        plot_iou(torch.zeros(1), ["a"], tmp_path / "a.png", reference=torch.zeros(2))
    with pytest.raises(ValueError, match=tells("iou:", "got 1", "NaN")):
        plot_iou(torch.tensor([torch.nan]), ["a"], tmp_path / "a.png")
    with pytest.raises(ValueError, match=tells("path:", ".png", "got 'a.pdf'")):
        plot_training(HISTORY, tmp_path / "a.pdf")
    assert list(tmp_path.iterdir()) == []


def test_missing_matplotlib_names_the_install_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=tells("pip install matplotlib")):
        plot_training(HISTORY, tmp_path / "a.png")


TABLE_1 = {"Feature 3DGS": (1175.2, 0.739), "just decouple": (59.4, 0.735), "decouple+ADC": (57.6, 0.779)}


def test_points_lie_where_they_should_with_their_names(tmp_path):
    figure = plot_quality_storage({"ours": (13.0, 0.766)}, tmp_path / "a.png", reference=TABLE_1)
    axes = figure.axes[0]
    measured, published = axes.collections
    np.testing.assert_allclose(measured.get_offsets(), [(13.0, 76.6)])
    np.testing.assert_allclose(published.get_offsets(), [(1175.2, 73.9), (59.4, 73.5), (57.6, 77.9)])
    assert len(published.get_facecolor()) == 0  # hollow
    assert axes.get_xscale() == "log"
    assert [text.get_text() for text in axes.texts] == ["ours", *TABLE_1]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["measured", "reference"]
    picture = np.asarray(Image.open(tmp_path / "a.png").convert("L"))
    assert (picture < 100).sum() > 500


def test_names_of_close_points_do_not_overlap(tmp_path):
    close = {f"method {i}": (50.0 + i, 0.7) for i in range(4)} | {"far": (3000.0, 0.5)}
    figure = plot_quality_storage(close, tmp_path / "a.png")
    axes = figure.axes[0]
    boxes = [text.get_window_extent() for text in axes.texts]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
    frame = axes.get_window_extent()
    assert all(frame.x0 <= box.x0 and box.x1 <= frame.x1 for box in boxes)
    assert not figure.legends  # one kind of point needs none


def test_wrong_points_are_named(tmp_path):
    path = tmp_path / "a.png"
    with pytest.raises(ValueError, match=tells("points:", "got none")):
        plot_quality_storage({}, path)
    for pair in ((13.0, 76.6), (0.0, 0.5), (float("inf"), 0.5), (13.0, float("nan"))):
        with pytest.raises(ValueError, match=tells("points['x']:", "MiB above 0", "mIoU in [0, 1]")):
            plot_quality_storage({"x": pair}, path)
    assert list(tmp_path.iterdir()) == []


GROWTH = [row | {"added": 2, "pruned": 0} for row in HISTORY]
MATRIX, IOU, NAMES = torch.eye(2), torch.tensor([0.5, 1.0]), ["wall", "rug"]
DRAW = {
    "codebook_history": (3, lambda **to: plot_codebook_history(HISTORY, **to)),
    "training": (3, lambda **to: plot_training(HISTORY, **to)),
    "growth": (3, lambda **to: plot_codebook_growth({"room": GROWTH}, **to)),
    "growth of one": (3, lambda **to: plot_codebook_growth(GROWTH, **to)),
    "confusion": (1, lambda **to: plot_confusion(MATRIX, NAMES, **to)),
    "iou": (1, lambda **to: plot_iou(IOU, NAMES, reference=IOU, **to)),
    "quality": (1, lambda **to: plot_quality_storage({"ours": (13.0, 0.7)}, reference=TABLE_1, **to)),
    "scores": (1, lambda **to: plot_scores(Selection.of(torch.tensor([True, False])), **to)),
    "distances": (1, lambda **to: plot_distances(np.array([0.1, 0.2]), 0.15, **to)),
}


@pytest.mark.parametrize("name", DRAW)
def test_plots_return_their_figure_and_write_only_when_told(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    panels, draw = DRAW[name]
    assert len(draw().axes) >= panels
    assert list(tmp_path.iterdir()) == []
    figure = draw(path="plot.png")
    assert picture("plot.png").shape[1] > 300
    assert figure.axes[0].has_data()


@pytest.mark.parametrize("name", DRAW)
def test_plots_draw_into_the_axes_that_they_are_given(name, tmp_path):
    panels, draw = DRAW[name]
    figure = new_figure(12, 4)
    axes = figure.subplots(1, panels + 1)
    assert draw(ax=axes[0] if panels == 1 else axes[:panels]) is figure
    assert all(one.has_data() for one in axes[:panels])
    assert not axes[panels].has_data()
    if panels > 1:
        with pytest.raises(ValueError, match=tells("ax", "at least 3", "got 2")):
            draw(ax=axes[:2])


def test_a_history_without_turnover_is_drawn():
    assert plot_codebook_growth(HISTORY).axes[0].has_data()
