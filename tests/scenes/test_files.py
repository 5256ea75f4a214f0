import io
import struct
import tracemalloc
import warnings
import zlib

import numpy as np
import pytest
import torch
from messages import refused, tells
from PIL import Image

from kfgs.scenes import SceneError, read_image
from kfgs.scenes.files import picture_size, read_alpha
from kfgs.scenes.posed import read_depth

RNG = np.random.default_rng(0)
COLORS = RNG.integers(0, 256, (5, 7, 3), dtype=np.uint8)
ALPHA = RNG.integers(0, 256, (5, 7), dtype=np.uint8)


def read(path) -> np.ndarray:
    found = read_image(path)
    assert found.dtype == torch.float32
    assert found.is_contiguous()
    return found.numpy() * 255


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp"])
def test_colours_are_read_as_written(tmp_path, suffix):
    Image.fromarray(COLORS).save(tmp_path / f"a{suffix}", lossless=True)
    assert np.array_equal(read(tmp_path / f"a{suffix}").round(4), COLORS)


@pytest.mark.parametrize("suffix", [".png", ".webp", ".tif"])
def test_transparent_pixels_are_laid_on_white(tmp_path, suffix):
    Image.fromarray(np.dstack([COLORS, ALPHA])).save(tmp_path / f"a{suffix}", lossless=True, exact=True)
    share = ALPHA[..., None] / 255
    assert np.abs(read(tmp_path / f"a{suffix}") - (share * COLORS + (1 - share) * 255)).max() <= 0.51


def test_odd_pictures_are_converted(tmp_path):
    grey = COLORS[..., 0]
    whole = Image.fromarray(COLORS)
    white = Image.new("RGB", whole.size, "white")
    kinds = {
        "palette.png": (whole.quantize(32), np.asarray(whole.quantize(32).convert("RGB"))),
        "grey.png": (Image.fromarray(grey), grey[..., None]),
        "bits.png": (Image.fromarray(grey > 128), (grey > 128)[..., None] * 255),
        "grey16.png": (Image.fromarray(grey.astype(np.uint16) * 257), grey[..., None]),
        "grey16.tif": (Image.fromarray(grey.astype(np.uint16) * 257), grey[..., None]),
        "grey_alpha.png": (
            Image.fromarray(np.dstack([grey, ALPHA])),
            np.asarray(Image.composite(Image.fromarray(grey).convert("RGB"), white, Image.fromarray(ALPHA))),
        ),
        "cmyk.tif": (whole.convert("CMYK"), COLORS),
    }
    for name, (picture, expected) in kinds.items():
        picture.save(tmp_path / name)
        assert np.abs(read(tmp_path / name) - np.broadcast_to(expected, COLORS.shape)).max() <= 1.01, name
    whole.resize((70, 50)).convert("CMYK").save(tmp_path / "cmyk.jpg", quality=100)
    same = np.asarray(Image.open(tmp_path / "cmyk.jpg").convert("RGB"))
    assert np.array_equal(read(tmp_path / "cmyk.jpg").round(4), same)


def test_orientation_is_ignored(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    for name in ("a.tif", "a.jpg"):
        Image.fromarray(COLORS).save(tmp_path / name, exif=exif)
        assert read_image(tmp_path / name).shape == (5, 7, 3)


def test_pixels_that_are_no_colours_are_named(tmp_path):
    Image.fromarray(COLORS[..., 0].astype(np.float32)).save(tmp_path / "a.tif")
    refused(lambda: read_image(tmp_path / "a.tif"), "a.tif", "float32", "16 bits", "replace the file", error=SceneError)


def test_a_transparent_value_of_16_bit_grey_is_refused_with_what_helps(tmp_path):
    grey = Image.fromarray(np.arange(35, dtype=np.uint16).reshape(5, 7) * 1000)
    grey.save(tmp_path / "a.png", transparency=3000)
    with pytest.raises(SceneError, match=tells("a.png", "16-bit grey", "transparent", "save it with an alpha channel")):
        read_image(tmp_path / "a.png")
    clear = np.array(np.asarray(grey) == 3000)
    pixels = np.stack([np.asarray(grey) // 257, np.where(clear, 0, 255)], -1).astype(np.uint8)
    Image.fromarray(pixels, "LA").save(tmp_path / "a.png")  # what helps
    assert np.array_equal((read_image(tmp_path / "a.png", "white") == 1).all(-1), clear)
    assert np.array_equal(read_alpha(tmp_path / "a.png") == 0, clear)


def png(width: int, height: int, rows: bytes) -> bytes:
    """A grey PNG whose header states any size."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


@pytest.mark.parametrize(("width", "height"), [(14_000, 14_000), (60_000, 60_000), (9_000, 9_000), (1 << 30, 1 << 30)])
def test_a_small_file_of_many_pixels_is_refused_before_memory_is_asked_for(tmp_path, width, height):
    file = tmp_path / "a.png"
    file.write_bytes(png(width, height, b"\0" * 100_000))
    readers = (read_image, picture_size, read_depth)
    tracemalloc.start()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for reader in readers:
                refused(lambda reader=reader: reader(file), file, "expected a", "cannot be decoded", error=SceneError)
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()


def test_what_a_decoder_raises_is_named(tmp_path, monkeypatch):
    jpeg, tiff, webp = b"\xff\xd8\xff\xe0" + bytes(100), b"II*\0" + bytes(60), b"RIFF\0\0\0\0WEBPVP8 "
    for content in (b"", jpeg, png(7, 5, b"\0" * 3), tiff, webp):
        (tmp_path / "a.png").write_bytes(content)
        with pytest.raises(SceneError, match=tells("a.png", "PNG, JPEG, TIFF or WebP", "cannot be decoded", "replace")):
            read_image(tmp_path / "a.png")
    for path in (tmp_path / "none.png", tmp_path):
        refused(lambda path=path: read_image(path), path, "no such file", error=FileNotFoundError)
    buffer = io.BytesIO()
    Image.fromarray(COLORS).save(buffer, "PNG")
    (tmp_path / "a.png").write_bytes(buffer.getvalue())

    def short(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(Image.Image, "convert", short)
    refused(lambda: read_image(tmp_path / "a.png"), "a.png", "MemoryError", error=SceneError)


def test_depth_of_a_palette_is_refused_as_its_numbers_are_colours(tmp_path):
    numbers = Image.fromarray(np.arange(12, dtype=np.uint16).reshape(3, 4) * 1000)
    numbers.save(tmp_path / "depth.png")
    assert read_depth(tmp_path / "depth.png").tolist() == (np.arange(12).reshape(3, 4) * 1000).tolist()
    indexed = Image.fromarray(np.arange(12, dtype=np.uint8).reshape(3, 4))
    indexed.putpalette(bytes(range(255, -1, -1)) * 3)
    indexed.save(tmp_path / "shown.png")
    with pytest.raises(SceneError, match=tells("shown.png: expected a depth PNG", "palette")) as caught:
        read_depth(tmp_path / "shown.png")
    assert "decoded" not in str(caught.value)
