import numpy as np
import pytest
import torch
from kfgs.viz.reports import codebook_rows, plot_codebook_growth, plot_codebook_report
from messages import tells
from PIL import Image

from kfgs.quant import fit_codebook
from kfgs.viz import palette, reports

WORDS = torch.eye(3)
NAMES = ["wall", "chair", "lamp"]
BOOK = torch.tensor([[0.0, 3, 4], [5, 0, 0], [0, 2, 0], [3, 4, 0], [0, 1, 1], [0.6, 0, 0.8]])  # classes 2 0 1 1 1 2
USAGE = torch.tensor([7, 90, 0, 40, 1000, 8])


def history(sizes):
    return [{"epoch": i, "size": k, "added": k // 2, "pruned": i, "coverage": 0.1 * i} for i, k in enumerate(sizes)]


def test_rows_are_by_class_then_by_usage():
    rows = codebook_rows(BOOK, WORDS, usage=USAGE, words=2)
    assert rows.codewords.tolist() == [1, 4, 3, 2, 5, 0]
    assert rows.labels.tolist() == [0, 1, 1, 1, 2, 2]
    assert codebook_rows(BOOK, WORDS).codewords.tolist() == [1, 2, 3, 4, 0, 5]
    unit = BOOK.double() / BOOK.double().norm(dim=1, keepdim=True)
    order = rows.codewords
    torch.testing.assert_close(rows.similarity, (unit @ unit.T)[order][:, order])


def test_words_are_the_nearest_classes_best_first():
    rows = codebook_rows(BOOK, WORDS, words=2)
    zero = rows.words[rows.codewords.tolist().index(0)]
    assert [label for label, _ in zero] == [2, 1]
    np.testing.assert_allclose([value for _, value in zero], [0.8, 0.6], rtol=1e-6)
    assert all(len(words) == 3 for words in codebook_rows(BOOK, WORDS, words=9).words)  # there are no more classes


def test_large_codebook_shows_its_most_used_rows(monkeypatch, tmp_path):
    monkeypatch.setattr(reports, "SHOWN", 4)
    assert sorted(codebook_rows(BOOK, WORDS, usage=USAGE).codewords.tolist()) == [1, 3, 4, 5]
    assert sorted(codebook_rows(BOOK, WORDS).codewords.tolist()) == [0, 1, 2, 3]
    figure = plot_codebook_report(BOOK, NAMES, WORDS, tmp_path / "a.png", usage=USAGE)
    assert figure.get_suptitle() == "Codebook: 6 codewords, the most used 4 shown"


def test_report_draws_what_the_rows_hold(tmp_path):
    figure = plot_codebook_report(
        BOOK, NAMES, WORDS, tmp_path / "report.png", usage=USAGE, history=history([3, 6]), words=2
    )
    rows = codebook_rows(BOOK, WORDS, usage=USAGE, words=2)
    upper, lower = figure.subfigs
    matrix, usage, words = upper.axes[:3]
    np.testing.assert_allclose(matrix.images[0].get_array(), rows.similarity)
    assert [tick.get_text() for tick in matrix.get_xticklabels()] == NAMES
    np.testing.assert_allclose(matrix.get_xticks(), [0, 2, 4.5])  # the middle of each class
    ends = [bar.get_x() + bar.get_width() for bar in usage.patches]
    assert ends == [90, 1000, 40, 0.5, 8, 7]
    assert [text.get_text() for text in usage.texts] == ["unused"]
    np.testing.assert_allclose([bar.get_facecolor()[:3] for bar in usage.patches], palette(rows.labels, NAMES) / 255)
    texts = [text.get_text() for text in words.texts]
    assert texts[0::3] == ["1", "4", "3", "2", "5", "0"]
    assert texts[2::3][-1] == "lamp 0.80, chair 0.60"
    assert [axes.get_title() for axes in lower.axes] == ["size K", "codewords added and pruned (dashed)", "coverage"]
    picture = np.asarray(Image.open(tmp_path / "report.png").convert("RGB"))
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100


def test_report_without_usage_and_history_has_two_panels(tmp_path):
    figure = plot_codebook_report(BOOK[:1], NAMES, WORDS, tmp_path / "a.png")
    titles = [axes.get_title(loc=loc) for axes in figure.subfigs[0].axes for loc in ("center", "left")]
    assert [title for title in titles if title] == [
        "similarity of codewords, by class",
        "codeword: nearest words (cosine)",
    ]


def test_growth_has_a_curve_per_scene(tmp_path):
    scenes = {"room 0": history([3, 6, 9]), "office 3": history([4, 4])}
    figure = plot_codebook_growth(scenes, tmp_path / "growth.png")
    size, turnover, coverage = figure.axes
    np.testing.assert_allclose(size.lines[0].get_xydata(), [(0, 3), (1, 6), (2, 9)])
    np.testing.assert_allclose(size.lines[1].get_xydata(), [(0, 4), (1, 4)])
    assert [line.get_linestyle() for line in turnover.lines] == ["-", "--", "-", "--"]  # added, pruned of each
    assert size.get_ylim()[0] == turnover.get_ylim()[0] == coverage.get_ylim()[0] == 0
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["room 0", "office 3"]
    assert len({tuple(line.get_color()) for line in size.lines}) == 2


def test_growth_of_a_fit_is_that_of_its_history():
    book = fit_codebook([torch.eye(3)[None]])
    drawn = [
        plot_codebook_growth(one).axes[0].lines[0].get_xydata() for one in (book, {"room": book}, book.report.history)
    ]
    np.testing.assert_array_equal(drawn[0], drawn[2])
    np.testing.assert_array_equal(drawn[1], drawn[2])


def test_wrong_input_is_named(tmp_path):
    path = tmp_path / "a.png"
    with pytest.raises(ValueError, match=tells("embeddings:", "[C, D]", "D = 3", "got (3, 2)")):
        plot_codebook_report(BOOK, NAMES, WORDS[:, :2], path)
    with pytest.raises(ValueError, match=tells("names:", "expected 3", "got 1")):
        plot_codebook_report(BOOK, ["wall"], WORDS, path)
    with pytest.raises(ValueError, match=tells("usage:", "[K]", "K = 6", "got (2,)")):
        plot_codebook_report(BOOK, NAMES, WORDS, path, usage=USAGE[:2])
    with pytest.raises(ValueError, match=tells("words:", "got 0")):
        codebook_rows(BOOK, WORDS, words=0)
    with pytest.raises(ValueError, match=tells("histories:", "got none")):
        plot_codebook_growth({}, path)
    with pytest.raises(ValueError, match=tells("histories['a']:", "epoch", "size")):
        plot_codebook_growth({"a": [{"loss": 1.0}]}, path)
    with pytest.raises(ValueError, match=tells("history:", "epoch", "size")):
        plot_codebook_report(BOOK, NAMES, WORDS, path, history=[{"loss": 1.0}])
    assert list(tmp_path.iterdir()) == []
