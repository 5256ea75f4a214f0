import os
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import tells

from kfgs._files import digest_file
from kfgs.cameras import Camera
from kfgs.features import FeatureFolder, Picture
from kfgs.features.check import FeatureReport
from kfgs.features.manifest import Manifest, MapRecord
from kfgs.scenes import Scene

SIZE = (60, 80)  # of the pictures; maps are 6 x 8


def features(seed: int, size: tuple[int, int, int] = (6, 8, 16)) -> torch.Tensor:  # [h, w, D]
    return torch.randn(size, generator=torch.Generator().manual_seed(seed))


def record_of(folder, stem: str) -> MapRecord:
    """What the manifest says about a map as it lies there."""
    file = folder / f"{stem}.npy"
    info = file.stat()
    digest = digest_file(file)
    return MapRecord(file.name, (6, 8, 16), info.st_size, info.st_mtime_ns, digest, f"{stem}.png", "0" * 64, 0.1)


def pictures(*stems: str, size: tuple[int, int] = SIZE) -> list[Picture]:
    return [Picture(stem, Path(f"{stem}.png"), size) for stem in stems]


def check(folder, views: list[Picture], channels: int | None = None, *, values: bool = True, **how) -> FeatureReport:
    return FeatureFolder(folder, channels=channels, **how).check(views, values=values)


@pytest.fixture
def folder(tmp_path):
    """Three maps that fit: a, b, c."""
    for i, stem in enumerate("abc"):
        np.save(tmp_path / f"{stem}.npy", features(i).numpy().astype(np.float16))
    return tmp_path


@pytest.mark.parametrize("values", [True, False])
def test_maps_that_fit_are_one_line(folder, values):
    report = check(folder, pictures("a", "b", "c"), 16, values=values)
    assert report.ok
    assert (report.views, report.shape, report.dtype, report.notes) == (3, (6, 8, 16), "float16", {})
    assert report.bytes == sum((folder / f"{stem}.npy").stat().st_size for stem in "abc")
    assert str(report) == f"{folder}: 3 of 3 views have a map that fits; 6 x 8 cells, 16 channels, float16, 0.0 MB"


def test_all_that_does_not_fit_is_reported_at_once_by_file(folder):
    bad = features(3)
    bad[5, 7, 3], bad[0, 0, 0] = torch.nan, torch.inf
    np.save(folder / "nan.npy", bad.numpy())
    np.save(folder / "zero.npy", np.zeros((6, 8, 16), np.float16))
    np.save(folder / "wide.npy", features(4, (6, 8, 17)).numpy())
    np.save(folder / "small.npy", features(5, (3, 4, 16)).numpy())
    np.save(folder / "turned.npy", features(6, (8, 6, 16)).numpy())
    np.save(folder / "whole.npy", np.ones((6, 8, 16), np.int32))
    (folder / "junk_fmap_CxHxW.pt").write_bytes(b"junk")
    stems = ["nan", "zero", "wide", "small", "turned", "whole", "junk", "gone"]
    report = check(folder, pictures("a", "b", "c", *stems))
    assert (report.views, report.shape, report.ok) == (11, (6, 8, 16), False)
    assert report.problems["nan.npy"] == ["2 NaN or infinite values"]
    assert report.problems["zero.npy"] == ["every feature is all-zero"]
    assert report.problems["wide.npy"] == ["expected 16 channels, got 17"]
    assert "small.npy" not in report.problems  # in the aspect of its picture
    assert report.problems["turned.npy"] == [
        "expected the aspect of a picture of 60 x 80 pixels, got 8 x 6 cells (transposed?)",
    ]
    assert report.notes[""] == ["maps of 3 sizes: 6 x 8 (6), 3 x 4 (1), 8 x 6 (1)"]
    assert report.problems["whole.npy"] == [
        "expected floating-point features, got int32; encode it again, or leave the photo out (split.json)"
    ]
    assert "cannot be read" in report.problems["junk_fmap_CxHxW.pt"][0]
    assert report.problems["gone.npy"] == ["missing"]
    lines = str(report).splitlines()
    assert lines[0].startswith(f"{folder}: 4 of 11 views have a map that fits; 6 x 8 cells, 16 channels, float16")
    assert len(lines) == 9
    assert sum(line.startswith("turned.npy: expected the aspect") for line in lines) == 1


def test_without_values_only_shape_and_kind_are_looked_at(folder):
    np.save(folder / "a.npy", np.full((6, 8, 16), np.nan, np.float16))
    np.save(folder / "b.npy", features(1, (6, 8, 3)).numpy())
    report = check(folder, pictures("a", "b", "c"), values=False)
    assert report.problems == {"b.npy": ["expected 16 channels, got 3"]}


def test_channels_that_are_known_count_more_than_most_maps(folder):
    report = check(folder, pictures("a", "b", "c"), 512)
    assert [texts for texts in report.problems.values()] == [["expected 512 channels, got 16"]] * 3


def test_an_aspect_that_all_maps_share_is_a_note(folder):
    report = check(folder, pictures("a", "b", "c", size=(60, 150)))
    assert report.ok
    assert report.notes == {
        "": [
            "maps of another aspect than their pictures: 3 of 3 (a, b, c), all of 6 x 8 cells; each is taken to cover its "
            "whole picture"
        ]
    }


def test_a_square_grid_over_pictures_of_any_aspect_is_a_note(tmp_path):
    for i, stem in enumerate("abc"):
        np.save(tmp_path / f"{stem}.npy", features(i, (8, 8, 16)).numpy())
    views = [*pictures("a"), *pictures("b", size=(80, 60)), *pictures("c", size=(70, 70))]
    report = check(tmp_path, views)
    assert report.ok
    assert "2 of 3 (a, b), all of 8 x 8 cells" in report.notes[""][0]
    np.save(tmp_path / "b.npy", features(1, (9, 9, 16)).numpy())  # one that differs is a problem
    assert check(tmp_path, views).problems == {
        "b.npy": ["expected the aspect of a picture of 80 x 60 pixels, got 9 x 9 cells"]
    }


def test_one_grid_of_kfgs_for_pictures_of_another_aspect_is_no_problem(folder):
    Manifest({"name": "t"}, {stem: record_of(folder, stem) for stem in "abc"}).save(folder)
    report = check(folder, pictures("a", "b", "c", size=(80, 60)))  # a part of the views: all portraits
    assert report.ok
    assert "another aspect" in report.notes[""][0]
    os.utime(folder / "b.npy", ns=(1, 1))
    report = check(folder, pictures("a", "b", "c", size=(80, 60)), values=False)
    assert list(report.problems) == ["b.npy"]  # perhaps another file


def test_maps_that_are_all_transposed_are_a_problem(folder):
    report = check(folder, pictures("a", "b", "c", size=(80, 60)))
    text = "expected the aspect of a picture of 80 x 60 pixels, got 6 x 8 cells (transposed?)"
    assert report.problems == {f"{stem}.npy": [text] for stem in "abc"}


def test_maps_that_are_all_channels_last_where_they_are_to_be_first_are_a_problem(tmp_path):
    for i, stem in enumerate("ab"):
        torch.save(features(i, (12, 16, 512)), tmp_path / f"{stem}_fmap_CxHxW.pt")
    report = check(tmp_path, pictures("a", "b", size=(48, 64)))
    text = (
        "expected the aspect of a picture of 48 x 64 pixels, got 16 x 512 cells (axes of 12 channels in another order?)"
    )
    assert report.problems == {f"{stem}_fmap_CxHxW.pt": [text] for stem in "ab"}


def test_channels_first_by_the_picture_is_no_problem(folder):
    np.save(folder / "b.npy", features(1).permute(2, 0, 1).numpy())
    assert check(folder, pictures("a", "b", "c")).ok
    want = features(1)
    assert torch.equal(FeatureFolder(folder, ["a", "b"], sizes=[SIZE, SIZE])[1], want)


def test_notes_are_no_problems(folder):
    half = features(1, (70, 8, 16))  # more rows than a block
    half[:35] = 0
    for stem in "abc":
        np.save(folder / f"{stem}.npy", half.double().numpy())
    for i in range(4):
        np.save(folder / f"x{i}.npy", half.numpy())
    report = check(folder, pictures("a", "b", size=(700, 80)))
    assert report.ok
    zeros = "50 % of the features are all-zero: nothing is known there"
    assert report.notes["a.npy"] == ["double precision, which is read as single", zeros]
    assert report.notes[""] == ["maps of other views, which are not used: 5 (c, x0, x1 and 2 more)"]
    assert str(report).splitlines()[1] == "note: maps of other views, which are not used: 5 (c, x0, x1 and 2 more)"


def test_langsplat_with_masks_of_another_run(tmp_path):
    index = np.zeros((4, *SIZE), np.float32)
    index[1] = 7
    np.save(tmp_path / "a_s.npy", index)
    np.save(tmp_path / "a_f.npy", np.ones((3, 16), np.float32))
    report = check(tmp_path, pictures("a"), stride=10)
    assert (report.shape, report.ok) == ((6, 8, 16), True)
    report = check(tmp_path, pictures("a"), level="s")
    assert report.problems["a_s.npy"][0].startswith("expected mask numbers from -1 to 2")


def test_names_that_fit_no_picture_are_shown(folder):
    report = check(folder, pictures("rgb_a", "rgb_b"))
    assert report.shape is None
    assert list(report.problems) == ["rgb_a.npy", "rgb_b.npy"]
    assert "the maps there (3) are called a, b, c, but the pictures rgb_a, rgb_b" in report.notes[""][0]
    assert "0 of 2 views have a map that fits; no map could be opened" in str(report)


def test_several_files_of_one_view(folder):
    for name in ("left", "right"):
        (folder / name).mkdir()
        np.save(folder / name / "0001.npy", features(0).numpy())
    report = check(folder, pictures("0001"))
    problem = report.problems["0001.npy"]
    assert problem == [
        "expected one map for view '0001', got 2: left/0001.npy, right/0001.npy; name the subfolder itself"
    ]


def test_discarded_maps_are_a_note(tmp_path):
    np.save(tmp_path / "a.npy", features(0).numpy())
    records = {
        "a": record_of(tmp_path, "a"),
        "b": MapRecord("b.npy", (6, 8, 16), 1, 1, "0" * 64, "b.png", "0" * 64, 0.1),
    }
    Manifest({"name": "t"}, records, discarded=True).save(tmp_path)
    report = check(tmp_path, pictures("a", "b"))
    assert report.ok
    assert report.notes == {"": ["maps that were discarded once index maps had been made: 1 of 2"]}


def test_a_map_that_changed_since_kfgs_wrote_it_is_a_note(folder):
    Manifest({"name": "t"}, {stem: record_of(folder, stem) for stem in "abc"}).save(folder)
    assert check(folder, pictures("a", "b", "c")).notes == {}
    os.utime(folder / "a.npy", ns=(1, 1))  # the same bytes, as in a copy
    np.save(folder / "b.npy", features(7).numpy().astype(np.float16))  # as many others
    os.utime(folder / "b.npy", ns=(1, 1))
    np.save(folder / "c.npy", features(2).numpy())  # single precision
    report = check(folder, pictures("a", "b", "c"))
    assert report.ok
    assert list(report.notes) == ["b.npy", "c.npy"]
    assert report.notes["b.npy"][0].startswith("has changed since kfgs wrote it; `kfgs features` makes it again")
    assert report.notes["c.npy"][0].startswith(f"has changed ({(folder / 'c.npy').stat().st_size} bytes instead of ")
    report = check(folder, pictures("a", "b", "c"), values=False)  # reads neither
    assert list(report.notes) == ["a.npy", "b.npy", "c.npy"]
    for stem in "ab":
        assert report.notes[f"{stem}.npy"][0].startswith("was copied or changed since kfgs wrote it")


def test_a_view_that_kfgs_made_no_map_of_is_sent_to_its_command(folder):
    Manifest({"name": "t"}, {stem: record_of(folder, stem) for stem in "abc"}).save(folder)
    report = check(folder, pictures("a", "d"))
    assert report.problems == {"d.npy": ["missing; `kfgs features` with the --split of this view makes it"]}
    report = check(folder, pictures("d", "e"))
    (note,) = report.notes[""]
    assert note.startswith(
        "expected a feature map for each of 2 views, 2 missing: d.npy, e.npy; make them with `kfgs feat"
    )
    assert f"--split all --out {folder}`" in note


def test_a_map_without_a_record_among_kfgss_own_is_a_problem(tmp_path):
    for i, stem in enumerate(("a_s", "a_f", "b")):
        np.save(tmp_path / f"{stem}.npy", features(i).numpy())
    records = {
        stem: MapRecord(f"{stem}.npy", (6, 8, 16), 1, 1, "0" * 64, f"{stem}.png", "0" * 64, 0.1)
        for stem in ("a_s", "a_f")
    }
    Manifest({"name": "t"}, records).save(tmp_path)
    report = check(tmp_path, pictures("a_s", "a_f", "b"))
    ((name, (text,)),) = report.problems.items()
    assert name == "b.npy"
    assert text.startswith("expected a map that features.json lists")
    with pytest.raises(ValueError, match=tells("b.npy:", "features.json")):
        FeatureFolder(tmp_path, ["a_s", "a_f", "b"])


def test_bad_arguments(tmp_path):
    with pytest.raises(NotADirectoryError, match=tells("nowhere: ", "a folder of feature maps")):
        check(tmp_path / "nowhere", pictures("a"))
    with pytest.raises(ValueError, match=tells("pictures", "at least one view", "none")):
        check(tmp_path, [])


def test_the_views_to_check_are_a_scenes_a_list_or_those_of_the_folder(folder):
    np.save(folder / "b.npy", np.zeros((6, 8, 16), np.float16))
    cameras = [Camera(torch.eye(4), torch.eye(3), SIZE[1], SIZE[0], name=f"{stem}.png") for stem in "abcd"]
    paths, splits = [Path(camera.name) for camera in cameras], {"train": [0, 2], "test": [1]}
    scene = Scene(cameras, paths, torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8), splits)
    maps = FeatureFolder(folder)
    assert maps.check(scene).ok
    assert list(maps.check(scene, "test").problems) == ["b.npy"]
    assert sorted(maps.check(scene, "all").problems) == ["b.npy", "d.npy"]
    assert list(maps.check().problems) == ["b.npy"]  # without pictures, nothing is known of their sizes
    assert maps.of(scene, ["c", "a"]).check().ok
    assert "transposed?" in str(FeatureFolder(folder, ["a"], sizes=[(80, 60)]).check())
    assert maps.check(values=False).ok
