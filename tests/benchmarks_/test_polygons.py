import numpy as np
import pytest
import torch
from published.polygons import fill_polygon


def _picture(rows: str) -> list[list[bool]]:
    return [[cell == "#" for cell in row] for row in rows.split()]


def test_a_rectangle_has_its_border() -> None:
    mask = fill_polygon([(2, 1), (6, 1), (6, 4), (2, 4)], (7, 9))
    assert int(mask.sum()) == 5 * 4
    assert bool(mask[1:5, 2:7].all())


# Golden: cv2.fillPoly of OpenCV 5.0.0 (opencv-python-headless 5.0.0.93), int32 points, one contour, 12 x 16 pixels.
OPENCV = {
    ((1, 2), (14, 1), (9, 10), (5, 4)): """
        ................ ........#######. .#############.. ...###########.. .....########... ......#######...
        ......######.... .......#####.... ........###..... ........###..... .........#...... ................""",
    ((0, 0), (15, 11), (15, 0), (0, 11)): """
        #..............# ###..........### ####........#### #####......##### #######..####### ################
        ################ #######..####### #####......##### ####........#### ###..........### #..............#""",
    ((3, 3), (3, 3), (9, 6)): """
        ................ ................ ................ ...##........... .....##......... .......##.......
        .........#...... ................ ................ ................ ................ ................""",
}


@pytest.mark.parametrize("points", OPENCV)
def test_polygons_are_opencvs(points: tuple[tuple[int, int], ...]) -> None:
    assert fill_polygon(points, (12, 16)).tolist() == _picture(OPENCV[points])


def test_fractions_are_cut_off_and_corners_outside_are_clipped() -> None:
    inside = fill_polygon([(1, 1), (3, 1), (3, 3), (1, 3)], (5, 5))
    assert torch.equal(fill_polygon([(1.9, 1.2), (3.7, 1.1), (3.2, 3.9), (1.5, 3.5)], (5, 5)), inside)
    assert bool(fill_polygon([(-9, -9), (99, -9), (99, 99), (-9, 99)], (5, 5)).all())
    assert not fill_polygon([(20, 20), (30, 20), (30, 30)], (5, 5)).any()


def test_the_inside_is_that_of_the_even_odd_rule() -> None:
    """Against a ray counted edge by edge, for pixels off the boundary."""
    generator = np.random.default_rng(3)
    for _ in range(20):
        points = generator.integers(0, 30, (7, 2))
        mask, inside = fill_polygon(points, (30, 30)), np.zeros((30, 30), bool)
        for y in range(30):
            for x in range(30):
                for (x0, y0), (x1, y1) in zip(points, np.roll(points, -1, 0), strict=True):
                    if (y0 <= y) != (y1 <= y) and x < x0 + (y - y0) * (x1 - x0) / (y1 - y0):
                        inside[y, x] = not inside[y, x]
        assert not (torch.from_numpy(inside) & ~mask).any()  # nothing inside is missing
        extra = (mask & ~torch.from_numpy(inside)).nonzero().tolist()  # and what is added lies on an edge
        for y, x in extra:
            gaps = []
            for a, b in zip(points, np.roll(points, -1, 0), strict=True):
                along = np.clip(np.dot((x, y) - a, b - a) / max(np.dot(b - a, b - a), 1), 0, 1)
                gaps.append(np.abs((x, y) - (a + along * (b - a))).max())
            assert min(gaps) <= 0.5
