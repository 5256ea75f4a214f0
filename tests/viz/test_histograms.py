import numpy as np
import pytest
import torch
from kfgs.viz.histograms import score_bins
from matplotlib.axes import Axes
from messages import tells
from PIL import Image

from kfgs.labels import Selection, select_by_similarity
from kfgs.viz import palette, plot_distances, plot_scores


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
    assert (left + width)[rest > 0].max() == pytest.approx(left[chosen > 0].min(), abs=0.5)
    assert left[chosen > 0].min() >= selection.threshold - 1e-12
    assert (left + width)[rest > 0].max() <= selection.threshold + 1e-12
    for i in range(len(left)):  # what each bar holds, one by one
        inside = (scores.double() >= left[i]) & (scores.double() < left[i] + width[i])
        assert abs(int(inside.sum()) - rest[i] - chosen[i]) <= 1
    (line,) = axes.lines
    assert list(line.get_xdata()) == [selection.threshold] * 2
    entries = {text.get_text() for text in axes.get_legend().get_texts()}
    assert entries == {"not selected 1,900", "selected 100", f"gamma = {selection.threshold:.4g}"}
    assert axes.get_title().startswith("100 of 2,000 selected (5.0%)\ngap at ")
    assert axes.get_yscale() == "log"
    shown = np.asarray(Image.open(tmp_path / "scores.png").convert("RGB")).reshape(-1, 3)
    for color in ([0, 114, 178], [191, 191, 191]):  # the selected stand out, the rest recede
        assert (shown == color).all(axis=1).sum() > 500


def test_counts_are_logarithmic_only_where_they_must_be(tmp_path):
    figures = [plot_scores(select_by_similarity(heaps(share=share)[0], threshold=0.35)) for share in (0.3, 0.01)]
    figures.append(plot_scores(Selection(torch.zeros(50, dtype=torch.bool), torch.linspace(0, 1, 50), 1.0)))
    assert [figure.axes[0].get_yscale() for figure in figures] == ["linear", "log", "linear"]


@pytest.mark.parametrize("gamma", [-3.0, 0.35, 2.0, None])
def test_no_score_is_lost_and_gamma_is_an_edge(gamma):
    scores = heaps()[0].double().numpy()
    edges = score_bins(scores, gamma)
    assert np.histogram(scores, edges)[0].sum() == 2000
    np.testing.assert_allclose(np.diff(edges), np.diff(edges)[0])
    assert 80 <= len(edges) - 1 <= 84
    assert gamma is None or gamma in edges


def test_equal_scores_are_drawn(tmp_path):
    axes = plot_scores(Selection.of(torch.ones(7, dtype=torch.bool), "all"), tmp_path / "a.png").axes[0]
    assert bars(axes, 1)[2].sum() == 7
    assert len(axes.lines) == 0  # no threshold
    assert axes.get_title() == "7 of 7 selected (100.0%)\nall"


def test_classes_of_the_selected_have_lines(tmp_path):
    scores, upper = heaps()
    labels = torch.where(upper, 4, 2)
    labels[:3] = -1  # selected, of no class
    labels[1900:] = 4  # of the class, not selected
    axes = plot_scores(select_by_similarity(scores), tmp_path / "a.png", labels=labels).axes[0]
    entries = [text.get_text() for text in axes.get_legend().get_texts()]
    assert [entry for entry in entries if "class" in entry] == ["no class: 3 of 3", "class 4: 97 of 197"]
    outline = axes.patches[-2]
    assert outline.get_data().values.sum() == 197
    np.testing.assert_allclose(outline.get_edgecolor()[:3], palette(np.array([4]))[0] / 255)


def test_only_the_classes_with_the_most_selected_have_lines(tmp_path):
    labels = torch.arange(9).repeat_interleave(torch.arange(9, 0, -1))
    everything = Selection.of(torch.ones(len(labels), dtype=torch.bool))
    figure = plot_scores(everything, tmp_path / "a.png", labels=labels)
    entries = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert [entry for entry in entries if "class" in entry] == [f"class {k}: {9 - k} of {9 - k}" for k in range(5)]


def test_wrong_input_is_named(tmp_path):
    with pytest.raises(ValueError, match=tells("selection:", "got none")):
        plot_scores(Selection.of(torch.zeros(0, dtype=torch.bool)), tmp_path / "a.png")
    some = Selection.of(torch.ones(4, dtype=torch.bool))
    with pytest.raises(ValueError, match=tells("labels:", "[N]", "N = 4", "selection.scores", "got (3,)")):
        plot_scores(some, tmp_path / "a.png", labels=torch.zeros(3, dtype=torch.int64))
    with pytest.raises(TypeError, match=tells("labels:", "got float32")):
        plot_scores(some, tmp_path / "a.png", labels=torch.zeros(4))
    with pytest.raises(ValueError, match=tells("path:", ".png", "got 'a.pdf'")):
        plot_scores(some, tmp_path / "a.pdf")
    assert list(tmp_path.iterdir()) == []


def test_histogram_counts_every_distance_and_marks_lambda(tmp_path, monkeypatch):
    bars, lines, named = [], [], []
    real_bar, real_line = Axes.bar, Axes.axvline
    monkeypatch.setattr(
        Axes,
        "bar",
        lambda self, x, h, *a, **k: (bars.append((x, h)), named.append(k["label"]), real_bar(self, x, h, *a, **k))[2],
    )
    monkeypatch.setattr(Axes, "axvline", lambda self, x, **k: (lines.append(x), real_line(self, x, **k))[1])
    distances = torch.cat([torch.logspace(-3, 0, 300), torch.zeros(2), torch.full((5,), float("inf"))])
    plot_distances(distances, 0.1, tmp_path / "distances.png")
    assert lines == [0.1]
    assert named == ["within lambda", "beyond"]
    (near_x, near), (far_x, far) = bars
    assert near.sum() + far.sum() == 302
    assert near_x.max() < 0.1 <= far_x.min()
    assert near.sum() == int((distances < 0.1).sum())  # bins meet at lambda
    picture = np.asarray(Image.open(tmp_path / "distances.png").convert("RGB")).reshape(-1, 3)
    for color in ([0, 114, 178], [191, 191, 191]):
        assert (picture == color).all(axis=1).sum() > 500


def test_wrong_distances_are_named(tmp_path):
    for values in ([], [0.1, -0.1], [float("nan")]):
        with pytest.raises(ValueError, match=tells("distances:", "NaN")):
            plot_distances(np.array(values), 0.1, tmp_path / "a.png")
    with pytest.raises(ValueError, match=tells("distance:", "got 0.0")):
        plot_distances(np.ones(3), 0.0, tmp_path / "a.png")
