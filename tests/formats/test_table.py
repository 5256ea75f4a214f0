import numpy as np
import pytest
import torch
from cases_gltf import random_cloud
from messages import refused, tells

from kfgs import Gaussians
from kfgs.formats import find_format, read_splats, write_splats
from kfgs.formats.sidecar import LABELS, NAMES, beside
from kfgs.formats.table import formats


def _cloud(n: int = 9, labels: bool = True) -> Gaussians:
    return random_cloud(n, 0, labels=torch.arange(n) % 3 - 1 if labels else None)


def test_every_format_keeps_the_contract():
    for name, module in formats().items():
        assert name == module.NAME
        assert all(suffix.startswith(".") and suffix == suffix.lower() for suffix in module.SUFFIXES)
        assert name in ("splat", "ksplat") or module.matches(b"") is False
        assert callable(module.read)
        assert hasattr(module, "write") == (name not in ("ksplat", "checkpoint"))
        assert module.__doc__
    assert {"ply", "compressed_ply", "spz", "sog", "gltf", "ksplat", "splat", "checkpoint"} == set(formats())


@pytest.mark.parametrize("name", ["ply", "compressed_ply", "spz", "sog", "gltf"])
def test_content_goes_before_the_name(tmp_path, name):
    module = formats()[name]
    write_splats(_cloud(labels=False), tmp_path / f"a{module.SUFFIXES[0]}")
    (tmp_path / f"a{module.SUFFIXES[0]}").rename(tmp_path / "renamed.splat")
    assert find_format(tmp_path / "renamed.splat") is module
    assert len(read_splats(tmp_path / "renamed.splat")) == 9


@pytest.mark.parametrize(
    ("file", "name"),
    [("a.ply", "ply"), ("a.compressed.ply", "compressed_ply"), ("A.PLY", "ply"), ("a.b.SPZ", "spz"), ("a.glb", "gltf"),
     ("a.gltf", "gltf"), ("a.splat", "splat"), ("a.sog", "sog")],
)  # fmt: skip
def test_the_ending_chooses_the_format(tmp_path, file, name):
    written = write_splats(_cloud(labels=False), tmp_path / file)
    assert written.paths == [tmp_path / file]
    assert name == find_format(tmp_path / file).NAME


def test_bad_requests_are_named(tmp_path):
    refused(lambda: read_splats(tmp_path / "none.ply"), "none.ply:", "no such file", "splat", error=FileNotFoundError)
    (tmp_path / "a.txt").write_text("hello")
    refused(lambda: read_splats(tmp_path / "a.txt"), "a.txt:", "compressed_ply")
    refused(lambda: read_splats(tmp_path), "splat", "known", "compressed_ply")
    refused(lambda: write_splats(_cloud(), tmp_path / "a.obj"), "path:", "a.obj; it chooses")
    with pytest.raises(ValueError, match=tells("path:", "a.ksplat; it chooses")):  # read only
        write_splats(_cloud(), tmp_path / "a.ksplat")
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]


def test_labels_beyond_the_names_are_refused(tmp_path):
    path = tmp_path / "a.ply"
    write_splats(_cloud().replace(names=("a", "b")), path)
    assert read_splats(path).names == ("a", "b")
    beside(path, NAMES).write_text('{"class_id": {"0": "a"}}')
    refused(lambda: read_splats(path), "a.ply:", "got -1 to 1", "a.ply.classes")


def test_labels_of_an_older_file_do_not_stay(tmp_path):
    path = tmp_path / "a.splat"
    write_splats(_cloud().replace(names=("a", "b")), path)
    assert beside(path, LABELS).is_file()
    write_splats(_cloud(5, labels=False), path)
    assert read_splats(path).labels is None
    assert not beside(path, LABELS).is_file()
    write_splats(_cloud(), path)  # labels without names
    assert read_splats(path).names == ()


def test_features_scores_and_labels_beyond_the_names_are_checked(tmp_path):
    path, cloud = tmp_path / "a.ply", _cloud()
    with pytest.raises(ValueError, match=tells("features:", "got [inf, inf]")):
        write_splats(cloud.replace(features=torch.full((9, 2), torch.inf)), path)
    refused(lambda: write_splats(cloud.replace(names=("a",)), path), "labels:", "expected -1", "got [1]")
    refused(lambda: write_splats(cloud.replace(scores=np.full(9, np.nan)), path), "scores:", "got [nan]")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("file", ["a.ply", "a.compressed.ply", "a.sog", "a.spz", "a.splat", "a.glb"])
def test_opacities_of_0_and_1_are_written(tmp_path, file):
    cloud = _cloud(2, labels=False).replace(opacities=torch.tensor([0.0, 1.0]))
    order = write_splats(cloud, tmp_path / file).order
    back = read_splats(tmp_path / file).opacities
    expected = cloud.opacities if order is None else cloud.opacities[order]
    torch.testing.assert_close(back, expected, rtol=0, atol=2e-7)
