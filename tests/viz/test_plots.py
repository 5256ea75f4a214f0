import numpy as np
import pytest
import torch
from messages import refused
from PIL import Image

from kfgs.labels import Selection
from kfgs.labels.selection import select_by_similarity
from kfgs.viz import palette, plot_history, plot_iou, plot_scores

HISTORY = [{"epoch": i, "size": 8 + 2 * i, "loss": 1 / (i + 1), "coverage": i / 9, "note": "text"} for i in range(10)]


def picture(path):
    return np.asarray(Image.open(path).convert("RGB"))


def test_panels_hold_the_history_loss_or_size_first(tmp_path):
    panels = plot_history(HISTORY, tmp_path / "codebook.png").axes
    assert [axes.get_title() for axes in panels] == ["size", "loss", "coverage"]
    np.testing.assert_array_equal(panels[0].lines[0].get_xydata(), [(i, 8 + 2 * i) for i in range(10)])
    assert panels[0].get_ylim()[0] == 0
    assert panels[0].get_xlabel() == "epoch"
    assert len(np.unique(picture(tmp_path / "codebook.png").reshape(-1, 3), axis=0)) > 20


def test_iou_bars_are_sorted_and_coloured_by_class(tmp_path):
    iou = torch.tensor([0.5, float("nan"), 0.9, 0.25])
    theirs = torch.tensor([0.4, 0.1, float("nan"), 0.6])
    figure = plot_iou(iou, ["a", "b", "c", "d"], tmp_path / "iou.png", reference=theirs, reference_name="teacher")
    axes = figure.axes[0]
    np.testing.assert_allclose([bar.get_width() for bar in axes.patches], [90, 50, 25])
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["c", "a", "d"]
    assert axes.get_ylim()[0] > axes.get_ylim()[1]  # the best on top
    colors = palette(np.array([2, 0, 3]), ["a", "b", "c", "d"]) / 255
    np.testing.assert_allclose([bar.get_facecolor()[:3] for bar in axes.patches], colors)
    entries = [text.get_text() for text in figure.legends[0].get_texts()]
    assert entries == ["mIoU 55.0", "teacher (mIoU 36.7)"]
    assert "3 of 4 classes occur" in axes.get_xlabel()


def heaps(n=2000, share=0.05):
    """Cosines in two heaps, around 0.1 and 0.6, and which of them are in the upper one."""
    g = torch.Generator().manual_seed(0)
    upper = torch.arange(n) < share * n
    return 0.1 + 0.5 * upper + 0.05 * torch.randn(n, generator=g), upper


def bars(axes, part):
    """The bars of one call: left edges, widths, heights."""
    return np.array([(bar.get_x(), bar.get_width(), bar.get_height()) for bar in axes.containers[part]]).T


def test_bars_hold_every_score_and_meet_at_gamma(tmp_path):
    scores, upper = heaps()
    selection = select_by_similarity(scores)
    assert selection.mask.equal(upper)
    axes = plot_scores(selection, tmp_path / "scores.png").axes[0]
    (left, width, rest), (_, _, chosen) = bars(axes, 0), bars(axes, 1)
    assert (rest.sum(), chosen.sum()) == (1900, 100)
    assert left[chosen > 0].min() >= selection.threshold - 1e-12
    assert (left + width)[rest > 0].max() <= selection.threshold + 1e-12
    for i in range(len(left)):  # what each bar holds
        inside = (scores.double() >= left[i]) & (scores.double() < left[i] + width[i])
        assert abs(int(inside.sum()) - rest[i] - chosen[i]) <= 1
    (line,) = axes.lines
    assert list(line.get_xdata()) == [selection.threshold] * 2
    entries = {text.get_text() for text in axes.get_legend().get_texts()}
    assert entries == {"not selected 1,900", "selected 100", f"gamma = {selection.threshold:.4g}"}
    assert axes.get_title().startswith("100 of 2,000 selected (5.0%)\ngap at ")
    assert axes.get_yscale() == "log"
    shown = picture(tmp_path / "scores.png").reshape(-1, 3)
    for color in ([0, 114, 178], [191, 191, 191]):  # the selected stand out, the rest recede
        assert (shown == color).all(axis=1).sum() > 500


def test_several_histories_have_a_line_each_without_gaps_the_clock_and_what_is_always_zero():
    row = {"step": 0, "count": 5, "loss": 0.5, "seconds": 1.0, "pruned": 0}
    one = [row, row | {"step": 100, "count": 7, "psnr": 20.0}]
    figure = plot_history({"room": one, "office": [row | {"count": 3}]})
    assert [axes.get_title() for axes in figure.axes] == ["loss", "count", "psnr"]
    assert [line.get_ydata().tolist() for line in figure.axes[1].lines] == [[5, 7], [3]]
    np.testing.assert_array_equal(figure.axes[2].lines[0].get_xydata(), [(100, 20)])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["room", "office"]


@pytest.mark.parametrize("gamma", [-3.0, 0.35, 2.0, None])
def test_no_score_is_lost(gamma):
    scores = heaps()[0]
    mask = scores > (gamma or 0)
    axes = plot_scores(Selection(mask, scores, gamma)).axes[0]
    assert (bars(axes, 0)[2].sum(), bars(axes, 1)[2].sum()) == (int((~mask).sum()), int(mask.sum()))
    assert axes.get_yscale() == ("log" if gamma == 0.35 else "linear")  # only where one part would not be seen


def test_wrong_input_is_named(tmp_path):
    path = tmp_path / "a.png"
    for rows in ([], [{"epoch": 0, "note": "x"}]):
        refused(lambda rows=rows: plot_history(rows, path), "history:", "numbers")
    refused(lambda: plot_iou(torch.zeros(2), ["a"], path), "names:", "[C]", "C = 2", "got (1,)")
    refused(lambda: plot_iou(torch.tensor([76.6]), ["a"], path), "iou:", "[0, 1]", "NaN", "got 76.6", "100")
    refused(lambda: plot_iou(torch.zeros(1), ["a"], path, reference=torch.zeros(2)), "reference:", "C = 1", "got (2,)")
    refused(lambda: plot_iou(torch.tensor([torch.nan]), ["a"], path), "iou:", "got 1", "NaN")
    refused(lambda: plot_scores(Selection.of(torch.zeros(0, dtype=torch.bool)), path), "selection:", "got none")
    refused(lambda: plot_history(HISTORY, tmp_path / "a.pdf"), "path:", ".png", "got 'a.pdf'")
    assert list(tmp_path.iterdir()) == []
