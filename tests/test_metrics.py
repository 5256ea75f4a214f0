import kornia.metrics
import numpy as np
import pytest
import skimage.metrics
import torch
from messages import refused
from oracles_color import ssim_windows
from oracles_metrics import segmentation_scores

from kfgs.metrics import ConfusionMatrix, psnr, ssim


def labels(low, high, shape, seed):
    return torch.randint(low, high, shape, generator=torch.Generator().manual_seed(seed))


def pictures(height=20, width=17, seed=0):
    rng = np.random.default_rng(seed)
    a = rng.uniform(0, 1, (height, width, 3))
    return a, np.clip(a + rng.normal(0, 0.2, a.shape), 0, 1)


def pooled(classes, *views, ignore=-1):
    matrix = ConfusionMatrix(classes, ignore=ignore)
    for pred, target in views:
        matrix.update(pred, target)
    return matrix


# confusion matrix


def counts(pred, target, classes, ignore=-1):
    return pooled(classes, (pred, target), ignore=ignore).matrix


@pytest.mark.parametrize("ignore", [255, (255, 3), [7]])
def test_ignored_labels_and_minus_one_are_not_scored(ignore):
    target = torch.tensor([0, 1, -1, 255, 3, 7])
    ignored = {-1, 255, 3, 7} & ({-1, ignore} if isinstance(ignore, int) else {-1, *ignore})
    target = target[torch.tensor([int(t) in ignored or t < 3 for t in target.tolist()])]
    matrix = counts(torch.zeros_like(target), target, 3, ignore)
    assert matrix.sum() == 2


@pytest.mark.parametrize("seed", range(5))
def test_scores_agree_with_sets_of_pixels(seed):
    views = [(labels(-1, 5, (9, 8), 10 * seed + v), labels(-1, 6, (9, 8), 100 + 10 * seed + v)) for v in range(3)]
    matrix = pooled(6, *views, ignore=2)
    pred, target = (torch.stack(part).numpy() for part in zip(*views, strict=True))
    iou, miou, accuracy = segmentation_scores(pred, target, 6, {-1, 2})
    np.testing.assert_allclose(matrix.iou().numpy(), iou, rtol=1e-12)
    assert matrix.miou() == pytest.approx(miou, rel=1e-12)
    assert matrix.accuracy() == pytest.approx(accuracy, rel=1e-12)


def test_miou_is_pooled_and_not_a_mean_over_views():
    """A class of 1 pixel in one view and of 99 in the other: pooling weighs pixels, averaging weighs views."""
    first = (torch.tensor([1] + [0] * 99), torch.tensor([0] * 100))
    second = (torch.tensor([1] * 99 + [0]), torch.tensor([1] * 99 + [0]))
    together = pooled(2, first, second).miou()
    apart = (pooled(2, first).miou() + pooled(2, second).miou()) / 2
    assert together == pytest.approx((100 / 101 + 99 / 100) / 2)
    assert apart == pytest.approx((0.99 / 2 + 1) / 2)  # the wrong reading


def test_absent_class_is_left_out():
    pred, target = torch.tensor([0, 1, 1, 1]), torch.tensor([0, 1, 1, 0])
    matrix = pooled(5, (pred, target))
    torch.testing.assert_close(matrix.iou(), torch.tensor([1 / 2, 2 / 3, *[torch.nan] * 3]).double(), equal_nan=True)
    assert matrix.miou() == pytest.approx(7 / 12)
    # the wrong reading: kornia's mean_iou scores the three absent classes 1
    assert float(kornia.metrics.mean_iou(pred[None], target[None], 5).mean()) == pytest.approx((7 / 6 + 3) / 5)


def test_abstaining_is_a_miss():
    target = torch.tensor([0, 0, 1, 1])
    silent, wrong = pooled(2, (torch.tensor([0, -1, 1, 1]), target)), pooled(2, (torch.tensor([0, 0, 1, 1]), target))
    assert silent.iou().tolist() == [0.5, 1]
    assert silent.accuracy() == 0.75
    assert silent.misses.tolist() == [1, 0]
    assert silent.matrix.tolist() == [[1, 0], [0, 2]]
    assert wrong.miou() == 1  # dropping the silent pixel instead would have given this score


def test_label_refusals():
    good = torch.tensor([0, 1])
    refused(lambda: counts(good, good[None], 2), "target:", "[2]", "got (1, 2)")
    refused(lambda: counts(good.float(), good, 2), "pred:", "got torch.float32", ".long()", error=TypeError)
    refused(lambda: counts(good, good.bool(), 2), "target:", "got torch.bool", error=TypeError)
    refused(lambda: counts(good, torch.tensor([0, 255]), 2), "target:", "[0, 2)", "got 0 to 255", "`ignore`")
    refused(lambda: counts(torch.tensor([-2, 1]), good, 2), "pred:", "[0, 2)", "got -2 to 1", "-1 for none")
    refused(lambda: ConfusionMatrix(0), "classes:", "got 0")


# pictures


def test_psnr_agrees_with_skimage_and_closed_form():
    a, b = pictures()
    ours = psnr(torch.from_numpy(a), torch.from_numpy(b))
    assert float(ours) == pytest.approx(skimage.metrics.peak_signal_noise_ratio(a, b, data_range=1.0), abs=1e-9)
    assert float(psnr(torch.zeros(2, 2, 1), torch.full((2, 2, 1), 25.5), peak=255)) == pytest.approx(20, abs=1e-4)
    assert psnr(torch.from_numpy(a), torch.from_numpy(a)) == torch.inf


def test_ssim_agrees_with_its_definition():
    a, b = pictures()
    ours = float(ssim(torch.from_numpy(a), torch.from_numpy(b)))
    assert ours == pytest.approx(ssim_windows(a, b).mean(), abs=1e-9)
    assert float(ssim(torch.from_numpy(255 * a), torch.from_numpy(255 * b), peak=255)) == pytest.approx(ours, abs=1e-9)
    # the wrong readings: reflected borders; skimage's default window of 7x7 equal weights
    batch = [torch.from_numpy(x).permute(2, 0, 1)[None] for x in (a, b)]
    assert abs(float(kornia.metrics.ssim(*batch, 11, padding="same").mean()) - ours) > 5e-3
    assert abs(skimage.metrics.structural_similarity(a, b, channel_axis=2, data_range=1.0) - ours) > 1e-3


def test_ssim_of_equal_pictures_is_one_even_when_black():
    black = torch.zeros(12, 12, 3, dtype=torch.float64)
    assert float(ssim(black, black)) == 1
    batch = black.permute(2, 0, 1)[None]
    assert float(kornia.metrics.ssim(batch, batch, 11).mean()) < 1 - 1e-6  # kornia's default eps
