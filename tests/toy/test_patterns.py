import numpy as np
import pytest

from kfgs.toy.patterns import PATTERNS, Noise, Texture, evaluate

COLORS = tuple((0.2 + 0.1 * k, 0.7 - 0.08 * k, 0.5) for k in range(6))
HALF = np.array([0.5, 0.4, 0.3])


def places(count=300):
    rng = np.random.default_rng(0)
    local = rng.uniform(-1, 1, (count, 3)) * HALF
    axis = rng.integers(0, 3, count)
    local[np.arange(count), axis] = HALF[axis] * rng.choice([-1, 1], count)
    return local, axis, np.full(count, 0.004)


@pytest.mark.parametrize("is_round", [False, True])
@pytest.mark.parametrize("kind", sorted(PATTERNS))
def test_a_colour_depends_on_its_place_alone(kind, is_round):
    skin, noise = Texture(kind, COLORS, 0.1, seed=3), Noise(np.random.default_rng(1))
    local, axis, footprint = places()
    color = evaluate(skin, noise, local, axis, HALF, footprint, is_round=is_round)
    assert color.shape == (300, 3)
    assert color.std() > 0.004  # something to see
    some = np.random.default_rng(2).permutation(300)[:40]
    alone = evaluate(skin, noise, local[some], axis[some], HALF, footprint[some], is_round=is_round)
    assert np.allclose(alone, color[some], atol=1e-6)
    other = Texture(kind, COLORS, 0.1, seed=4)
    assert not np.allclose(evaluate(other, noise, local, axis, HALF, footprint, is_round=is_round), color)
