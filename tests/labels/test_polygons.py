import numpy as np
import pytest
import torch

from kfgs.evaluation.datasets import decode_rle, encode_rle, fill_polygon, fill_region


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


def test_regions_are_pixels_whose_centres_are_inside() -> None:
    assert fill_region([(0.6, 0.6), (3.4, 0.6), (3.4, 2.4), (0.6, 2.4)], (4, 5)).tolist() == _picture(
        "..... .##.. ..... ....."
    )
    assert int(fill_region([(0, 0), (5, 0), (5, 4), (0, 4)], (4, 5)).sum()) == 20


def test_run_lengths() -> None:
    mask = _picture(".##. .##. ....")
    assert decode_rle({"size": [3, 4], "counts": [3, 2, 1, 2, 4]}).tolist() == mask
    # by hand: 3, 2, 1, then 2 - 2 = 0 and 4 - 1 = 3, each plus "0"
    assert decode_rle({"size": [3, 4], "counts": "32103"}).tolist() == mask
    # 100 = 3 * 32 + 4: "T" (32 + 4 + 48), then "3"; -1 (difference) is 31 with its sign bit: "O"
    assert int(decode_rle({"size": [20, 10], "counts": "T3T3"}).sum()) == 100
    assert decode_rle({"size": [1, 9], "counts": "231O0"}).tolist() == [
        [False] * 2 + [True] * 3 + [False] + [True] * 2 + [False]
    ]


@pytest.mark.parametrize(
    ("segmentation", "message"),
    [
        ({"size": [3, 4], "counts": [3, 2]}, "add up to 3 x 4"),
        ({"size": [3, 4], "counts": [13, -1]}, "add up to 3 x 4"),
        ({"size": [3], "counts": [3]}, "size: expected"),
        ({"size": [10**9, 10**9], "counts": [10**18]}, "size: expected"),
        ({"size": [3, 4], "counts": "T"}, "compressed run lengths"),
        ({"size": [3, 4], "counts": "3 1"}, "compressed run lengths"),
    ],
)
def test_bad_run_lengths(segmentation: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        decode_rle(segmentation)


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (7, 2), (40, 30)])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_run_lengths_come_back(size: tuple[int, int], share: float) -> None:
    mask = torch.rand(size, generator=torch.Generator().manual_seed(size[0])) < share
    encoded = encode_rle(mask)
    assert encoded["size"] == list(size)
    assert sum(encoded["counts"]) == mask.numel()
    assert sum(encoded["counts"][1::2]) == int(mask.sum())
    assert all(count > 0 for count in encoded["counts"][1:])
    assert torch.equal(decode_rle(encoded), mask)


def test_run_lengths_begin_with_zeros_and_go_down_the_columns() -> None:
    assert encode_rle(torch.tensor([[1, 0, 0], [1, 1, 0]]).bool()) == {"size": [2, 3], "counts": [0, 2, 1, 1, 2]}
