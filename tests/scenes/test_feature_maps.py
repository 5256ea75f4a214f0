"""Feature maps of kfgs and of other programs, read one view at a time."""

import pickle

import numpy as np
import pytest
import torch
from messages import refused, tells
from safetensors.torch import save_file

from kfgs.quant import sample_grid
from kfgs.scenes import FeatureFolder, save_feature_map

FILES = ("pt", "npy", "safetensors")


def features(seed: int, size: tuple[int, int, int] = (3, 4, 8)) -> torch.Tensor:  # [h, w, D]
    return torch.randn(size, generator=torch.Generator().manual_seed(seed))


def save_pt(folder, stem: str, value) -> None:
    torch.save(value, folder / f"{stem}_fmap_CxHxW.pt")


def save_any(folder, stem: str, kind: str, want: torch.Tensor) -> None:
    if kind == "pt":
        save_pt(folder, stem, want.permute(2, 0, 1).contiguous())
    elif kind == "npy":
        np.save(folder / f"{stem}.npy", want.numpy())
    else:
        save_file({"f": want}, folder / f"{stem}.safetensors")


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.bfloat16])
@pytest.mark.parametrize("zipped", [True, False])
def test_reads_feature_3dgs_maps_channels_last(tmp_path, dtype, zipped):
    want = features(0)
    file = tmp_path / "a_fmap_CxHxW.pt"
    torch.save(want.permute(2, 0, 1).to(dtype).requires_grad_(), file, _use_new_zipfile_serialization=zipped)
    got = FeatureFolder(tmp_path, ["a"])[0]
    assert got.dtype == torch.float32
    assert not got.requires_grad
    assert torch.equal(got, want.to(dtype).float())


@pytest.mark.parametrize("dtype", ["<f2", "<f4", "<f8", ">f4"])
def test_reads_numpy_maps_as_they_lie(tmp_path, dtype):
    want = features(1).numpy().astype(dtype)
    np.save(tmp_path / "a.npy", want)
    assert np.array_equal(FeatureFolder(tmp_path, ["a"])[0].numpy(), want.astype(np.float32))


def test_keeps_the_order_asked_for_and_mixes_files(tmp_path):
    for i, stem in enumerate(("view_10", "view_2", "view_1")):
        save_pt(tmp_path, stem, torch.full((8, 3, 4), float(i)))
    np.save(tmp_path / "extra.npy", np.full((3, 4, 8), 9.0))
    maps = FeatureFolder(tmp_path, ["view_2", "extra", "view_10"])
    assert [float(m[0, 0, 0]) for m in maps] == [1.0, 9.0, 0.0]
    assert FeatureFolder(tmp_path).stems == ["extra", "view_1", "view_10", "view_2"]
    assert maps[1:].stems == ["extra", "view_10"]
    with pytest.raises(IndexError):
        maps[3]


def test_a_map_is_the_callers_own_copy(tmp_path):
    for kind in FILES:
        save_any(tmp_path, kind, kind, features(0))
        maps = FeatureFolder(tmp_path, [kind])
        maps[0].zero_()  # neither the file nor the next read changes
        assert torch.equal(maps[0], features(0))


def test_saved_map_comes_back_rounded_to_half(tmp_path):
    want = features(3)
    save_feature_map(tmp_path / "new", "a", want)
    assert torch.equal(FeatureFolder(tmp_path / "new", ["a"])[0], want.half().float())
    refused(lambda: save_feature_map(tmp_path / "new", "b", want * 1e6), "features:", "finite", "65504")
    assert [file.name for file in (tmp_path / "new").glob("*.npy")] == ["a.npy"]


def test_bad_arguments(tmp_path):
    refused(lambda: FeatureFolder(tmp_path / "nowhere", ["a"]), "nowhere: ", "folder", error=NotADirectoryError)
    for stems in (None, []):
        refused(lambda stems=stems: FeatureFolder(tmp_path, stems), "stems", tmp_path, "at least one view", "none")
    refused(lambda: FeatureFolder(tmp_path, "a"), "stems", "list", "'a'", error=TypeError)
    save_pt(tmp_path, "a", features(0).permute(2, 0, 1))
    refused(lambda: FeatureFolder(tmp_path, ["a", "a"]), "stems", "each once", "a")
    refused(lambda: FeatureFolder(tmp_path, ["a"], channels=512)[0], "a_fmap_CxHxW.pt:", "expected 512", "got 8")
    refused(lambda: FeatureFolder(tmp_path, ["a"], sizes=[(60, 80)] * 2), "sizes:", "expected 1", "got 2")


@pytest.mark.parametrize("kind", FILES)
def test_maps_may_differ_in_size_but_not_in_channels(tmp_path, kind):
    made = {"a": features(0, (12, 16, 8)), "b": features(1, (16, 12, 8)), "c": features(2, (12, 14, 8))}
    for stem, want in made.items():
        save_any(tmp_path, stem, kind, want)
    maps = FeatureFolder(tmp_path, list(made), sizes=[(96, 128), (128, 96), (96, 119)])
    maps.check_files()
    for i, want in enumerate(made.values()):
        assert torch.equal(maps[i], want)
        assert torch.equal(maps.grid(i, 40), want[1::2, 1::3].flatten(0, 1))
    save_any(tmp_path, "b", kind, features(1, (16, 12, 9)))
    for read in (lambda: maps[1], lambda: maps.grid(1, 9), lambda: next(maps.blocks(1)), maps.check_files):
        refused(read, "b", "8 channels", "got 9", "encode it again")


def test_a_map_that_is_turned_against_its_picture_is_refused_before_the_work(tmp_path):
    made = {"a": features(0, (12, 16, 8)), "b": features(1, (16, 12, 8)), "c": features(2, (16, 12, 8))}
    for stem, want in made.items():
        np.save(tmp_path / f"{stem}.npy", want.numpy())
    maps = FeatureFolder(tmp_path, list(made), sizes=[(96, 128), (128, 96), (96, 128)])
    refused(lambda: maps.check_files(), "c.npy:", "(96, 128)", "16 x 12 cells (transposed?)", "again")
    maps[:2].check_files()  # without this photo, as the message says


def test_every_file_that_does_not_fit_is_named(tmp_path):
    made = {"good": features(0), "nan": features(1), "zero": torch.zeros(3, 4, 8), "wide": features(2, (3, 4, 9))}
    made["nan"][1, 2, 3] = torch.nan
    for stem, want in made.items():
        np.save(tmp_path / f"{stem}.npy", want.numpy())
    (tmp_path / "cut.npy").write_bytes(b"\x93NUMPY")
    save_pt(tmp_path, "dict", {"features": features(0)})
    problems = FeatureFolder(tmp_path).check()
    assert set(problems) == {"nan.npy", "zero.npy", "wide.npy", "cut.npy", "dict_fmap_CxHxW.pt"}
    words = ("1 NaN", "all-zero", "8 channels, got 9", "read", "dict")
    for name, word in zip(("nan.npy", "zero.npy", "wide.npy", "cut.npy", "dict_fmap_CxHxW.pt"), words, strict=True):
        assert word in problems[name]
    assert FeatureFolder(tmp_path, ["good"]).check() == {}
    assert FeatureFolder(tmp_path, ["nan"]).check(values=False) == {}


def test_a_file_that_is_not_one_tensor_of_floats_is_refused(tmp_path):
    save_pt(tmp_path, "a", {"features": features(0)})
    refused(lambda: FeatureFolder(tmp_path, ["a"])[0], "a_fmap_CxHxW.pt:", "tensor", "got a dict", error=TypeError)
    save_pt(tmp_path, "b", features(0).long())
    refused(lambda: FeatureFolder(tmp_path, ["b"])[0], "b_fmap_CxHxW.pt:", "got torch.int64")
    np.save(tmp_path / "c.npy", np.ones((3, 4), np.float32))
    refused(lambda: FeatureFolder(tmp_path, ["c"])[0], "c.npy:", "[h, w, D]", "got (3, 4)")


def test_damaged_and_hostile_files_are_named(tmp_path):
    save_pt(tmp_path, "cut", torch.ones(64, 30, 40))
    cut = tmp_path / "cut_fmap_CxHxW.pt"
    cut.write_bytes(cut.read_bytes()[:10_000])
    (tmp_path / "junk_fmap_CxHxW.pt").write_bytes(b"junk")
    (tmp_path / "code_fmap_CxHxW.pt").write_bytes(pickle.dumps(pytest.raises))
    (tmp_path / "empty.npy").write_bytes(b"")
    np.save(tmp_path / "object.npy", np.array([object()]), allow_pickle=True)
    header = b"{'descr':'<f4','fortran_order':False,'shape':(99999999999,9999999999,99999999)}".ljust(118)
    (tmp_path / "huge.npy").write_bytes(b"\x93NUMPY\x01\x00v\x00" + header)
    save_pt(tmp_path, "repeats", torch.ones(1, 1, 1).expand(100_000, 100_000, 10_000))  # 4 bytes on disk, 400 TB read
    for stem in ("cut", "junk", "code", "empty", "object", "huge", "repeats"):
        refused(lambda stem=stem: FeatureFolder(tmp_path, [stem])[0], stem, "feature map", "read")


@pytest.mark.parametrize("kind", FILES)
def test_grids_and_blocks_are_those_of_the_whole_map(tmp_path, kind):
    want = features(4, (70, 50, 8))
    save_any(tmp_path, "a", kind, want)
    maps = FeatureFolder(tmp_path, ["a"])
    assert maps.shape == (70, 50, 8)
    for samples in (1, 100, 600, 10_000):
        assert torch.equal(maps.grid(0, samples), sample_grid(maps[0], samples=samples))
    blocks = list(maps.blocks(0))
    assert [len(block) for block in blocks] == [32, 32, 6]
    assert torch.equal(torch.cat(blocks), maps[0])
    want[0::2] = torch.nan
    save_any(tmp_path, "a", kind, want)
    maps = FeatureFolder(tmp_path, ["a"])
    assert torch.equal(maps.grid(0, 600), want[1::2, 1::3].reshape(-1, 8))  # looks at nothing else
    refused(lambda: maps[0], "a", "finite", "NaN")


@pytest.mark.parametrize("name", ["rgb_1.png.npy", "rgb_1.JPG_fmap_CxHxW.pt", "rgb_1.jpeg.safetensors"])
def test_the_whole_name_of_the_picture_is_a_stem_too(tmp_path, name):
    stem, _, kind = name.replace("_fmap_CxHxW", "").rpartition(".")
    save_any(tmp_path, stem, kind, features(5))
    assert torch.equal(FeatureFolder(tmp_path, ["rgb_1"])[0], features(5))
    assert FeatureFolder(tmp_path).stems == ["rgb_1"]


def test_pictures_in_subfolders_have_their_maps_there(tmp_path):
    for i, folder in enumerate(("left", "right")):
        (tmp_path / folder).mkdir()
        np.save(tmp_path / folder / "0001.npy", features(i).numpy())
    maps = FeatureFolder(tmp_path, ["right/0001", "LEFT/0001"])
    assert torch.equal(maps[0], features(1))
    assert torch.equal(maps[1], features(0))
    with pytest.raises(FileNotFoundError, match=tells("1 missing", "0001", "left/0001, right/0001")):
        FeatureFolder(tmp_path, ["0001"])  # which of them?


def test_names_of_other_maps_are_shown_when_none_fits(tmp_path):
    for i in range(4):
        np.save(tmp_path / f"frame_{i}.npy", features(i).numpy())
    with pytest.raises(FileNotFoundError, match=tells("2 missing: rgb_0, rgb_1", "rename", "(4: frame_0, frame_1, ")):
        FeatureFolder(tmp_path, ["rgb_0", "rgb_1"])


def test_sizes_of_pictures_or_channels_tell_the_order_of_the_axes(tmp_path):
    want = features(6, (6, 8, 20))
    np.save(tmp_path / "a.npy", want.permute(2, 0, 1).numpy())
    np.save(tmp_path / "b.npy", want.numpy())
    maps = FeatureFolder(tmp_path, ["a", "b"], sizes=[(60, 80), (60, 80)])
    assert torch.equal(maps[0], want)
    assert torch.equal(maps[1:][0], want)
    assert torch.equal(FeatureFolder(tmp_path, ["a"], channels=20)[0], want)
    assert FeatureFolder(tmp_path, ["a"]).shape == (20, 6, 8)  # .npy is [h, w, D] if nothing is known
    save_file({"map": want.permute(2, 0, 1).contiguous()}, tmp_path / "c.safetensors")
    assert torch.equal(FeatureFolder(tmp_path, ["c"])[0], want)  # 20 channels of 6 x 8: nothing else is likely
