import numpy as np
import pytest
import torch
from oracles_color import ssim_windows

from kfgs.fields import ColorLoss, loss
from kfgs.fields.loss import l1_loss, mean_similarity
from kfgs.metrics import ssim


def pictures(height=23, width=31, dtype=torch.float64, seed=0):
    g = torch.Generator().manual_seed(seed)
    a = torch.rand(height, width, 3, generator=g, dtype=dtype)
    return a, (0.6 * a + 0.4 * torch.rand(height, width, 3, generator=g, dtype=dtype)).clamp(0, 1)


@pytest.fixture(params=["compiled", "kornia"])
def path(request, monkeypatch):
    """Both ways to SSIM: compiled code, and kornia's."""
    if request.param == "compiled":
        pytest.importorskip("numba")
    else:
        monkeypatch.setattr(loss, "compiled_ssim", lambda *tensors: None)
    return request.param


def test_similarity_is_the_mean_over_windows(path):
    a, b = pictures()
    assert float(mean_similarity(a, b)) == pytest.approx(ssim_windows(a, b).mean(), abs=1e-12)
    assert float(mean_similarity(a, b)) == pytest.approx(float(ssim(a, b)), abs=1e-12)
    assert float(mean_similarity(a, a)) == pytest.approx(1.0, abs=1e-12)


def test_windows_with_an_unknown_pixel_do_not_count(path):
    a, b = pictures()
    b[3, 4] = torch.nan
    b[20:, 25:] = torch.nan
    windows = ssim_windows(a, torch.where(b.isnan(), 0, b))
    counted = np.lib.stride_tricks.sliding_window_view(~b.isnan().any(2).numpy(), (11, 11)).all((2, 3))
    assert 0 < counted.sum() < counted.size
    assert float(mean_similarity(a, b)) == pytest.approx(windows[counted].mean(), abs=1e-12)
    wild = torch.where(b.isnan(), 1e3, a)  # what is rendered there does not matter
    assert float(mean_similarity(wild, b)) == pytest.approx(windows[counted].mean(), abs=1e-12)


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_a_pixel_unknown_in_one_channel_is_unknown(path, channel):
    a, b = pictures()
    b[3, 4, channel], b[20:, 25:, channel] = torch.nan, torch.nan
    whole = torch.where(b.isnan().any(dim=2, keepdim=True), torch.nan, b)
    for measure in (mean_similarity, lambda x, y: l1_loss(x, x[..., 0], y)):
        assert 0 < float(measure(a, b)) == float(measure(a, whole))


def test_gradient_of_the_similarity_is_that_of_finite_differences(path):
    a, b = (picture[..., :1] for picture in pictures(12, 13))
    assert torch.autograd.gradcheck(lambda x: mean_similarity(x, b), a.clone().requires_grad_())
    b[0, 0] = torch.nan
    assert torch.autograd.gradcheck(lambda x: mean_similarity(x, b), a.clone().requires_grad_())


def test_nothing_known_is_no_loss(path):
    a, b = pictures()
    assert float(mean_similarity(a, b * torch.nan)) == 1.0
    assert float(ColorLoss()(a, a[..., 0], b * torch.nan)) == 0.0


def test_color_loss_mixes_l1_and_dissimilarity():
    a, b = pictures()
    absolute, similar = float((a - b).abs().mean()), float(ssim_windows(a, b).mean())
    assert float(ColorLoss(0.2)(a, a[..., 0], b)) == pytest.approx(0.8 * absolute + 0.2 * (1 - similar), abs=1e-12)
    assert float(ColorLoss(1.0)(a, a[..., 0], b)) == pytest.approx(1 - similar, abs=1e-12)
    assert float(ColorLoss(0.0)(a, a[..., 0], b)) == float(l1_loss(a, a[..., 0], b))
    assert float(ColorLoss(0.2)(a[:10], a[:10, :, 0], b[:10])) == float(l1_loss(a[:10], a[:10, :, 0], b[:10]))


def test_the_opacity_of_a_photograph_is_a_channel_more(path):
    """The same as the loss of two pictures with four channels, with gradients in the colours and in the opacity."""
    a, b = pictures()
    alpha, wanted = a.roll(3, 0)[..., 0].clone(), b.roll(5, 1)[..., 1]
    inputs = [a.clone().requires_grad_(), alpha.requires_grad_()]
    four = torch.cat([inputs[0], inputs[1][..., None]], 2)
    target = torch.cat([b, wanted[..., None]], 2)
    value, want = ColorLoss()(*inputs, target), ColorLoss()(four, alpha, target)
    assert value.item() == want.item()
    torch.testing.assert_close(torch.autograd.grad(value, inputs), torch.autograd.grad(want, inputs))
    assert ColorLoss(0.0)(*inputs, target).item() == pytest.approx((four - target).abs().mean().item(), abs=1e-12)


@pytest.mark.parametrize("channels", [1, 2, 5])
@pytest.mark.parametrize("measure", [l1_loss, ColorLoss()])
def test_maps_of_other_channels_are_refused(measure, channels):
    a, _ = pictures()
    with pytest.raises(ValueError, match=rf"rendered: expected \[H, W, {channels}\]"):
        measure(a, a[..., 0], torch.zeros(23, 31, channels, dtype=a.dtype))
    with pytest.raises(ValueError, match=r"\(height\).* got 0"):
        measure(a, a[..., 0], torch.zeros(0, 40, 3, dtype=a.dtype))


@pytest.mark.parametrize("measure", [l1_loss, ColorLoss()])
def test_a_target_that_needs_a_gradient_gets_one(measure):
    """Both parts are symmetric, so the target's gradient is that of the picture with the two exchanged."""
    a, b = (picture.requires_grad_() for picture in pictures())
    (found,) = torch.autograd.grad(measure(a, a[..., 0], b), b)
    (expected,) = torch.autograd.grad(measure(b, b[..., 0], a), b)
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("size", [(4, 3), (5, 7), (12, 9), (4, 30), (24, 18)])
def test_every_rendered_pixel_learns_from_a_small_target(size):
    g = torch.Generator().manual_seed(0)
    rendered, target = torch.rand(24, 18, 2, generator=g).requires_grad_(), torch.rand(*size, 2, generator=g)
    loss = l1_loss(rendered, torch.ones(24, 18), target)
    loss.backward()
    assert rendered.grad.ne(0).any(dim=2).all()
    if size == (4, 3):  # repeated three times, then each pixel is compared with the mean of 2 x 2
        blocks = rendered.detach().unfold(0, 2, 2).unfold(1, 2, 2).mean(dim=(3, 4))
        repeated = target[torch.arange(12) // 3][:, torch.arange(9) // 3]
        assert loss.item() == pytest.approx((blocks - repeated).abs().mean().item())


def test_at_the_papers_ratio_the_loss_is_plain_bilinear():
    g = torch.Generator().manual_seed(1)
    rendered, target = torch.rand(48, 64, 3, generator=g), torch.rand(36, 48, 3, generator=g)
    small = torch.nn.functional.interpolate(rendered.permute(2, 0, 1)[None], (36, 48), mode="bilinear")[0].permute(
        1, 2, 0
    )
    assert torch.equal(l1_loss(rendered, rendered[..., 0], target), (small - target).abs().sum() * (1 / target.numel()))
