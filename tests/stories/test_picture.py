"""The card's picture: the semantic and the colour cloud side by side in pyvista, and the labels that pass between them."""

import numpy as np

from kfgs import viz
from kfgs.labels import nearest_labels


def test_linked_clouds_and_their_transfer(fused, color, room):
    semantic = fused.label(room.classes)
    carried = nearest_labels(semantic.means, semantic.labels, color.means)
    names = room.classes.names
    plotter = viz.linked_clouds(semantic, color, camera=room.unseen[0], height=300, off_screen=True)
    left, right = np.split(plotter.screenshot(return_img=True), 2, axis=1)
    plotter.close()
    shown = {tuple(c) for c in viz.palette(semantic.labels.unique(), names).tolist()}
    flat = left.reshape(-1, 3).astype(int)
    near = [int((np.abs(flat - color).max(1) < 12).sum()) for color in shown]
    assert sum(count > 20 for count in near) >= 6  # the classes' colours are on the left
    assert right.std() > 20  # photographs' colours on the right
    assert np.abs(left.astype(int) - right).mean() > 10

    plotter = viz.show_transfer(fused, color, carried.distance, off_screen=True)
    lines = plotter.actors["transfer"].mapper.dataset
    plotter.close()
    source, target = lines.cell_data["source"], lines.cell_data["destination"]
    assert 200 < lines.n_cells <= 500
    assert np.array_equal(semantic.labels.numpy()[source], carried.labels.numpy()[target])
    ends = lines.points.reshape(-1, 2, 3)
    lift = ends[:, 0] - color.means.numpy()[target]
    np.testing.assert_allclose(lift, lift[:1].repeat(len(lift), 0), atol=1e-5)
    around = [names.index("wall"), names.index("ceiling")]
    assert np.isin(lines.cell_data["label"], around).mean() < 0.2 < 0.5 < np.isin(semantic.labels, around).mean()
