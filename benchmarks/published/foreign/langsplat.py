"""LangSplat, LangSplatV2 and Occam's LGS: one checkpoint per level (s, m, l).

From baselines.md: LangSplat's 3 numbers per Gaussian, divided by their length + 1e-9, and the layers of its decoder (1.2);
LangSplatV2's 64 logits per Gaussian, the 4 largest of their softmax divided by their sum + 1e-10, and the product with its
codebook (2.1); that Occam's LGS keeps 512 numbers per Gaussian and level, and loses other Gaussians in each (2.2). From
formats.md: a checkpoint `chkpnt<step>.pth` is (12 values, step), Occam's has `_langfeat_1`, `_2`, `_3` in its name.

Our readings, confirmed by no sample: the order of the values (`files.read_capture`); that what was added stands at place 7
(features, logits) and 8 (codebooks, [layers, K, D]); the names `decoder.0`, `decoder.2`, ... of the decoder's layers and
`best_ckpt.pth` of its file; runs named `<scene>_1`, `_2`, `_3`; and that VALA's files are as Occam's.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from kfgs._check import check_whole
from kfgs._files import as_path

from .decoders import CodeSum, perceptron_from_state
from .files import check_rows, find_numbered, read_capture, read_state
from .splatted import Level, SplattedMethod

_TINY = 1e-9  # LangSplat divides a Gaussian's latent by its length and this
_TINY_SUM = 1e-10  # LangSplatV2 divides the weights it keeps by their sum and this

Runs = str | Path | Sequence[str | Path]


def load_langsplat(runs: Runs, autoencoder: str | Path, step: int | None = None) -> SplattedMethod:
    """Read a scene of LangSplat: three runs of 3 numbers per Gaussian, and the scene's autoencoder.

    A latent is divided by its length before it is splatted; the splatted latent is decoded as it is (the decoder's output
    is normalised).

    Args:
        runs: the folders of the runs in the order s, m, l (`figurines_1`, `figurines_2`, `figurines_3`), or what they have in
            common (`output/figurines`); checkpoints are accepted, too.
        autoencoder: `best_ckpt.pth`, whose layers are named `decoder.0`, `decoder.2`, ...
        step: which iteration; None: the last.

    Returns:
        As many levels as runs.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if one is damaged, or of another program.
    """
    file, levels = as_path(autoencoder), []
    state = read_state(file, "the autoencoder of LangSplat")
    for path in _checkpoints(runs, step, "chkpnt*.pth", "a checkpoint of LangSplat"):
        found = read_capture(path, {"language features": 7})
        latents = found["language features"]
        check_rows(path, "language features", latents, len(found["gaussians"]))
        decoder = perceptron_from_state(file, state, r"decoder\.(\d+)", int(latents.shape[1]))
        unit = latents / (latents.norm(dim=1, keepdim=True) + _TINY)
        levels.append(Level(found["gaussians"].replace(features=unit), decoder, decoder.outputs))
    return SplattedMethod("LangSplat", levels)


def load_langsplat_v2(runs: Runs, step: int | None = None, *, top: int = 4) -> SplattedMethod:
    """Read a scene of LangSplatV2: per level a logit per Gaussian and code, and the codebook.

    The `top` largest of a Gaussian's softmax, divided by their sum, are splatted; a pixel's feature is the product with the
    codebook.

    Args:
        runs: as for `load_langsplat`.
        step: which iteration; None: the last.
        top: how many codes a Gaussian keeps; 4 as published.

    Returns:
        As many levels as runs.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if one is damaged, of another program, or has residual codebooks (several layers).
    """
    check_whole("top", top, 1)
    levels = []
    for path in _checkpoints(runs, step, "chkpnt*.pth", "a checkpoint of LangSplatV2"):
        found = read_capture(path, {"logits": 7, "codebooks": 8})
        logits, books = found["logits"], found["codebooks"]
        check_rows(path, "logits", logits, len(found["gaussians"]))
        if books.ndim != 3 or len(books) != 1 or books.shape[1] != logits.shape[1]:
            raise ValueError(
                f"{path}: expected one codebook [1, {logits.shape[1]}, D] (a code per logit), got {list(books.shape)}; residual "
                "codebooks (vq_layer_num above 1) are not read"
            )
        weights = sparse_weights(logits, min(top, int(logits.shape[1])))
        levels.append(Level(found["gaussians"].replace(features=weights), CodeSum(books[0]), int(books.shape[2])))
    return SplattedMethod("LangSplatV2", levels)


def sparse_weights(logits: Tensor, top: int) -> Tensor:  # [N, K] -> [N, K]
    """The `top` largest of each row's softmax, divided by their sum; the others are zero.

    Example:
        >>> sparse_weights(torch.log(torch.tensor([[0.5, 0.3, 0.2]])), 2)
        tensor([[0.6250, 0.3750, 0.0000]])
    """
    values, index = logits.softmax(-1).topk(top, dim=-1)
    return torch.zeros_like(logits).scatter_(1, index, values / (values.sum(-1, keepdim=True) + _TINY_SUM))


def load_occam(run: str | Path, step: int | None = None) -> SplattedMethod:
    """Read a run of Occam's LGS: `chkpnt30000_langfeat_1.pth`, `_2`, `_3`, with the uplifted features as they are.

    Each level has lost other Gaussians (those that no view activated), so each is rendered with its own. VALA's checkpoints
    should have the same layout; no sample confirms it.

    Args:
        run: the run's folder, or one checkpoint.
        step: which iteration; None: the last.

    Returns:
        The levels that are there, in order.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if one is damaged, or of another program.
    """
    run = as_path(run)
    if run.is_file():
        paths = [run]
    else:
        what = "a checkpoint of Occam's LGS"
        first = find_numbered(run, "chkpnt*_langfeat_1.pth", step, what)
        paths = [
            first.with_name(first.name.replace("_langfeat_1.pth", f"_langfeat_{level}.pth")) for level in (1, 2, 3)
        ]
        paths = [path for path in paths if path.is_file()]
    levels = []
    for path in paths:
        found = read_capture(path, {"language features": 7})
        features = found["language features"]
        check_rows(path, "language features", features, len(found["gaussians"]))
        levels.append(Level(found["gaussians"].replace(features=features)))
    return SplattedMethod("Occam's LGS", levels)


def level_runs(base: Path) -> list[Path]:
    """The folders of the three runs that have a name in common: `figurines_1`, `figurines_2`, `figurines_3`."""
    return [base.with_name(f"{base.name}_{level}") for level in (1, 2, 3)]


def has_levels(base: Path) -> bool:
    """Whether all three are there. They then count, and not what is in `figurines` itself, which is the run of the colours."""
    return all(run.is_dir() for run in level_runs(base))


def _checkpoints(runs: Runs, step: int | None, pattern: str, what: str) -> list[Path]:
    """The checkpoint of each level."""
    if isinstance(runs, str | Path):
        base = as_path(runs)
        folders = [base] if base.exists() and not has_levels(base) else level_runs(base)
    else:
        folders = [as_path(run) for run in runs]
    if not folders:
        raise ValueError("runs: expected the folders of one to three runs, got none; give them in the order s, m, l")
    return [path if path.is_file() else find_numbered(path, pattern, step, what) for path in folders]
