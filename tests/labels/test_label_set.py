import json

import numpy as np
import pytest
import torch

from kfgs.evaluation import LabelSet, load_label_set


def _write(folder, names, rows):
    (folder / "classes.json").write_text(json.dumps(names))
    np.save(folder / "text.npy", rows)
    return folder / "classes.json", folder / "text.npy"


def test_names_and_rows_are_read(tmp_path):
    labels = load_label_set(*_write(tmp_path, ["wall", "floor"], np.float64([[1, 0, 0], [0, 1, 0]])))
    assert labels.names == ("wall", "floor")
    assert labels.embeddings.dtype == torch.float32
    assert labels.index("floor") == 1
    assert len(labels) == 2


def test_real_text_embeddings_open(shared_data):
    labels = load_label_set(shared_data / "room_0" / "classes.json", shared_data / "room_0" / "text.npy")
    assert labels.embeddings.shape == (18, 512)
    torch.testing.assert_close(labels.embeddings.norm(dim=1), torch.ones(18), rtol=0, atol=1e-3)


def test_bad_input_is_named(tmp_path):
    with pytest.raises(ValueError, match="C = 2.*got float32 \\(3, 4\\)"):
        load_label_set(*_write(tmp_path, ["a", "b"], np.zeros((3, 4), np.float32)))
    with pytest.raises(ValueError, match="finite floats"):
        load_label_set(*_write(tmp_path, ["a"], np.full((1, 4), np.nan, np.float32)))
    with pytest.raises(ValueError, match="JSON list of class names"):
        load_label_set(*_write(tmp_path, {"a": 1}, np.zeros((1, 4), np.float32)))
    (tmp_path / "text.npy").write_bytes(b"not an array")
    (tmp_path / "classes.json").write_text('["a"]')
    with pytest.raises(ValueError, match="text.npy: expected an .npy file"):
        load_label_set(tmp_path / "classes.json", tmp_path / "text.npy")
    with pytest.raises(FileNotFoundError, match="one embedding row per class"):
        load_label_set(tmp_path / "classes.json", tmp_path / "none.npy")
    with pytest.raises(ValueError, match="different names"):
        LabelSet(("a", "a"), torch.zeros(2, 3))
    with pytest.raises(ValueError, match="expected one of wall, got 'chair'"):
        LabelSet(("wall",), torch.zeros(1, 3)).index("chair")
