import numpy as np
import pytest
import torch
from messages import tells

from kfgs.formats import SplatFile, read_splats
from kfgs.gaussians import Gaussians


def _cloud(n: int = 4) -> Gaussians:
    return Gaussians(
        means=torch.arange(3.0 * n).view(n, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.ones(n, 3),
        opacities=torch.full((n,), 0.5),
        labels=torch.arange(n) - 1,
    )


def test_columns_follow_a_selection():
    splats = SplatFile(_cloud(), {"id": np.array([7, 8, 9, 10], np.uint16)}, ("a", "b", "c"), {"format": "ply"})
    by_mask = splats.select(torch.tensor([True, False, False, True]))
    by_index = splats.select(torch.tensor([3, 0]))
    assert by_mask.extra["id"].tolist() == [7, 10]
    assert by_index.extra["id"].tolist() == [10, 7]
    assert by_index.gaussians.labels.tolist() == [2, -1]
    assert by_index.extra["id"].dtype == np.uint16
    assert by_mask.extra["id"].flags.c_contiguous
    assert (by_mask.classes, by_mask.info) == (splats.classes, splats.info)
    assert splats.extra["id"].tolist() == [7, 8, 9, 10]


def test_columns_have_one_value_a_gaussian():
    for values in (np.zeros(3), np.zeros((4, 2)), np.float32(1)):
        with pytest.raises(ValueError, match=tells("extra['id']:", "[N]", "N = 4", "got (")):
            SplatFile(_cloud(), {"id": values})


def test_a_copy_leaves_the_original():
    splats = SplatFile(_cloud(), {}, ("a",))
    other = splats.replace(classes=("b", "c"))
    assert (splats.classes, other.classes) == (("a",), ("b", "c"))
    assert other.gaussians is splats.gaussians


def test_it_saves_itself(tmp_path):
    sh = torch.zeros(4, 1, 3)
    splats = SplatFile(_cloud().replace(sh=sh), {}, ("a", "b", "c"))
    written = splats.save(tmp_path / "a.ply")
    assert [path.name for path in written.paths] == ["a.ply", "a.ply.classes.json"]
    back = read_splats(tmp_path / "a.ply")
    assert (back.classes, back.gaussians.labels.tolist()) == (splats.classes, [-1, 0, 1, 2])
    splats.save(tmp_path / "a.bin", format="spz")
    assert read_splats(tmp_path / "a.bin").info["format"] == "spz"
    with pytest.raises(ValueError, match=tells("path:", "got 'a.bin'")):
        splats.save(tmp_path / "a.bin")


def test_it_says_what_it_holds():
    splats = SplatFile(_cloud(), {"score": np.zeros(4)}, ("a", "b"), {"format": "spz"})
    assert len(splats) == 4
    assert repr(splats).startswith("SplatFile(spz: Gaussians(4 Gaussians, labelled")
    assert repr(splats).endswith(", 2 classes, extra ['score'])")
    many = splats.replace(extra={f"column_{i}": np.zeros(4) for i in range(50)})
    assert repr(many).endswith(", extra 50 of str)")
    card = splats.replace(classes=("<b>", "c"))._repr_html_()
    assert all(part in card for part in ("SplatFile", "spz", "4 Gaussians", "2: &lt;b&gt;, c", "score"))
    assert repr(SplatFile(_cloud())).startswith("SplatFile(new: ")
