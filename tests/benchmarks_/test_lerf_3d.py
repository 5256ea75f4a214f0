import cases_methods as cases
import numpy as np
import oracles_protocols as dull
import oracles_uplift
import pytest
import torch
from published.lerf_3d import LerfOvs3D
from published.mask_truth import MaskAndBoxes, MaskTruth

from kfgs.labels.scores import CANONICAL

SIZE = (18, 24)
TEXTS = ("mug", "spoon", "plate")


def _scene(levels=3, seed=0, apart=False):
    rng = np.random.default_rng(seed)
    cloud = cases.spread_gaussians(rng, 40, scale=0.25)
    own = {text: rng.uniform(0.1, 0.4, (levels, 40)) for text in (*TEXTS, *CANONICAL)}
    for values in own.values():
        values[:, 5] = np.nan  # nothing is known of one Gaussian
        if apart:  # each level knows other Gaussians, the last none
            values[0, 6:18], values[1, 14:30], values[2] = np.nan, np.nan, np.nan
    frames = {}
    for stem, texts in (("frame_1", TEXTS[:2]), ("frame_2", TEXTS)):
        frames[stem] = {t: MaskAndBoxes(torch.from_numpy(rng.uniform(size=SIZE) < 0.6)) for t in texts}
    method = cases.Numbers([*TEXTS, *CANONICAL], own=own, gaussians=cloud)
    return method, MaskTruth(frames), [cases.view(stem, *SIZE) for stem in frames]


def _silhouette(cloud, selected, threshold):
    parts = [x.double().numpy()[selected] for x in (cloud.means, cloud.quats, cloud.scales, cloud.opacities)]
    camera = cases.camera(*SIZE)
    viewmat, k = camera.viewmat.double().numpy(), camera.K.double().numpy()
    weights = oracles_uplift.blend_weights(*parts, viewmat, k, camera.width, camera.height)
    return weights.sum(-1) > threshold


PROTOCOLS = {
    "argmax": LerfOvs3D(),
    "vala": LerfOvs3D.vala(),
    "dr_splat": LerfOvs3D.dr_splat(),
    "level": LerfOvs3D(selection="smoothed", threshold=0.3, level=1, neighbours=4),
}


@pytest.mark.parametrize("name", PROTOCOLS)
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("apart", [False, True])
def test_the_whole_protocol_against_loops(name, seed, apart):
    method, truth, views = _scene(seed=seed, apart=apart)
    protocol = PROTOCOLS[name]
    report = protocol.score(method, truth, views, method.encode)
    own = {t: v[[1]] for t, v in method.own.items()} if name == "level" else method.own
    selected = {}
    for text in TEXTS:
        if name == "argmax":
            selected[text] = dull.select_argmax(own, TEXTS, text)
        else:
            options = {"threshold": protocol.threshold, "smoothed": protocol.selection == "smoothed"}
            means = method.gaussians.means.double().tolist()
            selected[text] = dull.select_by_relevancy(
                own, text, CANONICAL, means, neighbours=protocol.neighbours, **options
            )
        found = protocol.select(method, TEXTS, method.encode)[text].numpy()
        assert np.array_equal(found, selected[text])
        assert not found[5]
        assert found.any()
    ious = [
        dull.iou(_silhouette(method.gaussians, selected[text], protocol.silhouette), mask.numpy())
        for texts in truth.frames.values()
        for text, (mask, _) in texts.items()
    ]
    assert report["mIoU"] == pytest.approx(np.mean(ious), abs=2e-3)  # float32 at the silhouette's threshold
    assert report["Acc@0.25"] == np.mean(np.array(ious) > 0.25)
    assert report["Acc@0.5"] == np.mean(np.array(ious) > 0.5)
