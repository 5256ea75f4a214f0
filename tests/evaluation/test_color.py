"""PSNR and SSIM of views, against pictures whose error is known."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import refused, tells
from oracles_color import ssim_windows
from PIL import Image

from kfgs import Camera, Gaussians, rasterize
from kfgs.cameras import Distortion
from kfgs.evaluation.color import COLOR_PROTOCOL, score_views
from kfgs.scenes import Scene

K = torch.tensor([[40.0, 0, 16.2], [0, 41.0, 11.9], [0, 0, 1]])


def cloud():
    g = torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.rand(9, 3, generator=g) + torch.tensor([-0.5, -0.5, 2.0]),
        quats=torch.randn(9, 4, generator=g),
        scales=torch.full((9, 3), 0.2),
        opacities=torch.full((9,), 0.7),
        sh=torch.randn(9, 4, 3, generator=g),
    )


def make_scene(folder: Path, shift=0.1, lens=None) -> Scene:
    """Three views; pictures are the renderings, the last one brighter by `shift` where it is not clipped."""
    cameras, paths = [], []
    for i in range(3):
        viewmat = torch.eye(4)
        viewmat[0, 3] = 0.2 * i
        camera = Camera(viewmat, K, 32, 24, name=f"view{i}.png")
        picture = rasterize(cloud(), camera).map.clamp(0, 1) * (1 - shift if i == 2 else 1) + (shift if i == 2 else 0)
        Image.fromarray((picture * 255).round().byte().numpy()).save(folder / camera.name)
        cameras.append(camera if lens is None else replace(camera, distortion=lens))
        paths.append(folder / camera.name)
    empty = torch.zeros(0, 3)
    return Scene(cameras, paths, empty, empty.byte(), splits={"train": [0], "test": [1, 2]})


def test_scores_are_those_of_the_definitions(tmp_path):
    scene = make_scene(tmp_path)
    seen = {}
    report = score_views(cloud(), scene, show=lambda stem, rendered, taken: seen.update({stem: (rendered, taken)}))
    assert [view.name for view in report.views] == ["view1", "view2"] == list(seen)
    for view in report.views:
        rendered, taken = (x.double().numpy() for x in seen[view.name])
        assert view.psnr == pytest.approx(-10 * np.log10(((rendered - taken) ** 2).mean()), abs=1e-4)
        assert view.ssim == pytest.approx(ssim_windows(rendered, taken).mean(), abs=1e-5)
    assert report.views[0].psnr > 50  # only the rounding to bytes
    assert 20 < report.views[1].psnr < 30
    assert report.psnr.value == pytest.approx(sum(view.psnr for view in report.views) / 2)
    assert report.ssim.value == pytest.approx(sum(view.ssim for view in report.views) / 2)
    assert COLOR_PROTOCOL.startswith("kfgs-color/1")
    assert json.loads(json.dumps(report.to_json()))["views"]["view2"]["psnr"] == report.views[1].psnr
    assert "over 2 views, worst" in str(report)
    assert "(view2)" in str(report)


def test_what_the_lens_did_not_see_is_not_scored(tmp_path):
    scene = make_scene(tmp_path, lens=Distortion("brown_conrady", (0.4, 0.0, 0.0, 0.0))).undistorted()
    known = scene.mask(1)
    assert 0 < int((~known).sum()) < known.numel() / 2
    before = score_views(cloud(), scene)
    taken, rendered = scene.image(1), rasterize(cloud(), scene.cameras[1]).map.clamp(0, 1)
    error = ((rendered - taken)[known] ** 2).mean()
    assert before.views[0].psnr == pytest.approx(float(-10 * torch.log10(error)), abs=1e-4)


def test_without_colours_there_is_nothing_to_score(tmp_path):
    scene = make_scene(tmp_path)
    with pytest.raises(ValueError, match=tells("gaussians:", "[N, K, 3]", "got None", "fit_color")):
        score_views(cloud().replace(sh=None, features=torch.zeros(9, 3)), scene)
    refused(lambda: score_views(cloud(), scene, "val"), "split:", "train, test", "got 'val'")
