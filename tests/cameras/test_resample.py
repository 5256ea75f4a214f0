import pytest
import torch
from messages import refused, tells

from kfgs.cameras import from_bchw, resize_map, to_bchw
from kfgs.cameras.resample import fits_aspect, resize_labels


def ramp(height, width, dtype=torch.float64):
    """[H, W, 2] holding each pixel centre's own coordinates (x, y)."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([x, y], -1).to(dtype)


def test_ramp_of_pixel_centers_stays_exact():
    """From 639x479, the size of the shared scene, to the teacher's 480x360: linear sampling of a linear function."""
    height, width, h, w = 479, 639, 360, 480
    source = ramp(height, width)
    expected = ramp(h, w) * torch.tensor([width / w, height / h], dtype=torch.float64)
    torch.testing.assert_close(resize_map(source, (h, w)), expected)


@pytest.mark.parametrize("size", [(3, 4), (9, 11)])
def test_resize_gradcheck(size):
    source = torch.rand(5, 6, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: resize_map(x, size), source)


def test_antialias_reaches_every_pixel_at_a_factor_of_four():
    for antialias, share in ((False, 0.25), (True, 1.0)):
        source = torch.rand(16, 16, 1, generator=torch.Generator().manual_seed(0)).requires_grad_()
        resize_map(source, (4, 4), antialias=antialias).sum().backward()
        assert (source.grad != 0).double().mean() == pytest.approx(share)


def test_labels_take_the_pixel_under_the_new_center():
    labels = torch.arange(6 * 8).reshape(6, 8)
    small = resize_labels(labels, (2, 2))  # centres at rows 1.5, 4.5 and columns 2, 6
    assert small.tolist() == [[1 * 8 + 2, 1 * 8 + 6], [4 * 8 + 2, 4 * 8 + 6]]
    # the trap: torch's and kornia's "nearest" take the pixel at the corner
    corner = torch.nn.functional.interpolate(labels[None, None].double(), (2, 2), mode="nearest")[0, 0]
    assert corner.tolist() == [[0, 4], [24, 28]]


@pytest.mark.parametrize("size", [(7, 5), (13, 31), (1, 1), (479, 639), (60, 80)])
def test_labels_agree_with_nearest_exact(size):
    labels = torch.randint(0, 200, (48, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    expected = torch.nn.functional.interpolate(labels[None, None], size, mode="nearest-exact")[0, 0]
    assert torch.equal(resize_labels(labels, size), expected)


def test_resample_refusals():
    refused(lambda: resize_map(torch.zeros(4, 5), (2, 2)), "map:", "[H, W, D]", "got (4, 5)")
    with pytest.raises(TypeError, match=tells("map:", "got torch.int64", "resize_labels")):
        resize_map(torch.zeros(4, 5, 1, dtype=torch.int64), (2, 2))
    refused(lambda: resize_labels(torch.zeros(4, 5, 1, dtype=torch.int64), (2, 2)), "labels:", "got (4, 5, 1)")
    refused(lambda: resize_labels(torch.zeros(4, 5), (2, 2)), "torch.float32", "resize_map", error=TypeError)
    for size, got in (((0, 2), "0"), ((2.5, 2), "2.5"), ((1, 2, 3), "(1, 2, 3)")):
        refused(lambda size=size: resize_map(torch.zeros(4, 5, 1), size), "size", "height", f"got {got}")


def test_channels_first_are_noticed_and_turned():
    batch = torch.rand(1, 8, 34, 46, generator=torch.Generator().manual_seed(0))
    refused(lambda: resize_map(batch[0], (68, 92)), "map:", "68 x 92", "got (8, 34, 46)", "kfgs.cameras.from_bchw")
    map = from_bchw(batch)
    assert torch.equal(map, from_bchw(batch[0]))
    assert torch.equal(map[3, 5], batch[0, :, 3, 5])
    assert torch.equal(to_bchw(map), batch)
    odd = torch.rand(60, 40, 30)  # channels last, and its last two axes happen to have the new aspect
    refused(lambda: resize_map(odd, (64, 48)), "map:", "got (60, 40, 30)", "kornia's resize of to_bchw(map)")
    refused(lambda: from_bchw(batch.repeat(2, 1, 1, 1)), "batch:", "[1, D, H, W]", "got (2, 8, 34, 46)")
    for shape, size in (
        ((34, 46, 8), (68, 92)),
        ((24, 24, 32), (48, 64)),
        ((24, 18, 2), (4, 30)),
        ((30, 4, 3), (4, 4)),
    ):
        assert resize_map(torch.zeros(shape), size).shape == (*size, shape[2])  # right ones, also to another aspect


@pytest.mark.parametrize(
    ("cells", "size", "fits"),
    [
        ((90, 120), (360, 480), True),
        ((26, 64), (430, 1036), True),  # 26.6 rows, cut
        ((48, 64), (479, 640), True),
        ((120, 90), (360, 480), False),
        ((92, 120), (360, 480), False),
    ],
)
def test_aspect_up_to_one_cell(cells, size, fits):
    assert fits_aspect(cells, size) is fits
    assert fits_aspect(size, cells) is fits
