import cases_methods as cases
import numpy as np
import oracles_protocols as dull
import pytest
import torch
from published.lerf_2d import LerfOvs2D
from published.mask_truth import MaskAndBoxes, MaskTruth

from kfgs.labels.scores import CANONICAL

SIZE = (38, 46)
TEXTS = ("mug", "spoon", "plate")


def _scene(levels=3, seed=0):
    rng = np.random.default_rng(seed)
    stems = ["frame_00002", "frame_00041"]
    maps = cases.random_maps(rng, stems, [*TEXTS, *CANONICAL], levels, *SIZE)
    frames = {}
    for stem, texts in zip(stems, (TEXTS[:2], TEXTS[1:]), strict=True):
        frames[stem] = {}
        for text in texts:
            x, y = rng.integers(0, 28, 2)
            mask = torch.zeros(SIZE, dtype=torch.bool)
            mask[y : y + 9, x : x + 12] = True
            maps[stem][text][:, mask.numpy()] += rng.uniform(0.1, 0.3, (levels, 1))
            boxes = torch.tensor([[x, y, x + 12, y + 9], [0, 0, 2, 2]]).double()
            frames[stem][text] = MaskAndBoxes(mask, boxes)
    for one in maps.values():
        for text in one:
            one[text][:, :3, :4] = np.nan  # nothing is known in a corner
    return cases.Numbers([*TEXTS, *CANONICAL], maps), MaskTruth(frames), [cases.view(stem, *SIZE) for stem in stems]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("filter", ["langsplat", "langsplatv2"])
def test_the_whole_protocol_against_loops(filter, seed):
    method, truth, views = _scene(seed=seed)
    reports = {
        level: LerfOvs2D(level=level, filter=filter).score(method, truth, views[::-1], method.encode)
        for level in ("chosen", "oracle", 1)
    }
    want = {"chosen": [], "oracle": [], 1: []}
    hits = []
    for stem, texts in truth.frames.items():
        for text, (mask, boxes) in texts.items():
            found = dull.relevancy_maps(method.maps[stem], text, CANONICAL)
            ious, level, hit = dull.lerf_2d(found, mask.numpy(), boxes.tolist(), filter=filter)
            want["chosen"].append(ious[level])
            want["oracle"].append(max(ious))
            want[1].append(ious[1])
            hits.append(hit)
    for level, report in reports.items():
        assert report["mIoU"] == pytest.approx(np.mean(want[level]), abs=1e-9)
    assert reports["chosen"]["localisation"] == np.mean(hits)
    assert reports["oracle"]["localisation"] == np.mean(hits)
    assert 0.05 < reports["chosen"]["mIoU"] <= reports["oracle"]["mIoU"] < 1
