import pickle

import numpy as np
import pytest
import torch

from kfgs.teachers import FeatureFolder, save_feature_map


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
    with pytest.raises(FileNotFoundError, match=r"each of 3 views, 2 missing: b_fmap_CxHxW\.pt, c_fmap_CxHxW\.pt \("):
        FeatureFolder(tmp_path, ["a", "b", "c"])


def test_bad_arguments(tmp_path):
    with pytest.raises(NotADirectoryError, match="expected a folder of feature maps"):
        FeatureFolder(tmp_path / "nowhere", ["a"])
    with pytest.raises(ValueError, match="at least one view, got none"):
        FeatureFolder(tmp_path)
    with pytest.raises(TypeError, match="list of image stems, got the text 'a'"):
        FeatureFolder(tmp_path, "a")
    save_pt(tmp_path, "a", features(0).permute(2, 0, 1))
    with pytest.raises(ValueError, match="each view once, got a more than once"):
        FeatureFolder(tmp_path, ["a", "a"])
    with pytest.raises(ValueError, match=r"a_fmap_CxHxW\.pt: expected 512 channels, got 8 in a map of 3 x 4"):
        _ = FeatureFolder(tmp_path, ["a"], channels=512)[0]


@pytest.mark.parametrize("size", [(3, 5, 8), (3, 4, 9)])
def test_a_map_of_another_size_is_refused_by_name(tmp_path, size):
    save_pt(tmp_path, "a", features(0).permute(2, 0, 1))
    save_pt(tmp_path, "b", features(0, size).permute(2, 0, 1))
    maps = FeatureFolder(tmp_path, ["a", "b"])
    with pytest.raises(ValueError, match=r"b_fmap_CxHxW\.pt: expected a map of \(h, w, D\) = \(3, 4, 8\) as in a_fmap"):
        maps[1]


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_values_that_are_not_finite_are_refused_by_name(tmp_path, value):
    bad = features(0)
    bad[1, 2, 3] = value
    np.save(tmp_path / "a.npy", bad.numpy())
    with pytest.raises(ValueError, match=r"a\.npy: expected finite features, got 1 NaN or infinite"):
        FeatureFolder(tmp_path, ["a"])[0]
    with pytest.raises(ValueError, match="finite values below 65504"):
        save_feature_map(tmp_path, "b", bad)
    with pytest.raises(ValueError, match="finite values below 65504"):
        save_feature_map(tmp_path, "b", features(0) * 1e6)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npy"]


def test_a_file_that_is_no_tensor_is_refused(tmp_path):
    save_pt(tmp_path, "a", {"features": features(0)})
    with pytest.raises(TypeError, match="expected one dense tensor .*, got a dict"):
        FeatureFolder(tmp_path, ["a"])[0]
    save_pt(tmp_path, "b", features(0).long())
    with pytest.raises(ValueError, match=r"floating-point features, got torch\.int64"):
        FeatureFolder(tmp_path, ["b"])[0]
    np.save(tmp_path / "c.npy", np.ones((3, 4), np.float32))
    with pytest.raises(ValueError, match=r"c\.npy: expected a map \[h, w, D\], got \(3, 4\)"):
        FeatureFolder(tmp_path, ["c"])[0]


def test_damaged_and_hostile_files_are_named(tmp_path):
    save_pt(tmp_path, "cut", torch.ones(64, 30, 40))
    cut = tmp_path / "cut_fmap_CxHxW.pt"
    cut.write_bytes(cut.read_bytes()[:10_000])
    (tmp_path / "junk_fmap_CxHxW.pt").write_bytes(b"junk")
    (tmp_path / "code_fmap_CxHxW.pt").write_bytes(pickle.dumps(pytest.raises))
    (tmp_path / "empty.npy").write_bytes(b"")
    np.save(tmp_path / "object.npy", np.array([object()]), allow_pickle=True)
    for stem in ("cut", "junk", "code", "empty", "object"):
        with pytest.raises(ValueError, match=rf"{stem}.*: expected a feature map, but it cannot be read"):
            FeatureFolder(tmp_path, [stem])[0]
