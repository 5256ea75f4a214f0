import itertools

import numpy as np
import pytest
from PIL import Image

from kfgs.viz import quality
from kfgs.viz.quality import plot_quality_storage

TABLE_1 = {"Feature 3DGS": (1175.2, 0.739), "just decouple": (59.4, 0.735), "decouple+ADC": (57.6, 0.779)}


@pytest.fixture
def figures(monkeypatch):
    drawn = []
    save = quality._save
    monkeypatch.setattr(quality, "_save", lambda figure, path: (drawn.append(figure), save(figure, path))[1])
    return drawn


def test_points_lie_where_they_should_with_their_names(tmp_path, figures):
    plot_quality_storage({"ours": (13.0, 0.766)}, tmp_path / "a.png", reference=TABLE_1)
    axes = figures[0].axes[0]
    measured, published = axes.collections
    np.testing.assert_allclose(measured.get_offsets(), [(13.0, 76.6)])
    np.testing.assert_allclose(published.get_offsets(), [(1175.2, 73.9), (59.4, 73.5), (57.6, 77.9)])
    assert len(published.get_facecolor()) == 0  # hollow
    assert axes.get_xscale() == "log"
    assert [text.get_text() for text in axes.texts] == ["ours", *TABLE_1]
    assert [text.get_text() for text in figures[0].legends[0].get_texts()] == ["measured", "reference"]
    picture = np.asarray(Image.open(tmp_path / "a.png").convert("L"))
    assert (picture < 100).sum() > 500


def test_names_of_close_points_do_not_overlap(tmp_path, figures):
    close = {f"method {i}": (50.0 + i, 0.7) for i in range(4)} | {"far": (3000.0, 0.5)}
    plot_quality_storage(close, tmp_path / "a.png")
    axes = figures[0].axes[0]
    boxes = [text.get_window_extent() for text in axes.texts]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
    frame = axes.get_window_extent()
    assert all(frame.x0 <= box.x0 and box.x1 <= frame.x1 for box in boxes)
    assert not figures[0].legends  # one kind of point needs none


def test_wrong_points_are_named(tmp_path):
    path = tmp_path / "a.png"
    with pytest.raises(ValueError, match="points: expected at least one name"):
        plot_quality_storage({}, path)
    for pair in ((13.0, 76.6), (0.0, 0.5), (float("inf"), 0.5), (13.0, float("nan"))):
        with pytest.raises(ValueError, match=r"points\['x'\]: expected \(MiB above 0, mIoU in \[0, 1\]\)"):
            plot_quality_storage({"x": pair}, path)
    assert list(tmp_path.iterdir()) == []
