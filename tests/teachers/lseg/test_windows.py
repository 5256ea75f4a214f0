"""Sliding windows over several scales, against closed forms and the evaluation written step by step."""

import numpy as np
import pytest
import torch
from oracles_windows import evaluate
from torch import Tensor
from torch.nn import functional

from kfgs.teachers.lseg.windows import multi_scale_features, scaled_size, window_starts

PAPER = (0.75, 1.0, 1.25, 1.75)


def network(window: int, dim: int, seed: int = 0):
    """A random network [1, 3, S, S] -> [1, D, S/2, S/2] whose output depends on where in the window something lies."""
    generator = torch.Generator().manual_seed(seed)
    kernel = torch.randn(dim, 3, 5, 5, generator=generator, dtype=torch.float64) / 3
    place = torch.randn(dim, window // 2, window // 2, generator=generator, dtype=torch.float64)

    def head(x: Tensor) -> Tensor:
        assert x.shape == (1, 3, window, window)
        found = functional.conv2d(x, kernel.to(x.dtype), stride=2, padding=2)
        return torch.tanh(found) * (2 + place.to(x.dtype)) + place.to(x.dtype)

    return head


def picture(height: int, width: int, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(height * 1000 + width)
    return (torch.rand(3, height, width, generator=generator, dtype=torch.float64) * 2 - 1).to(dtype)


def oracle(image: Tensor, head, window: int, scales, flip: bool) -> Tensor:
    found = evaluate(image.double().numpy(), lambda x: head(torch.from_numpy(x)[None])[0].numpy(), window, scales, flip)
    return torch.from_numpy(np.ascontiguousarray(found))


SIZES = {"the window": (64, 64), "portrait": (70, 40), "narrow": (9, 120), "bigger": (101, 150), "one pixel": (1, 1)}


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_equals_the_evaluation_step_by_step(size: tuple[int, int]) -> None:
    image, head = picture(*size), network(64, 3)
    found = multi_scale_features(image, head, window=64, scales=PAPER, flip=True)
    expected = oracle(image, head, 64, PAPER, True)
    assert found.shape == (3, *size)
    assert (found - expected).abs().max() < 1e-10 * expected.abs().max()


def test_sizes_windows_and_forwards_of_the_released_script() -> None:
    """360 x 480: 1 + 2 + 4 + 6 = 13 windows, and their mirrors, 26 runs of the network."""
    assert [scaled_size(360, 480, s, 480) for s in PAPER] == [(293, 390), (390, 520), (488, 650), (683, 910)]
    assert scaled_size(480, 360, 1.25, 480) == (650, 488)
    assert scaled_size(1, 1000, 1.0, 480) == (1, 520)
    assert [window_starts(n, 480) for n in (390, 480, 481, 800, 801, 910)] == [
        [0], [0], [0, 320], [0, 320], [0, 320, 640], [0, 320, 640],
    ]  # fmt: skip
