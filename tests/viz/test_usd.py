"""USD scenes, read back by OpenUSD itself: an object per class, with every value of its Gaussians."""

import sys

import numpy as np
import pytest
import torch
from cases_viz import some_gaussians
from messages import tells

from kfgs.viz import save_usd

pxr = pytest.importorskip("pxr")

NAMES = ("wall", "office chair", "b", "c", "d")


def opened(path):
    from pxr import Usd

    stage = Usd.Stage.Open(str(path))
    return stage, {prim.GetName(): prim for prim in stage.GetDefaultPrim().GetChildren()}


@pytest.mark.parametrize("ending", ["usda", "usdc", "usd", "usdz"])
def test_each_class_is_an_object_with_its_gaussians(tmp_path, ending):
    cloud, path = some_gaussians(K=4), tmp_path / f"a.{ending}"
    score = np.linspace(0, 1, len(cloud), dtype=np.float32)
    written = save_usd(path, cloud.replace(extra={"score": score, "other": score}, names=NAMES))
    assert written.paths == [path]
    assert written.lost == (
        f"4 features per Gaussian: .{ending} has no place for them",
        f"the columns other: .{ending} has no place for them",
    )
    assert [one.name for one in tmp_path.iterdir()] == [path.name]
    _, prims = opened(path)
    assert set(prims) == {"unlabelled", "wall", "office_chair", "b", "c", "d"}
    chairs, prim = cloud[cloud.labels == 1], prims["office_chair"]
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    assert prim.GetAttribute("kfgs:class").Get() == "office chair"
    assert set(prim.GetAttribute("primvars:class_id").Get()) == {1}

    def read(name):
        return np.array(prim.GetAttribute(name).Get())

    np.testing.assert_array_equal(read("primvars:score"), score[cloud.labels == 1])
    np.testing.assert_allclose(read("positions"), chairs.means, rtol=1e-6)
    np.testing.assert_allclose(read("scales"), chairs.scales, rtol=1e-6)
    np.testing.assert_allclose(read("opacities"), chairs.opacities, rtol=1e-6)
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 1
    np.testing.assert_allclose(read("radiance:sphericalHarmonicsCoefficients").reshape(-1, 4, 3), chairs.sh, rtol=1e-6)
    first, expected = prim.GetAttribute("orientations").Get()[0], chairs.quats[0] / chairs.quats[0].norm()
    np.testing.assert_allclose([first.GetReal(), *first.GetImaginary()], expected, rtol=1e-5)


def test_names_that_collide_or_say_nothing_get_the_number_of_their_class(tmp_path):
    cloud = some_gaussians()
    names = ("tv set", "tv-set", "unlabelled", "\u6905\u5b50", "")
    save_usd(tmp_path / "a.usda", cloud.replace(names=names))
    _, prims = opened(tmp_path / "a.usda")
    expected = {"unlabelled": -1, "tv_set": 0, "tv_set_1": 1, "unlabelled_2": 2, "class_3": 3, "class_4": 4}
    assert {name: prim.GetAttribute("primvars:class_id").Get()[0] for name, prim in prims.items()} == expected


def test_points_for_programs_without_gaussians(tmp_path):
    cloud = some_gaussians()
    written = save_usd(tmp_path / "a.usdc", cloud.replace(labels=None, features=None), points=True)
    assert written.lost == ("shapes, opacities and harmonics of the Gaussians: points are round and opaque",)
    _, prims = opened(tmp_path / "a.usdc")
    (prim,) = prims.values()
    assert prim.GetTypeName() == "Points"
    np.testing.assert_allclose(np.array(prim.GetAttribute("points").Get()), cloud.means, rtol=1e-6)
    np.testing.assert_allclose(np.array(prim.GetAttribute("widths").Get()), 2 * cloud.scales.mean(dim=1), rtol=1e-6)
    colors = np.array(prim.GetAttribute("primvars:displayColor").Get())
    np.testing.assert_allclose(colors, (0.28209479 * cloud.sh[:, 0] + 0.5).clip(0, 1), atol=1e-5)
    assert set(prim.GetAttribute("primvars:class_id").Get()) == {-1}


@pytest.mark.parametrize("ending", ["usda", "usdz"])
def test_a_unit_is_a_metre_and_z_is_up(tmp_path, ending):
    from pxr import UsdGeom

    path = tmp_path / f"a.{ending}"
    save_usd(path, some_gaussians())
    stage, _ = opened(path)
    assert stage.HasAuthoredMetadata("metersPerUnit")
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == "Z"


def test_bad_requests_and_a_missing_library_are_named(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=tells("path:", ".usdc", "a.ply")):
        save_usd(tmp_path / "a.ply", some_gaussians())
    with pytest.raises(ValueError, match=tells("cloud:", "colours")):
        save_usd(tmp_path / "a.usdc", some_gaussians().replace(sh=None))
    with pytest.raises(ValueError, match=tells("scales:", "above 0")):
        save_usd(tmp_path / "a.usdc", some_gaussians().replace(scales=torch.zeros(60, 3)))
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(ImportError, match=tells("a.usdc:", "usd-core", "pip install 'usd-core>=26.3'")):
        save_usd(tmp_path / "a.usdc", some_gaussians())
    assert list(tmp_path.iterdir()) == []
