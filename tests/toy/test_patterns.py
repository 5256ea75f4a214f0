import numpy as np
import pytest

from kfgs.toy.geometry import Solid, Texture, places_on
from kfgs.toy.patterns import PATTERNS, Noise, evaluate

COLORS = tuple((0.2 + 0.1 * k, 0.7 - 0.08 * k, 0.5) for k in range(6))
HALF = np.array([0.5, 0.4, 0.3])


@pytest.mark.parametrize("shape", ["box", "ellipsoid"])
@pytest.mark.parametrize("kind", sorted(PATTERNS))
def test_a_colour_depends_on_its_place_alone(kind, shape):
    noise, rng = Noise(np.random.default_rng(1)), np.random.default_rng(0)
    body, other = (
        Solid(shape, (0, 0, 0), tuple(HALF), 0.0, "table", Texture(kind, COLORS, 0.1, seed=s)) for s in (3, 4)
    )
    points, axis = rng.uniform(-1, 1, (300, 3)) * HALF, rng.integers(0, 3, 300)
    points[np.arange(300), axis] = HALF[axis] * rng.choice([-1, 1], 300)
    places, footprint = places_on([body], points, np.zeros(300, int)), np.full(300, 0.004)
    color = evaluate(body, noise, places, footprint)
    assert color.shape == (300, 3)
    assert color.std() > 0.004  # something to see
    some = np.random.default_rng(2).permutation(300)[:40]
    alone = evaluate(body, noise, places.take(some), footprint[some])
    assert np.allclose(alone, color[some], atol=1e-6)
    assert not np.allclose(evaluate(other, noise, places, footprint), color)
