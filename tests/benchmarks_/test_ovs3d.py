import cases_methods as cases
import numpy as np
import oracles_protocols as dull
import pytest
import torch
from published.mask_truth import MaskAndBoxes, MaskTruth
from published.ovs3d import OVS3DClosed, OVS3DStability, OVS3DThreshold

from kfgs.labels.scores import CANONICAL

SIZE = (36, 42)
TEXTS = ("grape", "sofa", "wall", "lamp")


def _scene(seed, levels=2, contrast=0.25):
    rng = np.random.default_rng(seed)
    stems = ["00", "07"]
    maps = cases.random_maps(rng, stems, [*TEXTS, *CANONICAL], levels, *SIZE)
    frames = {}
    for stem, texts in zip(stems, (TEXTS[:3], TEXTS[1:]), strict=True):
        frames[stem] = {}
        for i, text in enumerate(texts):
            large = np.zeros((72, 84), bool)
            y, x = 20 * i, rng.integers(0, 50)
            large[y : y + 18 + i, x : x + 30] = True  # may touch the next
            frames[stem][text] = MaskAndBoxes(torch.from_numpy(large))
            maps[stem][text][:, large[1::2, 1::2]] += rng.uniform(0.5, 1.5, (levels, 1)) * contrast
    for one in maps.values():
        for values in one.values():
            values[:, -2:, -3:] = np.nan
    return cases.Numbers([*TEXTS, *CANONICAL], maps), MaskTruth(frames), [cases.view(stem, *SIZE) for stem in stems]


def _small(mask):
    return mask.numpy()[1::2, 1::2]  # the pixel at each centre


@pytest.mark.parametrize("seed", range(3))
def test_closed_against_loops(seed):
    method, truth, views = _scene(seed)
    report = OVS3DClosed(texts=TEXTS, level=1).score(method, truth, views, method.encode)
    ious, shares = [], []
    for stem, texts in truth.frames.items():
        values = np.stack([method.maps[stem][text][1] for text in TEXTS])
        labels = np.where(np.isnan(values[0]), -1, np.argmax(np.nan_to_num(values), axis=0))
        for text, (mask, _) in texts.items():
            ious.append(dull.iou(labels == TEXTS.index(text), _small(mask)))
        right = 0
        for y in range(SIZE[0]):
            for x in range(SIZE[1]):
                row = [text in texts and bool(_small(texts[text].mask)[y, x]) for text in TEXTS]
                right += row == [labels[y, x] == i for i in range(len(TEXTS))]
        shares.append(right / (SIZE[0] * SIZE[1]))
    assert tuple(report.scores.values()) == pytest.approx((np.mean(ious), np.mean(shares)), abs=1e-12)
    assert report["mIoU"] > 0.05


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("filter", ["langsplat", "langsplatv2"])
def test_threshold_against_loops(filter, seed):
    method, truth, views = _scene(seed)
    stretched = OVS3DThreshold(filter=filter).score(method, truth, views, method.encode)
    plain = OVS3DThreshold(stretched=False, threshold=0.55).score(method, truth, views, method.encode)
    want, plainly = [], []
    for stem, texts in truth.frames.items():
        for text, (mask, _) in texts.items():
            found = dull.relevancy_maps(method.maps[stem], text, CANONICAL)
            ious, level, _ = dull.lerf_2d(found, _small(mask), [], filter=filter)
            want.append(ious[level])
            best = found[int(np.argmax([one.max() for one in found]))]
            plainly.append(dull.iou(best > 0.55, _small(mask)))
    assert stretched["mIoU"] == pytest.approx(np.mean(want), abs=1e-9)
    assert plain["mIoU"] == pytest.approx(np.mean(plainly), abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_stability_against_loops(seed):
    method, truth, views = _scene(seed, levels=3, contrast=0.1 if seed else 0.6)
    protocol = OVS3DStability(steepest=0.6) if seed == 3 else OVS3DStability()
    report = protocol.score(method, truth, views, method.encode)
    ious, rows = [], iter(report.rows)
    for stem, texts in truth.frames.items():
        for text, (mask, _) in texts.items():
            found = dull.relevancy_maps(method.maps[stem], text, CANONICAL)
            seen, level, threshold = dull.stable_mask(found, steepest=protocol.steepest)
            row = next(rows)
            assert (row["level"], row["threshold"]) == (level, pytest.approx(threshold))
            ious.append(dull.iou(dull.majority(seen), _small(mask)))
    assert report["mIoU"] == pytest.approx(np.mean(ious), abs=1e-9)
