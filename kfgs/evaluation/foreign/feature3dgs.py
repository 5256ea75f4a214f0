"""Feature 3DGS: a PLY with `semantic_0`, `semantic_1`, ... and, with its speed-up, a 1x1 convolution to 512 channels.

The layout is that of baselines.md 1.1. No sample could be had: the tests write files to that layout.
"""

from __future__ import annotations

from pathlib import Path

from ...formats import read_splats
from .decoders import perceptron_from_state
from .files import find_numbered, read_state
from .splatted import Level, SplattedMethod


def load_feature3dgs(run: str | Path, step: int | None = None, *, decoder: str | Path | None = None) -> SplattedMethod:
    """Read a run of Feature 3DGS. The 512-channel PLY of DF-3DGS has the same columns, without colours.

    `RUN/point_cloud/iteration_30000/point_cloud.ply`, and `RUN/decoder_chkpnt30000.pth` if there is one. A PLY alone will
    do, too. The convolution has a bias, so a Gaussian's feature is that of its value alone, decoded.

    Args:
        run: the run's folder, or its PLY.
        step: which iteration; None: the last.
        decoder: the convolution's file; None: that of the same step in the run's folder.

    Returns:
        One level, called "Feature 3DGS 128" (or as many channels as there are).

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if the PLY has no features, or a file is damaged or does not fit.
    """
    run = Path(run)
    what = "a point cloud of Feature 3DGS"
    ply = run if run.is_file() else find_numbered(run, "point_cloud/iteration_*/point_cloud.ply", step, what)
    gaussians = read_splats(ply).gaussians
    if gaussians.features is None:
        raise ValueError(
            f"{ply}: expected the columns semantic_0, semantic_1, ... of Feature 3DGS, got none; was this run trained with "
            "features?"
        )
    channels = int(gaussians.features.shape[1])
    file = Path(decoder) if decoder is not None else None
    if file is None and not run.is_file():
        beside = run / f"decoder_chkpnt{ply.parent.name.removeprefix('iteration_')}.pth"
        file = beside if beside.is_file() else None
    name = f"Feature 3DGS {channels}"
    if file is None:
        return SplattedMethod(name, [Level(gaussians)])
    state = read_state(file, "the 1x1 convolution of Feature 3DGS")
    convolution = perceptron_from_state(file, state, r"[\w.]+", channels)
    return SplattedMethod(name, [Level(gaussians, convolution, convolution.outputs)])
