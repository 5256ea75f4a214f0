import json
import math
import zipfile

import gsply.sog_reader
import numpy as np
import pytest
import torch
from cases_gltf import random_cloud
from messages import refused
from oracles_packed import smallest_three
from oracles_precision import assert_within, precision, rotation_angles
from oracles_sog import decode, encode, pack, sog_gaussian, unpack

from kfgs import Gaussians
from kfgs.formats import find_format, read_splats, write_splats
from kfgs.formats.encodings import pack_smallest_three, unpack_smallest_three
from kfgs.formats.sog import read, write


def _cloud(n: int = 700, degree: int = 3) -> Gaussians:
    cloud = random_cloud(n, degree)
    means, scales = cloud.means * torch.tensor([1.0, 50.0, 0.2]) + 3, (4 * cloud.scales - 5).exp()
    return cloud.replace(means=means, quats=3 * cloud.quats, scales=scales, sh=0.3 * cloud.sh)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A small scene of degree 1 as its files, to be damaged."""
    path = tmp_path_factory.mktemp("scene") / "a.sog"
    write(path, _cloud(70, 1).to(torch.float64))
    return unpack(path)


def _gsply_reads(path, monkeypatch):
    """gsply without its decoder of images, which is not a dependency here."""
    monkeypatch.setattr(
        gsply.sog_reader, "_load_webp_image", lambda data: ((a := decode(data)).ravel(), a.shape[1], a.shape[0])
    )
    return gsply.sog_reader.sogread(str(path))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_made_clouds_survive_and_others_read_them(tmp_path, monkeypatch, degree):
    cloud, path = _cloud(1500, degree), tmp_path / "a.sog"
    written = write_splats(cloud, path)
    order, stated, back = written.order, precision("sog", cloud), read(path)
    assert written.lost == ()
    assert_within(back, cloud.select(order), stated._replace(means=stated.means[order]))
    files = unpack(path)
    for i in (0, 777, 1499):
        for name, expected in sog_gaussian(files, i).items():
            np.testing.assert_allclose(getattr(back, name)[i].numpy(), expected, rtol=2e-6, atol=1e-6, err_msg=name)
    other = _gsply_reads(path, monkeypatch)
    np.testing.assert_allclose(other.means, back.means.numpy(), rtol=2e-5, atol=1e-6)
    np.testing.assert_allclose(np.exp(other.scales), back.scales.numpy(), rtol=1e-5)
    assert rotation_angles(other.quats, back.quats.numpy()).max() < 1e-5
    np.testing.assert_allclose(other.sh0, back.sh[:, 0].numpy(), rtol=0, atol=1e-6)
    np.testing.assert_allclose(other.shN, back.sh[:, 1:].numpy(), rtol=0, atol=1e-6)
    inner = (back.opacities > 0) & (back.opacities < 1)
    opacities = 1 / (1 + np.exp(-other.opacities))
    np.testing.assert_allclose(opacities[inner], back.opacities[inner].numpy(), rtol=0, atol=1e-5)


def test_a_folder_and_its_meta_are_read_like_the_zip(tmp_path):
    cloud = _cloud(100).replace(labels=torch.arange(100) % 3)
    order = write_splats(cloud, tmp_path / "scene.sog").order
    (tmp_path / "scene").mkdir()
    for name, data in unpack(tmp_path / "scene.sog").items():
        (tmp_path / "scene" / name).write_bytes(data)
    zipped = read_splats(tmp_path / "scene.sog")
    for path in (tmp_path / "scene", tmp_path / "scene" / "meta.json"):
        assert find_format(path).NAME == "sog"
        back = read_splats(path)
        for name in ("means", "quats", "scales", "opacities", "sh"):
            assert torch.equal(getattr(back, name), getattr(zipped, name))
        assert torch.equal(zipped.labels, cloud.labels[order])


def test_equal_clouds_give_equal_files(tmp_path):
    for name in "ab":
        write(tmp_path / f"{name}.sog", _cloud(2100, 2).to(torch.float64))
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


@pytest.mark.parametrize("n", [0, 1, 65])
def test_few_gaussians_survive(tmp_path, n):
    cloud = _cloud(n, 3)
    order = write_splats(cloud, tmp_path / "a.sog").order
    back = read(tmp_path / "a.sog")
    if n:
        stated = precision("sog", cloud)
        assert_within(back, cloud.select(order), stated._replace(means=stated.means[order]))
    else:
        assert (len(back), precision("sog", cloud).means.shape) == (0, (0, 3))


def test_rotations_by_their_three_smaller_components():
    quats = torch.randn(4000, 4, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    quats[:3] = torch.tensor([[1.0, 1, 1, 1], [-1, 1, -1, 1], [0, 0, 0, 0]])
    for steps, bound in ((255, 0.0197), (1023, 0.0049)):  # 2 sqrt(12) half steps of sqrt(2) / steps
        largest, small = pack_smallest_three(quats, steps)
        back = unpack_smallest_three(largest[:, 0], small.astype(np.float32), steps).double().numpy()
        assert rotation_angles(back[3:], quats[3:].numpy()).max() < bound
        assert rotation_angles(back[3:], quats[3:].numpy()).max() > 0.6 * bound  # the bound is near
        np.testing.assert_allclose(np.linalg.norm(back, axis=1), 1, atol=1e-6)
        assert rotation_angles(back[2:3], np.array([[1.0, 0, 0, 0]])) < bound
        for i in (0, 1, 5, 9):
            np.testing.assert_allclose(back[i], smallest_three(int(largest[i, 0]), small[i].tolist(), steps), atol=1e-6)


def test_images_of_other_kinds_and_a_missing_first_code(tmp_path, scene):
    meta = json.loads(scene["meta.json"])
    book = meta["scales"]["codebook"]
    lowest = book[1] + (book[1] - book[255]) / 255
    meta["scales"] |= {"codebook": [None, *book[1:]], "files": ["size.png"]}
    pixels = decode(scene["scales.webp"])
    pixels[0, 0, :3] = 0
    files = scene | {"meta.json": json.dumps(meta).encode(), "size.png": encode(pixels[..., :3], "PNG")}
    back = read(pack(tmp_path / "a.sog", files))
    torch.testing.assert_close(back.scales[0], torch.full((3,), math.exp(lowest)))


def _changed(scene, *keys, to):
    """The scene with one value of `meta.json` changed, or taken out where `to` is ..."""
    meta = json.loads(scene["meta.json"])
    inner = meta
    for key in keys[:-1]:
        inner = inner[key]
    if to is ...:
        del inner[keys[-1]]
    else:
        inner[keys[-1]] = to
    return scene | {"meta.json": json.dumps(meta).encode()}


@pytest.mark.parametrize(
    ("keys", "to"),
    [
        (("version",), 3),
        (("version",), ...),
        (("count",), 10**12),
        (("count",), 2_000_000),  # more than a file of this size may unpack to
        (("count",), -1),
        (("count",), 70.0),
        (("count",), 5000),  # more than the images have pixels
        (("means", "mins"), [0.0, math.nan, 0.0]),
        (("means", "maxs"), [0.0, 1.0]),
        (("means", "files"), ["means_l.webp"]),
        (("means", "files"), ["means_l.webp", "../means_u.webp"]),
        (("quats", "files"), ["/etc/passwd"]),
        (("quats", "files"), ["a\\b"]),
        (("quats", "files"), [7]),
        (("quats", "files"), ["none.webp"]),
        (("quats",), ...),
        (("scales", "codebook"), "abc"),
        (("scales", "codebook"), [1.0]),
        (("scales", "codebook"), [1000.0] * 256),
        (("shN", "bands"), 5),
        (("shN", "bands"), 2),
        (("shN", "count"), 10**6),
        (("shN", "count"), 10),
    ],
)
def test_a_damaged_meta_is_named(tmp_path, scene, keys, to):
    path = pack(tmp_path / "bad.sog", _changed(scene, *keys, to=to))
    refused(lambda: read_splats(path), "bad.sog: expected")


def test_damaged_images_are_named(tmp_path, scene):
    quats = decode(scene["quats.webp"])
    quats[0, 3, 3] = 200
    cases = [
        scene | {"quats.webp": encode(quats)},
        scene | {"sh0.webp": scene["sh0.webp"][:-40]},
        scene | {"scales.webp": b"GIF89a" + bytes(99)},
        scene | {"means_u.webp": encode(np.zeros((2000, 2000, 3)))},
        scene | {"sh0.webp": bytes(10**7)},
        scene | {"shN_centroids.webp": encode(np.zeros((8, 96, 3)))},
    ]
    for files in cases:
        refused(lambda files=files: read_splats(pack(tmp_path / "bad.sog", files)), "bad.sog: expected")


def test_zip_files_that_are_none_or_hostile_are_named(tmp_path, scene):
    path = tmp_path / "bad.sog"
    whole = pack(path, scene).read_bytes()
    at = whole.index(b"meta.json") + 60
    contents = [
        b"PK\x03\x04 and then nothing of the kind",
        whole[: len(whole) // 2],
        whole[:at] + bytes(20) + whole[at + 20 :],
    ]
    # the second: 100 KB that would become 100 MB
    for meta in (None, bytes(10**8), b"{", b"[1]", b"[" * 100000):
        files = {"other.txt": b"x"} if meta is None else {"meta.json": meta}
        contents.append(pack(path, files).read_bytes())
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("meta.json", scene["meta.json"])
    contents.append(path.read_bytes())
    for content in contents:
        path.write_bytes(content)
        refused(lambda: read_splats(path), "bad.sog: expected")


def test_a_folder_without_all_files_is_named(tmp_path, scene):
    folder = tmp_path / "scene"
    folder.mkdir()
    for name, data in scene.items():
        (folder / name).write_bytes(data)
    assert len(read_splats(folder)) == 70
    (folder / "sh0.webp").unlink()
    refused(lambda: read_splats(folder), "scene", "sh0.webp", "No such file")
