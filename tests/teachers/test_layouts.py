import numpy as np
import pytest
import torch

from kfgs.teachers.layouts import write_npy_map


def features(seed: int, size: tuple[int, int, int] = (3, 4, 8)) -> torch.Tensor:  # [h, w, D]
    return torch.randn(size, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("rows", [3, 70])
def test_own_map_is_half_precision_rows_first(tmp_path, rows):
    want = features(0, (rows, 4, 8))
    path = write_npy_map(tmp_path / "new" / "a.npy", want.permute(2, 0, 1).contiguous().permute(1, 2, 0))
    got = np.load(path, mmap_mode="r")
    assert got.dtype == np.float16
    assert got.flags.c_contiguous
    assert np.array_equal(got, want.numpy().astype(np.float16))
    assert np.array_equal(np.load(write_npy_map(tmp_path / "b.npy", want.numpy())), got)


@pytest.mark.parametrize("value", [float("nan"), float("-inf"), 7e4])
def test_what_half_precision_cannot_hold_is_refused_and_leaves_no_file(tmp_path, value):
    bad = features(0, (40, 4, 8))
    bad[39, 1, 2] = value
    with pytest.raises(ValueError, match=r"finite values below 65504 .*, got others for 'a\.npy'; normalise"):
        write_npy_map(tmp_path / "a.npy", bad)
    with pytest.raises(ValueError, match=r"features: expected \[h, w, D\], got \(4, 8\)"):
        write_npy_map(tmp_path / "a.npy", bad[0])
    assert list(tmp_path.iterdir()) == []
