"""LEGaussians: 8 numbers per Gaussian, a network from them to a code, and the codebook.

From baselines.md 1.3: the 8 numbers, divided by their length once splatted; 1x1 convolutions 8-128-256-K with ReLU between;
codes of 896 numbers, the first 512 of them the language half, mixed by the softmax with their raw lengths; `com_type = argmax`.
Our readings, confirmed by no sample: the names of files and folders; the columns `clip_f_indices_*`; the layers `conv<number>`;
`embedding.weight` in the codebook's file; and the order of the checkpoint's values, with the 8 numbers at place 4.
"""

from __future__ import annotations

from pathlib import Path

import torch

from kfgs._files import as_path
from kfgs.formats import read_splats
from kfgs.gaussians import Gaussians

from .decoders import CodeMixture, perceptron_from_state
from .files import check_rows, find_numbered, read_capture, read_state
from .splatted import Level, SplattedMethod

COLUMN = "clip_f_indices_"
_ORDER = "xyz dc rest - scales quats opacity"  # our reading: the 8 numbers are where the scales of others are


def load_legaussians_field(
    run: str | Path, codebook: str | Path, step: int | None = None, *, channels: int = 512, hard: bool = False
) -> SplattedMethod:
    """Read a run of LEGaussians.

    `RUN/chkpnt30000.pth`, or `RUN/point_cloud/iteration_30000/point_cloud.ply` with the columns `clip_f_indices_0`, ...;
    and `RUN/index_decoder_chkpnt30000.pth`. The splatted numbers are divided by their length, the network gives a logit per
    code, and the codes' language halves are mixed by the softmax, with their raw lengths.

    Args:
        run: the run's folder.
        codebook: the quantiser's file, with `embedding.weight` [K, 896].
        step: which iteration; None: the last.
        channels: how many of a code's numbers are the language half.
        hard: take the most likely code instead of the mixture.

    Returns:
        One level.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if one is damaged, of another program, or does not fit.
    """
    run = as_path(run)
    decoder = find_numbered(run, "index_decoder_chkpnt*.pth", step, "the index decoder of LEGaussians")
    at = int(decoder.stem.removeprefix("index_decoder_chkpnt"))
    gaussians = _read_gaussians(run, at)
    assert gaussians.features is not None
    state = read_state(decoder, "the index decoder of LEGaussians")
    network = perceptron_from_state(decoder, state, r"conv(\d+)", int(gaussians.features.shape[1]))
    book = read_state(as_path(codebook), "the codebook of LEGaussians").get("embedding.weight")
    if book is None or book.ndim != 2 or len(book) != network.outputs or book.shape[1] < channels:
        got = "none" if book is None else str(list(book.shape))
        raise ValueError(
            f"{codebook}: expected 'embedding.weight' [{network.outputs}, {channels} or more], a code per output of {decoder}, "
            f"got {got}; give the codebook of this run"
        )
    mixture = CodeMixture(network, book[:, :channels].contiguous(), hard)
    return SplattedMethod("LEGaussians", [Level(gaussians, mixture, channels)])


def _read_gaussians(run: Path, step: int) -> Gaussians:
    checkpoint = run / f"chkpnt{step}.pth"
    if checkpoint.is_file():
        found = read_capture(checkpoint, {"semantic features": 4}, _ORDER)
        features = found["semantic features"]
        check_rows(checkpoint, "semantic features", features, len(found["gaussians"]))
        cloud: Gaussians = found["gaussians"]
        return cloud.replace(features=features)
    ply = run / "point_cloud" / f"iteration_{step}" / "point_cloud.ply"
    if not ply.is_file():
        raise FileNotFoundError(
            f"{checkpoint}: no such file, nor {ply}; expected the Gaussians of LEGaussians in one of them"
        )
    splats = read_splats(ply)
    names = [f"{COLUMN}{i}" for i in range(sum(name.startswith(COLUMN) for name in splats.extra))]
    if not names or any(name not in splats.extra for name in names):
        raise ValueError(
            f"{ply}: expected the columns {COLUMN}0, {COLUMN}1, ... of LEGaussians, got none in that order"
        )
    return splats.replace(features=torch.stack([torch.from_numpy(splats.extra[n]).float() for n in names], 1))
