"""The labelled points of SceneSplat-Bench, in files that are written here in their layout."""

from pathlib import Path

import numpy as np
from meshes import XYZ
from messages import refused
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
    refused(lambda: open_points(None, scene), scene, "one file of labels", "segment20.npy, segment200.npy")
