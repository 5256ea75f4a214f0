import numpy as np
import pytest
import torch
from cases_clouds import random_cloud
from messages import refused

from kfgs.gaussians import Gaussians
from kfgs.labels import Recolor, Selection
from kfgs.labels.color import parse_color, shades

WEIGHTS = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))


def recolor(gaussians, mask, rgb):
    return Recolor(Selection.of(mask), rgb).apply(gaussians)


def field(n=12, coefficients=4):
    made = random_cloud(n, coefficients, dtype=torch.float64, labels=torch.arange(n) % 3)
    return made.replace(sh=(made.sh - 0.5) * 0.5)


def luminance(colors):
    return colors @ WEIGHTS


def seen(sh, basis):
    """The unclamped colour where the harmonics have these values."""
    return 0.5 + torch.einsum("k,nkc->nc", basis, sh)


def bases(coefficients, count=4):
    for seed in range(count):
        basis = torch.randn(coefficients, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 0.3
        basis[0] = C0
        yield basis


def greys(levels, opacities=None, sides=None):
    """Gaussians that show these greys, of equal size unless told otherwise."""
    n = len(levels)
    levels = torch.tensor(levels, dtype=torch.float64)
    sh = ((levels - 0.5) / C0)[:, None, None].repeat(1, 1, 3)
    ones = torch.ones(n, 3, dtype=torch.float64)
    opacities = torch.full((n,), 0.5) if opacities is None else torch.tensor(opacities)
    scales = ones if sides is None else ones * torch.tensor(sides, dtype=torch.float64)[:, None]
    return Gaussians(means=ones, quats=torch.ones(n, 4), scales=scales, opacities=opacities.double(), sh=sh)


def paint(gaussians, rgb):
    mask = torch.ones(len(gaussians), dtype=torch.bool)
    return recolor(gaussians, mask, rgb).sh[:, 0] * C0 + 0.5


def test_tint_makes_the_middle_the_colour_and_keeps_ratios():
    shown = paint(greys([0.2, 0.4, 0.8]), [0.5, 0.25, 0.1])
    rgb = torch.tensor([0.5, 0.25, 0.1], dtype=torch.float64)
    torch.testing.assert_close(shown, torch.stack([0.5 * rgb, rgb, 2 * rgb]))  # 0.2 / 0.4 and 0.8 / 0.4


def test_the_middle_is_of_what_covers_the_picture_and_black_becomes_flat():
    rgb = torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64)
    small, faint = {"sides": [0.01] * 10 + [1.0]}, {"opacities": [0.01] * 10 + [0.9]}
    for hardly_seen in (small, faint):
        torch.testing.assert_close(paint(greys([0.1] * 10 + [0.6], **hardly_seen), rgb.tolist())[-1], rgb)
    black = field()
    black = black.replace(sh=black.sh * 0)
    black.sh[:, 0] = -0.5 / C0
    painted = recolor(black, black.labels == 0, rgb.tolist())
    torch.testing.assert_close(painted.sh[0, 0] * C0 + 0.5, rgb)
    assert not painted.sh[0, 1:].any()


def test_a_brighter_paint_stays_in_range_and_keeps_the_order():
    for rgb in ([0.9, 0.1, 0.1], [0.8, 0.8, 0.8], [1.0, 1.0, 0.9], [0.1, 0.1, 1.0]):
        levels = torch.linspace(0, 1, 21).tolist() + [0.1] * 41  # the middle is 0.1
        shown = paint(greys(levels), rgb)[:21]
        assert shown.min() > -1e-9
        assert shown.max() < 1 + 1e-9
        assert (luminance(shown).diff() > 0).all()
        torch.testing.assert_close(shown[2], torch.tensor(rgb, dtype=torch.float64))
        torch.testing.assert_close(shown[1], torch.tensor(rgb, dtype=torch.float64) / 2)
        torch.testing.assert_close(shown[20], torch.ones(3, dtype=torch.float64))


@pytest.mark.parametrize("rgb", ["#c04040", "#3060c0", "#000000", "#ffffff", "#777777", "#0000ff", "#ffff00"])
def test_luminance_follows_the_curve_from_every_direction(rgb):
    """color(v) = T(L) + T'(L) (L(v) - L), with the curve of the object's own middle; and the rest stays."""
    gaussians = field(coefficients=16)
    mask, before = gaussians.labels == 0, gaussians.sh.clone()
    painted = recolor(gaussians, mask, rgb)
    assert gaussians.sh.equal(before)
    assert painted.sh[~mask].equal(before[~mask])
    assert painted.opacities is gaussians.opacities
    old, new = luminance(gaussians.sh[mask, 0] * C0 + 0.5), luminance(painted.sh[mask, 0] * C0 + 0.5)
    shown = [[luminance(seen(sh[mask], basis)) for sh in (painted.sh, gaussians.sh)] for basis in bases(16)]
    slopes = [(after - new) / (before - old) for after, before in shown]
    torch.testing.assert_close(slopes, [slopes[0]] * len(slopes), rtol=1e-6, atol=1e-9)


def test_shades_below_the_pure_colour_and_tints_above():
    """Of luminance L the colour s * rgb, or between the brightest of its hue and white; worked by hand for (1, 0.5, 0)."""
    knee = 0.2126 + 0.5 * 0.7152
    rgb = torch.tensor([0.5, 0.25, 0.0], dtype=torch.float64)
    tones = torch.tensor([knee / 2, knee, (1 + knee) / 2, 1.0], dtype=torch.float64)
    shown = shades(tones, rgb, luminance(rgb))[0]  # a middle that stays: the tone is the luminance
    expected = [[0.5, 0.25, 0.0], [1.0, 0.5, 0.0], [1.0, 0.75, 0.5], [1.0, 1.0, 1.0]]
    torch.testing.assert_close(shown, torch.tensor(expected, dtype=torch.float64))


RED = (192 / 255, 64 / 255, 64 / 255)


@pytest.mark.parametrize(
    ("color", "expected"),
    [
        ("#c04040", RED),
        (" #C04040 ", RED),
        ("rgb(192, 64, 64)", RED),
        ("#c44", (204 / 255, 68 / 255, 68 / 255)),
        ("teal", (0.0, 128 / 255, 128 / 255)),
        ("hsl(120, 100%, 50%)", (0.0, 1.0, 0.0)),
        ([0.5, 0, 1], (0.5, 0.0, 1.0)),
        (torch.tensor([0.5, 0.0, 1.0]), (0.5, 0.0, 1.0)),
        (np.array([0.5, 0.0, 1.0]), (0.5, 0.0, 1.0)),
    ],
)
def test_colours_are_read(color, expected):
    assert parse_color(color) == expected


def test_no_colours_are_refused():
    refused(lambda: parse_color("reddish"), "rgb:", "'#c04040'", "got 'reddish'")
    refused(lambda: parse_color("192,64,64"), "rgb:", "colour", "'teal'")
    refused(lambda: parse_color("#c0404080"), "rgb:", "got '#c0404080'")
    refused(lambda: parse_color(""), "rgb:", "colour", "'teal'")
    refused(lambda: parse_color((192, 64, 64)), "rgb:", "8-bit", "255", "got (192, 64, 64)")
    refused(lambda: parse_color((0.1, 0.2)), "rgb:", "got (0.1, 0.2)")
    refused(lambda: parse_color((0.1, float("nan"), 0.2)), "rgb:", "got nan")
    refused(lambda: parse_color(None), "rgb:", "got None")
