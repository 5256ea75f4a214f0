import pytest

from kfgs.labels.run_lengths import decode_rle


def _picture(rows: str) -> list[list[bool]]:
    return [[cell == "#" for cell in row] for row in rows.split()]


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
        ({"size": [3, 4], "counts": [3, 2]}, "another size"),
        ({"size": [3, 4], "counts": [13, -1]}, "counts: expected"),
        ({"size": [3], "counts": [3]}, "counts: expected"),
        ({"size": [10**9, 10**9], "counts": [10**18]}, "another size"),
        ({"size": [3, 4], "counts": "T"}, "Invalid RLE"),
        ({"size": [3, 4], "counts": "3 1"}, "Invalid RLE"),
    ],
)
def test_bad_run_lengths(segmentation: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        decode_rle(segmentation)
