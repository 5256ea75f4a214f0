"""Files of other programs that are missing, of another program, real, or malicious."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from cases_foreign import (
    K,
    N,
    cosines_of,
    decoder_of,
    random_rows,
    save_capture,
    save_ply,
)
from messages import tells
from pickled import Call
from published.foreign import (
    load_feature3dgs,
    load_foreign,
    load_langsplat,
    load_occam,
    load_splat_features,
)

from kfgs.formats import read_splats
from kfgs.formats.ply import read_ply, write_ply


def test_a_real_splat_without_and_with_features(tmp_path: Path, shared_data: Path) -> None:
    ply = shared_data / "splats/inria_9080.ply"
    with pytest.raises(ValueError, match=tells("inria_9080.ply", "semantic_0", "trained with features")):
        load_feature3dgs(ply)
    count = len(read_splats(ply))
    values = random_rows(count, 6)
    np.save(tmp_path / "lang.npy", values.numpy())
    method = load_splat_features(ply, tmp_path / "lang.npy")
    text = random_rows(K, 6, seed=5)
    expected = cosines_of(values.numpy(), text.double().numpy())
    np.testing.assert_allclose(method.gaussian_cosines(text)[0].numpy(), expected, atol=2e-5)


def test_features_keep_step_with_the_gaussians_that_are_left(tmp_path: Path, shared_data: Path) -> None:
    columns = read_ply(shared_data / "splats/inria_9080.ply")
    columns["y"][[7, 8, 4000]] = np.nan
    write_ply(tmp_path / "a.ply", columns)
    values = random_rows(len(columns["y"]), 6)
    np.save(tmp_path / "lang.npy", values.numpy())
    method = load_splat_features(tmp_path / "a.ply", tmp_path / "lang.npy")
    text = random_rows(K, 6, seed=5)
    expected = cosines_of(np.delete(values.numpy(), [7, 8, 4000], axis=0), text.double().numpy())
    np.testing.assert_allclose(method.gaussian_cosines(text)[0].numpy(), expected, atol=2e-5)


def test_nothing_in_a_checkpoint_is_run(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    torch.save((Call(os.system, f"touch {mark}"), 30000), tmp_path / "chkpnt30000_langfeat_1.pth")
    with pytest.raises(ValueError, match=tells("chkpnt30000_langfeat_1.pth", "Nothing was run")):
        load_occam(tmp_path)
    assert not mark.exists()


def test_runs_of_levels_beside_the_run_of_the_colours_are_langsplats(tmp_path: Path) -> None:
    torch.save(decoder_of((3, 9)).state_dict(), tmp_path / "ae.pth")
    for level in (1, 2, 3):
        save_capture(tmp_path / f"ramen_{level}/chkpnt30000.pth", [random_rows(N, 3, seed=level)])
    want = load_langsplat(tmp_path / "ramen", tmp_path / "ae.pth")
    save_ply(tmp_path / "ramen/point_cloud/iteration_30000/point_cloud.ply", {})
    found = load_foreign(tmp_path / "ramen", tmp_path / "ae.pth")
    assert found.levels == 3
    text = random_rows(2, 9)
    assert torch.equal(found.gaussian_cosines(text), want.gaussian_cosines(text))
