import pytest
import torch

from kfgs.gaussians import Gaussians
from kfgs.labels import extract, recolor, remove

WEIGHTS = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))


def field(n=12, coefficients=4, seed=0):
    generator = torch.Generator().manual_seed(seed)
    random = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    return Gaussians(
        means=random(n, 3),
        quats=random(n, 4),
        scales=random(n, 3) + 0.1,
        opacities=random(n),
        sh=(random(n, coefficients, 3) - 0.5) * 0.4,
        labels=torch.arange(n) % 3,
    )


def test_remove_and_extract_divide_the_field():
    gaussians = field()
    mask = gaussians.labels == 1
    kept, taken = remove(gaussians, mask), extract(gaussians, mask)
    assert (len(kept), len(taken)) == (8, 4)
    assert (taken.labels == 1).all()
    assert not (kept.labels == 1).any()
    assert taken.sh.equal(gaussians.sh[mask])
    assert len(gaussians) == 12


def test_recolored_mean_is_the_colour_and_the_rest_is_untouched():
    gaussians = field()
    before = gaussians.sh.clone()
    mask = gaussians.labels == 2
    rgb = torch.tensor([0.8, 0.2, 0.1], dtype=torch.float64)
    painted = recolor(gaussians, mask, rgb)
    torch.testing.assert_close((painted.sh[mask, 0] * C0 + 0.5).mean(dim=0), rgb)
    assert painted.sh[~mask].equal(before[~mask])
    assert gaussians.sh.equal(before)


def test_shading_survives_from_every_direction():
    """The painted colour along any direction is rgb times the old luminance over its mean (basis values stand in for v)."""
    gaussians = field(coefficients=16)
    mask = gaussians.labels == 0
    rgb = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    painted = recolor(gaussians, mask, rgb)
    mean = ((gaussians.sh[mask, 0] * C0 + 0.5) @ WEIGHTS).mean()
    for seed in range(3):
        basis = torch.randn(16, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        basis[0] = C0
        old = 0.5 + torch.einsum("k,nkc->nc", basis, gaussians.sh[mask])
        new = 0.5 + torch.einsum("k,nkc->nc", basis, painted.sh[mask])
        torch.testing.assert_close(new, rgb * ((old @ WEIGHTS) / mean)[:, None])


def test_black_object_becomes_flat():
    gaussians = field()
    black = gaussians.replace(sh=torch.full_like(gaussians.sh, 0.0).index_fill_(1, torch.tensor([0]), -0.5 / C0))
    painted = recolor(black, black.labels == 0, [0.3, 0.6, 0.9])
    torch.testing.assert_close(painted.sh[0, 0] * C0 + 0.5, torch.tensor([0.3, 0.6, 0.9], dtype=torch.float64))
    assert not painted.sh[0, 1:].any()


def test_empty_mask_changes_nothing():
    gaussians = field()
    nothing = torch.zeros(12, dtype=torch.bool)
    assert recolor(gaussians, nothing, (1.0, 0.0, 0.0)).sh.equal(gaussians.sh)
    assert len(remove(gaussians, nothing)) == 12
    assert len(extract(gaussians, nothing)) == 0


def test_wrong_input_is_named():
    gaussians = field()
    mask = gaussians.labels == 0
    with pytest.raises(TypeError, match="mask: expected a boolean mask, got torch.int64"):
        remove(gaussians, gaussians.labels)
    with pytest.raises(ValueError, match=r"mask: expected \[N\] with N = 12"):
        extract(gaussians, mask[:5])
    with pytest.raises(ValueError, match=r"gaussians.sh: expected spherical harmonics"):
        recolor(gaussians.replace(sh=None), mask, (1.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"rgb: expected three numbers in \[0, 1\], got \(255, 0, 0\)"):
        recolor(gaussians, mask, (255, 0, 0))
    with pytest.raises(ValueError, match="rgb: expected three numbers"):
        recolor(gaussians, mask, (0.5, 0.5))
