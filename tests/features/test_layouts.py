import os

import numpy as np
import pytest
import torch
from messages import tells
from safetensors.torch import save_file

from kfgs.features.layouts import (
    LANGSPLAT,
    Reading,
    find_axes,
    layout_of,
    open_map,
    read_rows,
    write_npy_map,
)


def features(seed: int, size: tuple[int, int, int] = (3, 4, 8)) -> torch.Tensor:  # [h, w, D]
    return torch.randn(size, generator=torch.Generator().manual_seed(seed))


def whole(stored) -> torch.Tensor:  # [h, w, D]
    return torch.cat(list(read_rows(stored)))


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
    with pytest.raises(ValueError, match=tells("features:", "65504", "'a.npy'")):
        write_npy_map(tmp_path / "a.npy", bad)
    with pytest.raises(ValueError, match=tells("features:", "[h, w, D]", "got (4, 8)")):
        write_npy_map(tmp_path / "a.npy", bad[0])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_safetensors_of_one_tensor(tmp_path, dtype):
    want = features(1).to(dtype)
    save_file({"features": want}, tmp_path / "a.safetensors")
    assert torch.equal(whole(open_map(tmp_path / "a.safetensors")), want.float())


def test_safetensors_of_another_kind_are_refused(tmp_path):
    save_file({"x": features(0), "y": features(1)}, tmp_path / "two.safetensors")
    with pytest.raises(ValueError, match=tells("two.safetensors:", "read", "one tensor", "got 2: x, y")):
        open_map(tmp_path / "two.safetensors")
    save_file({"x": features(0).int()}, tmp_path / "whole.safetensors")
    with pytest.raises(ValueError, match=tells("whole.safetensors:", "got torch.int32")):
        open_map(tmp_path / "whole.safetensors")
    (tmp_path / "junk.safetensors").write_bytes(b"junk")
    with pytest.raises(ValueError, match=tells("junk.safetensors:", "feature map", "read")):
        open_map(tmp_path / "junk.safetensors")


@pytest.mark.parametrize(
    ("shape", "reading", "order"),
    [
        ((90, 120, 512), Reading(), "h w D"),
        ((90, 120, 512), Reading(channels=512), "h w D"),
        ((512, 90, 120), Reading(channels=512), "D h w"),
        ((512, 90, 120), Reading(size=(360, 480)), "D h w"),
        ((90, 120, 512), Reading(size=(360, 480)), "h w D"),
        ((512, 120, 90), Reading(size=(480, 360)), "D h w"),  # a portrait
        ((256, 48, 64), Reading(size=(479, 640)), "D h w"),  # SAM: 47.9 rows, rounded
        ((64, 64, 64), Reading(channels=64), "h w D"),  # both fit: as kfgs writes
        ((9, 12, 12), Reading(size=(9, 12)), "h w D"),
        ((512, 640, 512), Reading(channels=512, size=(640, 512)), "D h w"),  # the channels fit both, the picture one
        ((512, 512, 3), Reading(), "h w D"),  # few channels, as toy teachers have
        ((360, 480, 512), Reading(), "h w D"),
        ((512, 90, 120), Reading(channels=120), "h w D"),
    ],
)
def test_order_of_the_axes(tmp_path, shape, reading, order):
    assert find_axes("a.npy", shape, reading) == order
    if max(shape) < 200:
        return
    np.save(tmp_path / "a.npy", np.zeros(shape, np.float16))
    want = shape if order == "h w D" else (*shape[1:], shape[0])
    assert tuple(open_map(tmp_path / "a.npy", reading).shape) == want


@pytest.mark.parametrize("shape", [(512, 90, 120), (512, 480, 640), (256, 64, 48)])
def test_an_order_in_doubt_is_refused_when_nothing_is_known(shape):
    with pytest.raises(ValueError, match=tells("a.npy:", "[h, w, D]", "[D, h, w]")):
        find_axes("a.npy", shape)


@pytest.mark.parametrize("suffix", [".npy", ".safetensors"])
def test_channels_first_comes_back_channels_last(tmp_path, suffix):
    want = features(2, (5, 6, 16))
    first = want.permute(2, 0, 1).contiguous()
    if suffix == ".npy":
        np.save(tmp_path / "a.npy", first.numpy())
    else:
        save_file({"f": first}, tmp_path / "a.safetensors")
    assert torch.equal(whole(open_map(tmp_path / f"a{suffix}", Reading(channels=16))), want)


def test_double_precision_beyond_single_is_infinite(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[[1e300, 1.5]]]))
    assert whole(open_map(tmp_path / "a.npy")).tolist() == [[[float("inf"), 1.5]]]


def test_a_view_of_both_layouts_is_told_by_the_partner(tmp_path):
    np.save(tmp_path / "a_s.npy", np.zeros((3, 4, 8), np.float32))
    assert layout_of(tmp_path / "a_s.npy").suffix == ".npy"  # a picture called a_s
    np.save(tmp_path / "a_f.npy", np.zeros((2, 8), np.float32))
    assert layout_of(tmp_path / "a_s.npy") is LANGSPLAT
    assert layout_of(tmp_path / "a.txt") is None


class Harmful:
    """What a pickle may ask for; loading it would make a file."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return os.mkdir, (str(self.file),)


@pytest.mark.parametrize("zipped", [True, False])
def test_a_file_with_code_in_it_is_named_and_runs_nothing(tmp_path, zipped):
    made, file = tmp_path / "made", tmp_path / "a_fmap_CxHxW.pt"
    torch.save({"features": Harmful(made)}, file, _use_new_zipfile_serialization=zipped)
    with pytest.raises(ValueError, match=tells(file, "cannot be read", "posix.mkdir", "Nothing was run")):
        open_map(file)
    assert not made.exists()
