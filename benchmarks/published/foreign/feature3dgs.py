"""Feature 3DGS: a PLY with `semantic_0`, `semantic_1`, ... and, with its speed-up, a 1x1 convolution to 512 channels; DF-3DGS.

From baselines.md 1.1: the columns `semantic_*` after the standard ones, the name `decoder_chkpnt<step>.pth`, and the one 1x1
convolution with a bias, no activation and no normalisation. Of DF-3DGS, from df3dgs_code.md: the same columns without colours,
and an autoencoder in `latest_AE_ckpt.pth` whose decoder is linear layers with ReLU between. Our readings, confirmed by no sample:
the folders `point_cloud/iteration_<step>/`, that the decoder lies in the run's folder, that its file is a state dict, and that an
autoencoder's layers are called `decoder.<n>.weight`; other names are not used.
"""

from __future__ import annotations

import re
from pathlib import Path

from kfgs._files import as_path
from kfgs.formats import read_splats

from .decoders import perceptron_from_state
from .files import find_numbered, read_state
from .splatted import Level, SplattedMethod

AUTOENCODER = re.compile(r"decoder\.(\d+)")  # a layer of DF-3DGS's


def load_feature3dgs(run: str | Path, step: int | None = None, *, decoder: str | Path | None = None) -> SplattedMethod:
    """Read a run of Feature 3DGS, or of DF-3DGS, whose PLY has the same columns, without colours.

    `RUN/point_cloud/iteration_30000/point_cloud.ply`, and `RUN/decoder_chkpnt30000.pth` if there is one. A PLY alone is
    enough. The convolution has a bias, so a Gaussian's feature is that of its value alone, decoded. Of DF-3DGS with 9
    channels, `decoder` is the scene's autoencoder; features are decoded, and not quantised afterwards.

    Args:
        run: the run's folder, or its PLY.
        step: which iteration; None: the last.
        decoder: the file of the convolution or of the autoencoder; None: the convolution of the same step in the run's folder.

    Returns:
        One level, called "Feature 3DGS 128" (or as many channels as there are), with an autoencoder "DF-3DGS 9".

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if the PLY has no features, or a file is damaged or does not fit.
    """
    run = as_path(run)
    what = "a point cloud of Feature 3DGS"
    ply = run if run.is_file() else find_numbered(run, "point_cloud/iteration_*/point_cloud.ply", step, what)
    gaussians = read_splats(ply)
    if gaussians.features is None:
        raise ValueError(
            f"{ply}: expected the columns semantic_0, semantic_1, ... of Feature 3DGS, got none; was this run trained with "
            "features?"
        )
    channels = int(gaussians.features.shape[1])
    file = as_path(decoder) if decoder is not None else None
    if file is None and not run.is_file():
        beside = run / f"decoder_chkpnt{ply.parent.name.removeprefix('iteration_')}.pth"
        file = beside if beside.is_file() else None
    name = f"Feature 3DGS {channels}"
    if file is None:
        return SplattedMethod(name, [Level(gaussians)])
    state = read_state(file, "the 1x1 convolution of Feature 3DGS, or the autoencoder of DF-3DGS")
    layers = r"[\w.]+"
    if any(AUTOENCODER.fullmatch(entry.removesuffix(".weight")) for entry in state):
        name, layers = f"DF-3DGS {channels}", AUTOENCODER.pattern
    network = perceptron_from_state(file, state, layers, channels)
    return SplattedMethod(name, [Level(gaussians, network, network.outputs)])
