"""The labelled points of SceneSplat-Bench, in files that are written here in their layout."""

from pathlib import Path

import numpy as np
import pytest
from meshes import XYZ
from messages import tells
from published.truth.find import open_points
from published.truth.scenesplat import load_scenesplat_points


def _scenesplat(folder: Path, **arrays: object) -> Path:
    folder.mkdir(exist_ok=True)
    np.save(folder / "coord.npy", XYZ.astype(np.float64))
    for name, values in arrays.items():
        np.save(folder / f"{name}.npy", np.asarray(values))
    return folder


def test_scenesplat_points(tmp_path: Path) -> None:
    twenty, many = [-1, 0, 15, 19, 2, 2], [-1, 0, 47, 199, 2, 3]
    scene = _scenesplat(tmp_path / "a", segment20=twenty, segment200=many, instance=[-1, 7, 7, 0, 1, 1])
    truth = load_scenesplat_points(scene, "scannet20")
    assert truth.points.tolist() == XYZ.tolist()
    assert truth.labels.tolist() == twenty
    assert [truth.names[i] for i in (0, 15, 19)] == ["wall", "shower curtain", "other furniture"]
    assert truth.instances is not None
    assert truth.instances.tolist() == [-1, 7, 7, 0, 1, 1]
    assert load_scenesplat_points(scene, "scannet200").names[199] == "mattress"
    assert load_scenesplat_points(scene / "segment200.npy").labels.tolist() == many  # its name says the benchmark
    assert open_points(None, scene, benchmark="scannet200")[0].labels.tolist() == many
    assert open_points(None, scene / "segment20.npy")[0].labels.tolist() == twenty
    with pytest.raises(ValueError, match=tells(scene, "one file of labels", "segment20.npy, segment200.npy")):
        open_points(None, scene)


def test_scenesplat_points_of_several_labels(tmp_path: Path) -> None:
    several = np.array([[5, 9], [99, -1], [-1, -1], [0, 1], [1, 0], [2, 2]], np.int16)
    scene = _scenesplat(tmp_path / "a", segment=several)
    truth = load_scenesplat_points(scene, "scannetpp100")
    assert (truth.labels.tolist(), truth.instances) == ([5, 99, -1, 0, 1, 2], None)
    assert truth.names[99] == "marker"
    with pytest.raises(ValueError, match=tells("segment.npy", "[6]", "[6, 2]", "one scene")):
        load_scenesplat_points(scene, "matterport21")
    with pytest.raises(
        ValueError, match=tells("benchmark", "scannetpp100, matterport21, holicity4", "segment.npy", "None")
    ):
        load_scenesplat_points(scene)
    column = _scenesplat(tmp_path / "b", segment=several[:, 1:] * 0 + 3)
    assert load_scenesplat_points(column, "holicity4").labels.tolist() == [3] * 6


@pytest.mark.parametrize(
    ("name", "values", "parts"),
    [
        ("segment20", [0] * 5, ("segment20.npy", "[6] whole numbers", "[5]")),
        ("segment20", [0, 1, 2, 3, 4, 20], ("segment20.npy", "-1 (none) to 19", "0 to 20", "another benchmark")),
        ("segment20", [0, 1, 2, 3, 4, -100], ("segment20.npy", "-1 (none) to 19", "-100 to 4")),
        ("segment20", [0.0] * 6, ("segment20.npy", "whole numbers", "float64")),
        ("segment20", 3, ("segment20.npy", "whole numbers", "int64")),
        ("instance", [0, 1, 2, 3, 4, -2], ("instance.npy", "-1 (none) upwards", "-2 to 4")),
        ("instance", [[0, 1]] * 6, ("instance.npy", "[6, 2]")),
        ("coord", [[0.0, 1.0]] * 6, ("coord.npy", "finite coordinates [Q, 3]", "[6, 2]")),
        ("coord", [[0.0, 1.0, np.nan]] * 6, ("coord.npy", "finite coordinates [Q, 3]")),
    ],
)
def test_scenesplat_points_that_do_not_fit(tmp_path: Path, name: str, values: object, parts: tuple[str, ...]) -> None:
    scene = _scenesplat(tmp_path / "a", **{"segment20": [0] * 6, name: values})
    with pytest.raises(ValueError, match=tells(*parts)):
        load_scenesplat_points(scene, "scannet20")


def test_scenesplat_points_that_are_damaged_or_missing(tmp_path: Path) -> None:
    scene = _scenesplat(tmp_path / "a", segment20=[0] * 6)
    with pytest.raises(ValueError, match=tells("benchmark", "scannet20", "'scannet'")):
        load_scenesplat_points(scene, "scannet")
    with pytest.raises(
        FileNotFoundError, match=tells(scene, "segment200.npy", "scannet200", "coord.npy, segment20.npy")
    ):
        load_scenesplat_points(scene, "scannet200")
    whole = (scene / "segment20.npy").read_bytes()
    for damaged in (b"", b"no array", whole[:-7], b"\x80\x04K\x01."):  # the last is a pickle
        (scene / "segment20.npy").write_bytes(damaged)
        with pytest.raises(ValueError, match=tells("segment20.npy", "cannot be read", "copy the file again")):
            load_scenesplat_points(scene, "scannet20")
    (scene / "segment20.npy").write_bytes(whole)
    (scene / "coord.npy").unlink()
    with pytest.raises(FileNotFoundError, match=tells("coord.npy", "no such file")):
        load_scenesplat_points(scene, "scannet20")
