import os
import pickle
import tracemalloc
from dataclasses import replace

import numpy as np
import oracles_langsplat as oracle
import pytest
import torch
from messages import tells
from safetensors.torch import save_file

from kfgs._files import digest_file
from kfgs.features import FeatureFolder, save_feature_map, write_npy_map
from kfgs.features.manifest import Manifest, MapRecord
from kfgs.quant import PaperCodebook, fit_codebook, sample_grid


def features(seed: int, size: tuple[int, int, int] = (3, 4, 8)) -> torch.Tensor:  # [h, w, D]
    return torch.randn(size, generator=torch.Generator().manual_seed(seed))


def save_pt(folder, stem: str, value) -> None:
    torch.save(value, folder / f"{stem}_fmap_CxHxW.pt")


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.bfloat16])
def test_reads_feature_3dgs_maps_channels_last(tmp_path, dtype):
    want = features(0)
    save_pt(tmp_path, "a", want.permute(2, 0, 1).to(dtype))
    got = FeatureFolder(tmp_path, ["a"])[0]
    assert got.dtype == torch.float32
    assert got.is_contiguous()
    assert torch.equal(got, want.to(dtype).float())


@pytest.mark.parametrize("dtype", ["<f2", "<f4", "<f8", ">f4"])
def test_reads_numpy_maps_as_they_lie(tmp_path, dtype):
    want = features(1).numpy().astype(dtype)
    np.save(tmp_path / "a.npy", want)
    assert np.array_equal(FeatureFolder(tmp_path, ["a"])[0].numpy(), want.astype(np.float32))


def test_reads_a_file_from_before_zip_archives(tmp_path):
    want = features(2)
    torch.save(want.permute(2, 0, 1), tmp_path / "a_fmap_CxHxW.pt", _use_new_zipfile_serialization=False)
    assert torch.equal(FeatureFolder(tmp_path, ["a"])[0], want)


def test_keeps_the_order_asked_for_and_mixes_layouts(tmp_path):
    for i, stem in enumerate(("view_10", "view_2", "view_1")):
        save_pt(tmp_path, stem, torch.full((8, 3, 4), float(i)))
    np.save(tmp_path / "extra.npy", np.full((3, 4, 8), 9.0))
    maps = FeatureFolder(tmp_path, ["view_2", "extra", "view_10"])
    assert [float(m[0, 0, 0]) for m in maps] == [1.0, 9.0, 0.0]
    assert float(maps[-1][0, 0, 0]) == 0.0
    assert FeatureFolder(tmp_path).stems == ["extra", "view_1", "view_10", "view_2"]
    part = maps[1:]
    assert isinstance(part, FeatureFolder)
    assert part.stems == ["extra", "view_10"]
    with pytest.raises(IndexError):
        maps[3]


def test_shape_is_known_without_reading_the_other_maps(tmp_path):
    save_pt(tmp_path, "a", features(0).permute(2, 0, 1))
    (tmp_path / "b_fmap_CxHxW.pt").write_bytes(b"not a map")
    assert FeatureFolder(tmp_path, ["a", "b"]).shape == (3, 4, 8)


def test_a_map_is_the_callers_own_copy(tmp_path):
    save_pt(tmp_path, "a", features(0).permute(2, 0, 1))
    maps = FeatureFolder(tmp_path, ["a"])
    first = maps[0]
    first.zero_()  # neither the file nor the next read changes
    assert torch.equal(maps[0], features(0))


def test_saved_map_comes_back_rounded_to_half(tmp_path):
    want = features(3)
    path = save_feature_map(tmp_path / "new", "a", want)
    assert torch.load(path, weights_only=True).shape == (8, 3, 4)
    assert torch.equal(FeatureFolder(tmp_path / "new", ["a"])[0], want.half().float())


def test_missing_views_are_named(tmp_path):
    save_pt(tmp_path, "a", features(0).permute(2, 0, 1))
    with pytest.raises(FileNotFoundError, match=tells("3 views", "2 missing", "b_fmap_CxHxW.pt, c_fmap_CxHxW.pt")):
        FeatureFolder(tmp_path, ["a", "b", "c"])


def test_bad_arguments(tmp_path):
    with pytest.raises(NotADirectoryError, match=tells("nowhere: ", "folder")):
        FeatureFolder(tmp_path / "nowhere", ["a"])
    with pytest.raises(ValueError, match=tells("stems", tmp_path, "at least one view", "none")):
        len(FeatureFolder(tmp_path))
    with pytest.raises(ValueError, match=tells("stems", "at least one view", "none")):
        FeatureFolder(tmp_path, [])
    with pytest.raises(TypeError, match=tells("stems", "list", "'a'")):
        FeatureFolder(tmp_path, "a")
    save_pt(tmp_path, "a", features(0).permute(2, 0, 1))
    with pytest.raises(ValueError, match=tells("stems", "each stem once", "a")):
        FeatureFolder(tmp_path, ["a", "a"])
    with pytest.raises(ValueError, match=tells("a_fmap_CxHxW.pt:", "expected 512", "got 8")):
        _ = FeatureFolder(tmp_path, ["a"], channels=512)[0]


@pytest.mark.parametrize("layout", ["pt", "npy", "safetensors"])
def test_maps_may_differ_in_size_but_not_in_channels(tmp_path, layout):
    made = {"a": features(0, (12, 16, 8)), "b": features(1, (16, 12, 8)), "c": features(2, (12, 14, 8))}
    for stem, want in made.items():
        save_any(tmp_path, stem, layout, want)
    maps = FeatureFolder(tmp_path, list(made), sizes=[(96, 128), (128, 96), (96, 119)])
    maps.check_files()
    for i, want in enumerate(made.values()):
        assert torch.equal(maps[i], want)
        assert torch.equal(torch.cat(list(maps.blocks(i))), want)
        assert torch.equal(maps.grid(i, (2, 3), 1), want[1::2, 1::3].flatten(0, 1))
    save_any(tmp_path, "b", layout, features(1, (16, 12, 9)))
    for read in (lambda: maps[1], lambda: maps.grid(1, None, 9), lambda: next(maps.blocks(1))):
        with pytest.raises(ValueError, match=tells("b", "8 channels as in a", "got 9", "encode it again")):
            read()


def test_a_map_that_is_turned_against_its_picture_is_refused_before_the_work(tmp_path):
    made = {"a": features(0, (12, 16, 8)), "b": features(1, (16, 12, 8)), "c": features(2, (12, 16, 8))}
    made["c"] = made["c"].transpose(0, 1)
    for stem, want in made.items():
        np.save(tmp_path / f"{stem}.npy", want.numpy())
    maps = FeatureFolder(tmp_path, list(made), sizes=[(96, 128), (128, 96), (96, 128)])
    with pytest.raises(ValueError, match=tells("c.npy:", "96 x 128 pixels", "16 x 12 cells (transposed?)", "again")):
        maps.check_files()
    maps[:2].check_files()  # without this photo, as the message says
    np.save(tmp_path / "c.npy", made["c"].transpose(0, 1).numpy())
    maps.check_files()  # encoded again, as the message says


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_values_that_are_not_finite_are_refused_by_name(tmp_path, value):
    bad = features(0)
    bad[1, 2, 3] = value
    np.save(tmp_path / "a.npy", bad.numpy())
    with pytest.raises(ValueError, match=tells("a.npy:", "finite", "got 1 NaN")):
        FeatureFolder(tmp_path, ["a"])[0]
    with pytest.raises(ValueError, match=tells("features:", "finite", "65504")):
        save_feature_map(tmp_path, "b", bad)
    with pytest.raises(ValueError, match=tells("features:", "finite", "65504")):
        save_feature_map(tmp_path, "b", features(0) * 1e6)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npy"]


def test_a_file_that_is_no_tensor_is_refused(tmp_path):
    save_pt(tmp_path, "a", {"features": features(0)})
    with pytest.raises(ValueError, match=tells("a_fmap_CxHxW.pt:", "tensor", "got dict")):
        FeatureFolder(tmp_path, ["a"])[0]
    save_pt(tmp_path, "s", features(0).to_sparse())
    with pytest.raises(ValueError, match=tells("s_fmap_CxHxW.pt", "dense tensor", "sparse")):
        FeatureFolder(tmp_path, ["s"])[0]
    save_pt(tmp_path, "b", features(0).long())
    with pytest.raises(ValueError, match=tells("b_fmap_CxHxW.pt:", "got torch.int64")):
        FeatureFolder(tmp_path, ["b"])[0]
    save_pt(tmp_path, "m", torch.empty(8, 3, 4, device="meta"))
    save_pt(tmp_path, "n", torch.nested.nested_tensor([torch.ones(3, 4), torch.ones(2, 4)], layout=torch.jagged))
    for stem in ("m", "n"):
        with pytest.raises(ValueError, match=tells(f"{stem}_fmap_CxHxW.pt:")):
            FeatureFolder(tmp_path, [stem])[0]
    np.save(tmp_path / "c.npy", np.ones((3, 4), np.float32))
    with pytest.raises(ValueError, match=tells("c.npy:", "[h, w, D]", "got (3, 4)")):
        FeatureFolder(tmp_path, ["c"])[0]


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
    for stem in ("cut", "junk", "code", "empty", "object", "huge"):
        with pytest.raises(ValueError, match=tells(stem, "feature map", "encode it again")):
            FeatureFolder(tmp_path, [stem])[0]
    with pytest.raises(ValueError, match=tells("huge.npy:", "header states")):
        FeatureFolder(tmp_path, ["huge"])[0]


def save_masks(folder, stem: str, size: tuple[int, int] = (6, 8), seed: int = 0):
    generator = np.random.default_rng(seed)
    index = generator.integers(-1, 5, (4, *size)).astype(np.float32)
    rows = generator.normal(size=(5, 8)).astype(np.float32)
    np.save(folder / f"{stem}_s.npy", index)
    np.save(folder / f"{stem}_f.npy", rows)
    return index, rows


def save_any(folder, stem: str, layout: str, want: torch.Tensor) -> None:
    if layout == "pt":
        save_pt(folder, stem, want.permute(2, 0, 1).contiguous())
    elif layout == "npy":
        np.save(folder / f"{stem}.npy", want.numpy())
    else:
        save_file({"f": want}, folder / f"{stem}.safetensors")


def own_map(folder, stem: str, want: torch.Tensor) -> MapRecord:
    """A map as kfgs writes it, and what its manifest says about it."""
    file = write_npy_map(folder / f"{stem}.npy", want)
    info = file.stat()
    shape = (int(want.shape[0]), int(want.shape[1]), int(want.shape[2]))
    return MapRecord(file.name, shape, info.st_size, info.st_mtime_ns, digest_file(file), f"{stem}.png", "0" * 64, 0.1)


@pytest.mark.parametrize("layout", ["pt", "npy", "safetensors"])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_grid_is_that_of_the_whole_map(tmp_path, layout, dtype):
    save_any(tmp_path, "a", layout, features(4, (70, 50, 8)).to(dtype))
    maps = FeatureFolder(tmp_path, ["a"])
    assert maps.shape == (70, 50, 8)
    for step, samples in (((2, 3), 1), (None, 100), (None, 10_000), ((100, 100), 1)):
        got = maps.grid(0, step, samples)
        assert got.dtype == torch.float32
        assert torch.equal(got, sample_grid(maps[0], step, samples=samples))


@pytest.mark.parametrize("layout", ["pt", "npy", "safetensors"])
def test_grid_looks_at_nothing_else(tmp_path, layout):
    want = features(4, (70, 50, 8))
    want[0::2] = torch.nan
    save_any(tmp_path, "a", layout, want)
    maps = FeatureFolder(tmp_path, ["a"])
    assert torch.equal(maps.grid(0, (2, 3), 1), want[1::2, 1::3].reshape(-1, 8))
    with pytest.raises(ValueError, match=tells("a", "finite", "got 14000 NaN")):
        maps[0]
    with pytest.raises(ValueError, match=tells("a", "finite", "got 4760 NaN")):
        maps.grid(0, (1, 3), 1)
    with pytest.raises(ValueError, match=tells("step[0]:", "got 0")):
        maps.grid(0, (0, 3), 1)


def test_langsplat_maps_by_level_and_stride(tmp_path):
    made = {stem: save_masks(tmp_path, stem, seed=i) for i, stem in enumerate(("a", "b"))}
    assert FeatureFolder(tmp_path).stems == ["a", "b"]  # not a_f, a_s
    maps = FeatureFolder(tmp_path, ["a", "b"], channels=8, level="l", stride=2)
    for i, (index, rows) in enumerate(made.values()):
        want = torch.from_numpy(oracle.dense(index, rows, 3, 3, 4)).float()
        assert torch.equal(maps[i], want)
        assert torch.equal(maps[:][i], want)
        assert torch.equal(maps.grid(i, (2, 3), 1), sample_grid(want, (2, 3)))
    assert FeatureFolder(tmp_path, ["b"]).shape == (6, 8, 8)
    with pytest.raises(ValueError, match=tells("level:", "got 4")):
        FeatureFolder(tmp_path, level=4)
    with pytest.raises(ValueError, match=tells("stride:", "got 0")):
        FeatureFolder(tmp_path, stride=0)


def test_langsplat_digests_tell_level_stride_and_both_files(tmp_path):
    save_masks(tmp_path, "a")
    seen = [
        FeatureFolder(tmp_path, level=level, stride=stride).digests()
        for level, stride in ((0, None), (1, None), (0, 2))
    ]
    np.save(tmp_path / "a_f.npy", np.ones((5, 8), np.float32))
    seen.append(FeatureFolder(tmp_path).digests())
    assert len({str(digests) for digests in seen}) == 4
    assert seen[0][0][0] == "a_s.npy level 0 stride auto"
    np.save(tmp_path / "b.npy", features(0).numpy())
    assert FeatureFolder(tmp_path).digests()[1] == ["b.npy", digest_file(tmp_path / "b.npy")]


@pytest.mark.parametrize("name", ["rgb_1.png.npy", "rgb_1.JPG_fmap_CxHxW.pt", "rgb_1.jpeg.safetensors"])
def test_the_whole_name_of_the_picture_is_a_stem_too(tmp_path, name):
    want = features(5)
    stem, _, layout = name.replace("_fmap_CxHxW", "").rpartition(".")
    save_any(tmp_path, stem, layout, want)
    assert (tmp_path / name).is_file()
    assert torch.equal(FeatureFolder(tmp_path, ["rgb_1"])[0], want)
    assert FeatureFolder(tmp_path).stems == ["rgb_1"]


def test_pictures_in_subfolders_have_their_maps_there(tmp_path):
    for i, folder in enumerate(("left", "right")):
        (tmp_path / folder).mkdir()
        np.save(tmp_path / folder / "0001.npy", features(i).numpy())
    maps = FeatureFolder(tmp_path, ["right/0001", "left/0001"])
    assert torch.equal(maps[0], features(1))
    assert torch.equal(maps[1], features(0))
    with pytest.raises(ValueError, match=tells("'0001'", "got 2", "left/0001.npy, right/0001.npy")):
        FeatureFolder(tmp_path, ["0001"])


def test_last_parts_of_names_are_looked_for_when_nothing_else_fits(tmp_path):
    (tmp_path / "feat").mkdir()
    np.save(tmp_path / "feat" / "b.npy", features(1).numpy())
    np.save(tmp_path / "a.npy", features(0).numpy())
    maps = FeatureFolder(tmp_path, ["train/a", "train/b"])
    assert [file.relative_to(tmp_path).as_posix() for file in maps.files] == ["a.npy", "feat/b.npy"]
    with pytest.raises(
        FileNotFoundError, match=tells("2 views", "1 missing: b.npy", "the program that made the others")
    ):
        FeatureFolder(tmp_path, ["a", "b"])  # a fits as it is: then so must b
    with pytest.raises(FileNotFoundError, match=tells("2 views", "2 missing", "left/a.npy")):
        FeatureFolder(tmp_path, ["left/a", "right/a"])  # which of them?


def test_names_of_other_maps_are_shown_when_none_fits(tmp_path):
    for i in range(4):
        np.save(tmp_path / f"frame_{i}.npy", features(i).numpy())
    with pytest.raises(FileNotFoundError, match=tells("(4)", "frame_0, frame_1, frame_2", "rgb_0, rgb_1", "rename")):
        FeatureFolder(tmp_path, ["rgb_0", "rgb_1"])


def test_pictures_sizes_tell_the_order_of_the_axes(tmp_path):
    want = features(6, (6, 8, 20))
    np.save(tmp_path / "a.npy", want.permute(2, 0, 1).numpy())
    np.save(tmp_path / "b.npy", want.numpy())
    maps = FeatureFolder(tmp_path, ["a", "b"], sizes=[(60, 80), (60, 80)])
    assert torch.equal(maps[0], want)
    assert torch.equal(maps[1:][0], want)
    assert torch.equal(FeatureFolder(tmp_path, ["a"], channels=20)[0], want)
    with pytest.raises(ValueError, match=tells("sizes:", "expected 2", "got 1")):
        FeatureFolder(tmp_path, ["a", "b"], sizes=[(60, 80)])


def test_digests_come_from_the_manifest_of_these_very_files(tmp_path):
    records = {stem: own_map(tmp_path, stem, features(i)) for i, stem in enumerate(("a", "b"))}
    Manifest({"name": "t"}, records).save(tmp_path)
    want = [[f"{stem}.npy", digest_file(tmp_path / f"{stem}.npy")] for stem in ("b", "a")]
    assert FeatureFolder(tmp_path, ["b", "a"]).digests() == want
    Manifest({"name": "t"}, {**records, "b": replace(records["b"], mtime_ns=1)}).save(tmp_path)
    assert FeatureFolder(tmp_path, ["b", "a"]).digests() is None  # b was written since
    (tmp_path / "features.json").unlink()
    assert FeatureFolder(tmp_path, ["b", "a"]).digests() is None


def test_a_map_of_the_manifest_is_rows_first_whatever_it_looks_like(tmp_path):
    want = torch.zeros(512, 9, 100)
    want[300, 2, 7] = 3.0
    record = own_map(tmp_path, "a", want)
    with pytest.raises(ValueError, match=tells("a.npy:", "got (512, 9, 100)", "[D, h, w]")):
        _ = FeatureFolder(tmp_path).shape
    Manifest({"name": "t"}, {"a": record}).save(tmp_path)
    assert torch.equal(FeatureFolder(tmp_path)[0], want)


def test_discarded_maps_keep_shape_and_digests_and_say_so_when_read(tmp_path):
    records = {stem: own_map(tmp_path, stem, features(i)) for i, stem in enumerate(("a", "b"))}
    Manifest({"name": "t"}, records).save(tmp_path)
    whole = FeatureFolder(tmp_path, ["b", "a"])
    before = whole.digests(), whole.shape, whole.files
    for stem in records:
        (tmp_path / f"{stem}.npy").unlink()
    with pytest.raises(
        FileNotFoundError, match=tells("2 views", "2 missing", "b.npy, a.npy")
    ):  # deleted, but nobody said why
        FeatureFolder(tmp_path, ["b", "a"])
    Manifest({"name": "t"}, records, discarded=True).save(tmp_path)
    maps = FeatureFolder(tmp_path, ["b", "a"])
    assert (maps.digests(), maps.shape, maps.files) == before
    assert FeatureFolder(tmp_path).stems == ["a", "b"]
    for read in (lambda: maps[1], lambda: maps.grid(1, None, 10)):
        with pytest.raises(FileNotFoundError, match=tells("a.npy:", "discarded", "`kfgs features`")):
            read()
    with pytest.raises(
        FileNotFoundError, match=tells("3 views", "1 missing", "c.npy", "`kfgs features", "--split all")
    ):
        FeatureFolder(tmp_path, ["a", "b", "c"])
    with pytest.raises(ValueError, match=tells("b.npy:", "expected 512", "got 8")):
        _ = FeatureFolder(tmp_path, ["b"], channels=512).shape


def test_digests_of_discarded_maps_beside_touched_and_changed_ones_are_those_of_before(tmp_path):
    stems = ["a", "b", "c"]
    records = {stem: own_map(tmp_path, stem, features(i)) for i, stem in enumerate(stems)}
    Manifest({"name": "t"}, records).save(tmp_path)
    before = FeatureFolder(tmp_path, stems).digests()
    os.utime(tmp_path / "b.npy", ns=(1, 1))
    assert FeatureFolder(tmp_path, stems).digests() is None  # all are there: whoever asks hashes them, once for all
    (tmp_path / "a.npy").unlink()
    Manifest({"name": "t"}, records, discarded=True).save(tmp_path)
    assert FeatureFolder(tmp_path, stems).digests() == before
    own_map(tmp_path, "c", features(7))
    changed = [*before[:2], ["c.npy", digest_file(tmp_path / "c.npy")]]
    assert FeatureFolder(tmp_path, stems).digests() == changed != before


def test_maps_of_subfolders_are_listed_before_and_after_they_are_discarded(tmp_path):
    record = replace(own_map(tmp_path / "left", "b", features(0)), file="left/b.npy")
    records = {"a": own_map(tmp_path, "a", features(1)), "left/b": record}
    for discarded in (False, True):
        Manifest({"name": "t"}, records, discarded=discarded).save(tmp_path)
        maps = FeatureFolder(tmp_path)
        assert (maps.stems, maps.files) == (["a", "left/b"], [tmp_path / "a.npy", tmp_path / "left" / "b.npy"])
        (tmp_path / "left" / "b.npy").unlink(missing_ok=True)
    Manifest({"name": "t"}, records).save(tmp_path)
    with pytest.raises(FileNotFoundError, match=tells("2 views", "1 missing", "left/b.npy", "`kfgs features")):
        _ = FeatureFolder(tmp_path).files  # deleted by nobody knows whom: not left out in silence


def test_a_map_is_read_without_a_second_copy(tmp_path):
    np.save(tmp_path / "a.npy", features(0, (250, 64, 32)).numpy().astype(np.float16))
    maps = FeatureFolder(tmp_path)
    tracemalloc.start()  # sees NumPy's memory; the result itself is torch's
    try:
        whole = maps[0]
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < whole.numel() * 4 / 10


@pytest.mark.parametrize("layout", ["pt", "npy", "safetensors"])
def test_a_codebook_is_the_same_with_grids_and_with_whole_maps(tmp_path, layout):
    for i in range(3):
        save_any(tmp_path, f"view_{i}", layout, features(i, (40, 30, 8)).half())
    maps = FeatureFolder(tmp_path)
    config = PaperCodebook(initial=3, maximum=9, epochs=2, samples=200)
    disk, memory = fit_codebook(maps, config), fit_codebook([maps[i] for i in range(3)], config)
    assert torch.equal(disk.codewords, memory.codewords)
    assert disk.report.history == memory.report.history


def test_masks_of_three_things_make_a_codebook_of_three(tmp_path):
    generator = np.random.default_rng(0)
    things = np.linalg.qr(generator.normal(size=(8, 3)))[0].T.astype(np.float32)  # orthogonal unit rows
    for i in range(4):  # each view has its own masks of the same things, and pixels in none
        save_masks(tmp_path, f"view_{i}", (30, 40), seed=i)
        np.save(tmp_path / f"view_{i}_f.npy", things[[(i + m) % 3 for m in range(5)]])
    fit = fit_codebook(FeatureFolder(tmp_path, level="m"), PaperCodebook(initial=2, epochs=2))
    assert fit.size == 3
    assert np.abs(fit.unit.numpy() @ things.T).max(axis=1).tolist() == pytest.approx([1.0] * 3, abs=1e-3)
    masked = sum(int((np.load(tmp_path / f"view_{i}_s.npy")[2] >= 0).sum()) for i in range(4))
    assert int(fit.report.usage.sum()) == masked


def test_a_map_among_kfgss_own_that_the_manifest_does_not_tell_of_is_refused(tmp_path):
    records = {stem: own_map(tmp_path, stem, features(i)) for i, stem in enumerate(("a", "b"))}
    Manifest({"name": "t"}, {"a": records["a"]}).save(tmp_path)
    said = tells("b.npy:", "features.json", "without a record", "(1 of 2 views)", "move it away")
    for stems in (["a", "b"], ["b", "a"], None):
        with pytest.raises(ValueError, match=said):
            _ = FeatureFolder(tmp_path, stems).files
    assert torch.equal(FeatureFolder(tmp_path, ["a"])[0], features(0).half().float())  # nobody asked for b
    save_pt(tmp_path, "a", features(2).permute(2, 0, 1))  # read before .npy
    with pytest.raises(ValueError, match=tells("a_fmap_CxHxW.pt:", "features.json")):
        FeatureFolder(tmp_path, ["a"])


def test_pictures_called_like_langsplats_files_are_read_as_kfgs_wrote_them(tmp_path):
    stems = ["x", "x_f", "x_s", "y_s", "y_f", "z.png"]
    records = {stem: own_map(tmp_path, stem, features(i)) for i, stem in enumerate(stems)}
    Manifest({"name": "t"}, records).save(tmp_path)
    for maps in (FeatureFolder(tmp_path, stems), FeatureFolder(tmp_path)):
        assert sorted(maps.stems) == sorted(stems)
        for i, stem in enumerate(maps.stems):
            assert torch.equal(maps[i], features(stems.index(stem)).half().float())
        assert maps.digests() == [[f"{stem}.npy", records[stem].digest] for stem in maps.stems]


def test_a_discarded_map_is_not_looked_for_elsewhere(tmp_path):
    record = own_map(tmp_path, "a", features(0))
    (tmp_path / "old").mkdir()
    (tmp_path / "a.npy").rename(tmp_path / "old" / "a.npy")
    Manifest({"name": "t"}, {"a": record}, discarded=True).save(tmp_path)
    assert FeatureFolder(tmp_path, ["a"]).files == [tmp_path / "a.npy"]


def test_a_map_saved_by_a_training_run_needs_no_gradient(tmp_path):
    want = features(0)
    save_pt(tmp_path, "a", want.permute(2, 0, 1).contiguous().requires_grad_())
    save_pt(tmp_path, "b", torch.nn.Parameter(want.permute(2, 0, 1).contiguous()))
    maps = FeatureFolder(tmp_path, ["a", "b"])
    for i in range(2):
        assert torch.equal(maps[i], want)
        assert not maps[i].requires_grad
        assert torch.equal(maps.grid(i, (2, 2), 1), want[1::2, 1::2].reshape(-1, 8))


def test_a_map_that_repeats_a_few_bytes_is_refused(tmp_path):
    save_pt(tmp_path, "a", torch.ones(1, 1, 1).expand(100_000, 100_000, 10_000))  # 4 bytes on disk, 400 TB read
    assert (tmp_path / "a_fmap_CxHxW.pt").stat().st_size < 4000
    said = ("a_fmap_CxHxW.pt:", "only 1", "contiguous")
    with pytest.raises(ValueError, match=tells(*said)):
        FeatureFolder(tmp_path, ["a"])[0]


def test_stems_may_come_from_any_iterable(tmp_path):
    for i, stem in enumerate("ab"):
        np.save(tmp_path / f"{stem}.npy", features(i).numpy())
    for stems in (("b", "a"), {"b": 1, "a": 2}, (stem for stem in "ba")):
        assert FeatureFolder(tmp_path, stems).stems == ["b", "a"]


@pytest.mark.parametrize("layout", ["pt", "npy", "safetensors"])
def test_blocks_are_the_map_and_never_the_whole(tmp_path, layout):
    want = features(4, (70, 50, 8))
    save_any(tmp_path, "a", layout, want)
    maps = FeatureFolder(tmp_path, ["a"])
    blocks = [block.clone() for block in maps.blocks(0)]
    assert [len(block) for block in blocks] == [32, 32, 6]
    assert torch.equal(torch.cat(blocks), maps[0])
    want[50, 3, 2] = torch.inf
    save_any(tmp_path, "a", layout, want)
    read = FeatureFolder(tmp_path, ["a"]).blocks(0)
    next(read)
    with pytest.raises(ValueError, match=tells("a", "finite", "got 1 NaN")):
        next(read)
