import numpy as np
import oracles_langsplat as oracle
import pytest
from messages import tells

from kfgs.features.langsplat import MaskFeatures, parse_level

ALL = slice(None)


def masks(seed: int = 0, size: tuple[int, int] = (7, 10), count: int = 5):
    """Mask numbers [4, H, W] float32 with holes, and features [M, 6] of `count` masks."""
    generator = np.random.default_rng(seed)
    index = generator.integers(-1, count, (4, *size)).astype(np.float32)
    return index, generator.normal(size=(count, 6)).astype(np.float32)


def write(folder, stem, index, rows):
    np.save(folder / f"{stem}_s.npy", index)
    np.save(folder / f"{stem}_f.npy", rows)
    return folder / f"{stem}_s.npy"


@pytest.mark.parametrize("level", range(4))
@pytest.mark.parametrize(("stride", "size"), [(1, (7, 10)), (2, (4, 5)), (3, (2, 3)), (4, (2, 3)), (50, (1, 1))])
def test_a_cell_has_the_feature_of_the_mask_at_its_centre(tmp_path, level, stride, size):
    index, rows = masks(level)
    got = MaskFeatures(write(tmp_path, "a", index, rows), level, stride)
    assert got.shape == (*size, 6)
    assert np.array_equal(got[ALL, ALL], oracle.dense(index, rows, level, *size))


@pytest.mark.parametrize("kind", [np.int32, np.int64, np.float32, np.float64, np.int8])
def test_mask_numbers_may_be_of_any_kind(tmp_path, kind):
    index, rows = masks()
    got = MaskFeatures(write(tmp_path, "a", index.astype(kind), rows.astype(np.float16)), 3)
    assert got.dtype == np.float16
    assert np.array_equal(got[ALL, ALL], oracle.dense(index, rows.astype(np.float16), 3, 7, 10))


@pytest.mark.parametrize(
    ("size", "want"),
    [((360, 480), (360, 480)), ((361, 480), (181, 240)), ((1080, 1440), (360, 480)), ((3000, 17), (3000, 17))],
)
def test_without_a_stride_there_are_no_more_cells_than_in_the_papers_maps(tmp_path, size, want):
    file = write(tmp_path, "a", np.zeros((1, *size), np.int8), np.ones((1, 512), np.float32))
    assert MaskFeatures(file).shape == (*want, 512)
    assert MaskFeatures(file, 0, 1).shape == (*size, 512)


def test_no_mask_is_an_all_zero_feature_even_where_there_is_no_mask_at_all(tmp_path):
    index, rows = np.full((4, 3, 4), -1.0, np.float32), np.ones((0, 6), np.float32)
    assert not MaskFeatures(write(tmp_path, "a", index, rows))[ALL, ALL].any()


def test_only_what_is_asked_for_is_looked_at(tmp_path):
    index, rows = masks()
    index[0, 0, 0] = 99
    got = MaskFeatures(write(tmp_path, "a", index, rows))
    want = oracle.dense(np.minimum(index, 4), rows, 0, 7, 10)
    assert np.array_equal(got[slice(1, 7, 2), slice(1, 10, 3)], want[1::2, 1::3])


@pytest.mark.parametrize("value", [5, -2, 0.5, np.nan])
def test_numbers_of_no_mask_are_refused_by_name(tmp_path, value):
    index, rows = masks()
    index[0, 3, 4] = value
    file = write(tmp_path, "a", index, rows)
    with pytest.raises(ValueError, match=tells("a_s.npy:", "-1 to 4", "LangSplat")):
        MaskFeatures(file)[ALL, ALL]
    assert MaskFeatures(file, 1)[ALL, ALL].any()  # another level is whole


def test_what_is_no_pair_of_langsplat_is_refused(tmp_path):
    index, rows = masks()
    file = write(tmp_path, "a", index[0], rows)
    with pytest.raises(ValueError, match=tells("[4, H, W]", "got float32", "(7, 10)")):
        MaskFeatures(file)
    with pytest.raises(ValueError, match=tells("[M, D]", "b_f.npy", "got float32", "(6,)")):
        MaskFeatures(write(tmp_path, "b", index, rows[0]))
    with pytest.raises(ValueError, match=tells("level 2 (m)", "1 levels")):
        MaskFeatures(write(tmp_path, "c", index[:1], rows), 2)
    (tmp_path / "c_f.npy").unlink()
    with pytest.raises(FileNotFoundError, match=tells("c_f.npy", "got none")):
        MaskFeatures(tmp_path / "c_s.npy")
    with pytest.raises(ValueError, match=tells("stride:", "got 0")):
        MaskFeatures(file, 0, 0)


def test_a_level_has_a_number_and_a_name():
    assert [parse_level(name) for name in ("default", "s", "m", "l", 2)] == [0, 1, 2, 3, 2]
    with pytest.raises(ValueError, match=tells("level:", "0, 1, 2, 3", "'default', 's', 'm', 'l'", "got 'xl'")):
        parse_level("xl")
    with pytest.raises(ValueError, match=tells("level:", "got -1")):
        parse_level(-1)
