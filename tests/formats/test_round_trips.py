"""Every real file through every format that can be written: opened, seen, written, read, compared with what is stated."""

import numpy as np
import pytest
import torch
from oracles_precision import assert_within

from kfgs.cameras import Camera
from kfgs.formats import SplatFile, formats, read_splats, write_splats
from kfgs.formats.order import morton_order
from kfgs.gaussians import Gaussians
from kfgs.metrics import psnr
from kfgs.splat import rasterize

FILES = {  # name: Gaussians, format
    "biker.compressed.ply": (152_746, "compressed_ply"),
    "biker.spz": (152_746, "spz"),
    "guitar.compressed.ply": (90_854, "compressed_ply"),
    "inria_9080.ply": (9_080, "ply"),
    "minimal-raw.spz": (4, "spz"),
    "minimal-v2.spz": (4, "spz"),
    "minimal-v3.spz": (4, "spz"),
    "minimal-v4.spz": (4, "spz"),
    "minimal.ksplat": (4, "ksplat"),
    "minimal.splat": (4, "splat"),
}
WRITABLE = [name for name, module in formats().items() if hasattr(module, "write")]
IN_MORTON_ORDER = ("compressed_ply", "sog")
LEAST_PSNR = {"compressed_ply": 35, "spz": 35, "sog": 25, "splat": 15}  # decibels of a picture; the others are exact


def _order(name: str, cloud: Gaussians) -> torch.Tensor:
    """Where each Gaussian of a written file comes from."""
    return morton_order(cloud.means) if name in IN_MORTON_ORDER else torch.arange(len(cloud))


def _camera(cloud: Gaussians) -> Camera:
    """A look at the middle half of a cloud from in front of it."""
    center = cloud.means.median(0).values
    radius = float((cloud.means - center).norm(dim=1).quantile(0.5)) + 3 * float(cloud.scales.median()) + 0.3
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -center + torch.tensor([0.0, 0.0, 2.2 * radius])
    return Camera(viewmat, torch.tensor([[100.0, 0, 48], [0, 100, 36], [0, 0, 1]]), 96, 72)


def _made(n: int = 500, labels: bool = True) -> SplatFile:
    g = torch.Generator().manual_seed(11)
    cloud = Gaussians(
        means=torch.randn(n, 3, generator=g),
        quats=torch.randn(n, 4, generator=g),
        scales=torch.rand(n, 3, generator=g) * 0.1 + 0.01,
        opacities=torch.rand(n, generator=g) * 0.9 + 0.05,
        sh=torch.randn(n, 9, 3, generator=g) * 0.3,
        labels=torch.randint(-1, 5, (n,), generator=g) if labels else None,
    )
    score = np.random.default_rng(0).uniform(size=n).astype(np.float32)
    return SplatFile(cloud, {"score": score}, ("wall", "chair", "plant", "Tür", "x"))


def test_no_real_file_is_left_out(shared_data):
    assert {path.name for path in (shared_data / "splats").iterdir()} == set(FILES)


@pytest.mark.parametrize("name", FILES)
def test_real_files_open_and_are_seen(shared_data, name):
    splats = read_splats(shared_data / "splats" / name)
    assert (len(splats), splats.info["format"]) == FILES[name]
    picture = rasterize(splats.gaussians, _camera(splats.gaussians))
    assert float(picture.alpha.max()) > 0.5
    assert float(picture.map.amax((0, 1)).max() - picture.map.amin((0, 1)).min()) > 0.1


@pytest.mark.parametrize("to", WRITABLE)
@pytest.mark.parametrize("name", FILES)
def test_real_files_survive_every_format(tmp_path, shared_data, name, to):
    module = formats()[to]
    cloud = read_splats(shared_data / "splats" / name).gaussians
    written = write_splats(tmp_path / f"a{module.SUFFIXES[0]}", cloud)
    back = read_splats(written.paths[0])
    assert (back.info["format"], len(written.paths)) == (to, 1)
    order, stated = _order(to, cloud), module.precision(cloud)
    if isinstance(stated.means, torch.Tensor):
        stated = stated._replace(means=stated.means[order])
    assert_within(back.gaussians, cloud.select(order), stated)


@pytest.mark.parametrize("to", WRITABLE)
def test_the_picture_survives(tmp_path, shared_data, to):
    """Against mistakes that a comparison of values shares with the format: axes, order of coefficients."""
    cloud = read_splats(shared_data / "splats" / "inria_9080.ply").gaussians
    path = tmp_path / f"a{formats()[to].SUFFIXES[0]}"
    write_splats(path, cloud)
    camera = _camera(cloud)
    before, after = (rasterize(g, camera).map.clamp(0, 1) for g in (cloud, read_splats(path).gaussians))
    assert float(before.std()) > 0.1
    assert float(psnr(after, before)) > LEAST_PSNR.get(to, 80)


@pytest.mark.parametrize("to", WRITABLE)
def test_meaning_survives_every_format(tmp_path, to):
    given = _made()
    written = write_splats(tmp_path / f"a{formats()[to].SUFFIXES[0]}", given)
    splats = given.select(_order(to, given.gaussians))
    assert (written.order is not None) == (to in IN_MORTON_ORDER)
    back = read_splats(written.paths[0])
    assert torch.equal(back.gaussians.labels, splats.gaussians.labels)
    assert (back.gaussians.means - splats.gaussians.means).abs().max() < 0.01  # and each stayed with its Gaussian
    assert back.classes == splats.classes
    np.testing.assert_array_equal(back.extra["score"], splats.extra["score"])
    assert not any("score" in word or "label" in word for word in written.lost)


@pytest.mark.parametrize("to", WRITABLE)
def test_every_format_through_every_other_and_back(tmp_path, to):
    """ply -> format -> ply -> format: the second time loses nothing more than the first, but for rounding."""
    cloud = _made(labels=False).gaussians
    suffix = formats()[to].SUFFIXES[0]
    write_splats(tmp_path / f"1{suffix}", cloud)
    once = read_splats(tmp_path / f"1{suffix}").gaussians
    write_splats(tmp_path / "2.ply", once)
    write_splats(tmp_path / f"3{suffix}", read_splats(tmp_path / "2.ply").gaussians)
    twice = read_splats(tmp_path / f"3{suffix}").gaussians
    stated = formats()[to].precision(once)
    order = _order(to, once)
    if isinstance(stated.means, torch.Tensor):
        stated = stated._replace(means=stated.means[order])
    assert_within(twice, once.select(order), stated)


@pytest.mark.parametrize("to", WRITABLE)
def test_a_failing_write_leaves_the_old_file(tmp_path, to, monkeypatch):
    path = tmp_path / f"a{formats()[to].SUFFIXES[0]}"
    write_splats(path, _made(20, labels=False))
    before = path.read_bytes()

    def fail(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="no space left"):
        write_splats(path, _made(30, labels=False))
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
