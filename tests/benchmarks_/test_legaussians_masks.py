import cases_methods as cases
import numpy as np
import oracles_protocols as dull
import pytest
import torch
from published.legaussians_masks import LEGaussiansMasks, average_precision
from published.mask_truth import MaskAndBoxes, MaskTruth

from kfgs.labels.scores import CANONICAL

SIZE = (14, 20)
TEXTS = ("bench", "tire")


def test_average_precision_takes_what_is_strictly_above_its_thresholds():
    rng = np.random.default_rng(0)
    found, mask = rng.uniform(size=SIZE).round(2), rng.uniform(size=SIZE) < 0.4
    want = dull.legaussians(found, mask)[3]
    assert average_precision(torch.from_numpy(found), torch.from_numpy(mask)) == pytest.approx(want, abs=1e-9)


@pytest.mark.parametrize("level", [0, 1])
def test_the_whole_protocol_against_loops(level):
    rng = np.random.default_rng(0)
    maps = cases.random_maps(rng, ["a", "b"], [*TEXTS, *CANONICAL], 2, *SIZE)
    maps["a"]["tire"][:, 2, 3] = np.nan
    method = cases.Numbers([*TEXTS, *CANONICAL], maps)
    frames, want = {}, []
    for stem, texts in (("a", TEXTS), ("b", TEXTS[1:])):
        each, frames[stem] = [], {}
        for text in texts:
            large = rng.uniform(size=(28, 60)) < (0.5 if stem == "a" else 0)  # another size than the views; none
            frames[stem][text] = MaskAndBoxes(torch.from_numpy(large))
            small = np.array([[large[2 * y + 1, 3 * x + 1] for x in range(20)] for y in range(14)])
            found = dull.relevancy_maps(maps[stem], text, CANONICAL)[level]
            each.append(dull.legaussians(found, small, 0.45))
        want.append(np.mean(each, 0))
    views = [cases.view(stem, *SIZE) for stem in frames]
    report = LEGaussiansMasks(threshold=0.45, level=level).score(method, MaskTruth(frames), views, method.encode)
    iou, accuracy, precision, area = np.mean(want, 0)
    assert list(report.scores.values()) == pytest.approx([iou, accuracy, precision, area / 100, area / 101], abs=1e-9)
