"""Tables, chairs and an odd class in three heaps, in both clouds, for the tests of the viewer."""

import numpy as np
import torch
from cases_clouds import balls
from cases_web import SECONDS

from kfgs.viewer import Exploration, SplatMeaning

NAMES = ("table", "chair", "<b>{{ 1 + 1 }}</b>")  # the last must stay words
TABLE, CHAIR, ODD = range(3)


def _cloud(count, spread, seed, labels=None):
    """As many Gaussians around each of three places, far from each other."""
    generator = torch.Generator().manual_seed(seed)
    places = torch.tensor([[2.0, 0, 0], [-2.0, 0, 0], [0, 2.5, 0]]).repeat_interleave(count, dim=0)
    offsets = torch.randn(3 * count, 3, generator=generator)
    means = places + spread * offsets / offsets.norm(dim=1, keepdim=True)
    labels = None if labels is None else torch.arange(3).repeat_interleave(count)
    return balls(means, labels, scale=0.08, sh=torch.rand(len(means), 1, 3, generator=generator))


def exploration(names=NAMES):
    """Semantic Gaussians on spheres of radius 0.3, colour ones on spheres of 0.6: some are within 0.32, all within 1."""
    semantic = _cloud(60, 0.3, 1, labels=True)
    score = np.linspace(0.05, 0.95, len(semantic), dtype=np.float32)
    file = semantic.replace(scores=score, names=names)
    return Exploration(SplatMeaning(file), _cloud(150, 0.6, 2), distance=0.4)


def mask(page, side, kind="selected"):
    return np.array(page.evaluate(f"[...viewer.model.{kind}('{side}')]"), bool)


def agree(page, state):
    """Gaussian by Gaussian, and in the counts of the class list."""
    details = state.details()
    for side in state.sides:
        np.testing.assert_array_equal(mask(page, side), state.selected(side))
        labels, counts = page.evaluate(f"[[...viewer.model.labels('{side}')], viewer.model.counts('{side}')]")
        np.testing.assert_array_equal(np.array(labels), state.labels(side))
        assert counts["classes"] == [count for _, count in details[side]["classes"]]
        assert [counts[key] for key in ("total", "selected", "none")] == [
            details[side][key] for key in ("total", "selected", "none")
        ]


def errors_of(page):
    """What goes wrong in a tab from now on, as a list that grows; it waits patiently for a busy machine."""
    errors = []
    page.set_default_timeout(1000 * SECONDS)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
    return errors


def set_slider(page, name, value):
    """Type the value beside a slider."""
    field = page.locator(f".slider:has(#{name}) input.number")
    field.fill(value if isinstance(value, str) else repr(value))
    field.press("Enter")
