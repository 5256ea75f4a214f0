import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import tells

from kfgs.cameras.camera import Camera
from kfgs.toy.colmap import write_model


def test_without_pycolmap_the_install_line_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    nothing = np.zeros((0, 3))
    with pytest.raises(ImportError, match=tells("pycolmap:", "'pycolmap>=4.0'")):
        write_model(
            tmp_path / "0", [Camera(torch.eye(4), torch.eye(3), 8, 8)], nothing, nothing.astype(np.uint8),
            np.zeros((0, 1), bool), np.zeros((0, 1, 2)),
        )  # fmt: skip
    assert not (tmp_path / "0").exists()
