"""Is LSeg's network at its full size the one of transformers? Seeded random weights in the checkpoint's layout.

    python benchmarks/lseg_exact.py
    python benchmarks/lseg_exact.py --whole CHECKPOINT PICTURE [--fast]

One window of 480 x 480 through kfgs and through transformers' DPT, and 32 prompts through both text towers, in float32, with
torch's fused attention (as in kfgs) and with transformers' own. Printed are the largest difference over the largest value,
seconds, and the peak memory of this process before transformers is loaded. It takes about a minute on two cores, 3 GiB, and
`pip install transformers`.

With --whole the teacher as it is used: a checkpoint in the layout of `demo_e200.ckpt` (`random_lseg.py` writes one) and a
picture, against torch's own loading, transformers' DPT, and the evaluation in windows as the tests' oracle does it, one
pixel after another in float64, for every 8th channel. One window, then the paper's 26: five to nine minutes of one core.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from kfgs.scenes import read_image
from kfgs.teachers.lseg import LSegOptions, load_lseg
from kfgs.teachers.lseg.keys import network_from_state, text_from_state
from kfgs.teachers.lseg.network import LSegConfig

TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path.append(str(TESTS))
from lseg_layout import random_state  # noqa: E402

EVERY = 8  # channels of a whole picture: each goes its own way behind the network, and the oracle's loops are slow


def main() -> None:
    """Compare what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--whole", nargs=2, type=Path, metavar=("CHECKPOINT", "PICTURE"))
    parser.add_argument("--fast", action="store_true", help="with --whole: one window only, not the paper's 26 as well")
    arguments = parser.parse_args()
    sys.path.append(str(TESTS))
    if arguments.whole is None:
        compare_networks()
        return
    for options in [LSegOptions.fast()] if arguments.fast else [LSegOptions.fast(), LSegOptions()]:
        compare_whole(*arguments.whole, options)


def compare_whole(checkpoint: Path, path: Path, options: LSegOptions) -> None:
    """Print how far the features of a picture are from those of the oracles."""
    import numpy as np
    import oracles_lseg
    from oracles_windows import evaluate, resize
    from PIL import Image

    picture = read_image(path).permute(2, 0, 1)
    height, width = picture.shape[1:]
    print(f"{path.name}, {height} x {width}: scales {options.scales}")
    teacher = load_lseg(checkpoint, scales=options.scales, flip=options.flip)
    features, seconds = timed(partial(teacher.encode_image, picture))
    print(f"kfgs:         {seconds:.1f} s, {tuple(features.shape)}, peak {peak_gib():.2f} GiB")

    state = torch.load(checkpoint, mmap=True, weights_only=True)["state_dict"]
    network = oracles_lseg.network(state, LSegConfig(), torch.float32)
    x = np.asarray(Image.open(path).convert("RGB"), dtype=np.float64).transpose(2, 0, 1) / 255 * 2 - 1
    if max(height, width) > 480:
        x = resize(x, *(int(side * 480 / max(height, width) + 0.5) for side in (height, width)))

    def head(window: np.ndarray) -> np.ndarray:
        return network(torch.from_numpy(window).float()[None])[0, ::EVERY].double().numpy()

    theirs, seconds = timed(lambda: torch.from_numpy(evaluate(x, head, 480, options.scales, options.flip)))
    ours = features[::EVERY].double()
    print(f"transformers: {seconds:.1f} s, {tuple(theirs.shape)}; {difference(ours, theirs)}")
    cosine = torch.nn.functional.cosine_similarity(ours, theirs, dim=0)
    print(f"least cosine of a pixel: 1 - {1 - float(cosine.min()):.1e}")


def compare_networks() -> None:
    """Print how far apart the networks are, given the same random weights."""
    config, generator = LSegConfig(), torch.Generator().manual_seed(0)
    state = random_state(config, generator)
    window = 2 * torch.rand(1, 3, config.window, config.window, generator=generator) - 1
    ids = prompts(config, 32, generator)
    print(f"{len(state)} tensors, {sum(value.numel() for value in state.values()) / 1e6:.1f} M values")
    print(f"state: peak {peak_gib():.2f} GiB; torch {torch.__version__}, {torch.get_num_threads()} threads")

    network = network_from_state(state, config, source="random")
    tower = text_from_state(state, config, source="random")
    print(f"image network: {sum(value.numel() for value in network.parameters()) / 1e6:.1f} M parameters")
    print(f"text tower:    {sum(value.numel() for value in tower.parameters()) / 1e6:.1f} M parameters")
    print(f"both built: peak {peak_gib():.2f} GiB")
    with torch.inference_mode():
        features, seconds = timed(lambda: network(window))
        print(f"kfgs, a window:  {seconds:.2f} s, peak {peak_gib():.2f} GiB, {tuple(features.shape)}")
        rows, seconds = timed(lambda: tower(input_ids=ids).text_embeds)
        print(f"kfgs, prompts:   {seconds:.2f} s, {tuple(rows.shape)}")

    import oracles_lseg

    for attention in ("sdpa", "eager"):
        expected, seconds = timed(partial(oracles_lseg.features, state, config, window, attention))
        print(f"transformers ({attention}), a window: {seconds:.2f} s with loading; {difference(features, expected)}")
        expected, seconds = timed(partial(oracles_lseg.text, state, config, ids, torch.float32, attention))
        print(f"transformers ({attention}), prompts:  {seconds:.2f} s with loading; {difference(rows, expected)}")


def prompts(config: LSegConfig, count: int, generator: torch.Generator) -> Tensor:  # [count, context] int64
    """Token numbers as a tokenizer gives them: start, 1 to 8 words, end, zeros."""
    ids = torch.zeros(count, config.context, dtype=torch.int64)
    for row in ids:
        words = 1 + int(torch.randint(8, (), generator=generator))
        row[0], row[words + 1] = config.vocabulary - 2, config.vocabulary - 1
        row[1 : words + 1] = torch.randint(config.vocabulary - 2, (words,), generator=generator)
    return ids


def timed(call: Callable[[], Tensor]) -> tuple[Tensor, float]:
    """What a call returns, and its seconds."""
    start = time.perf_counter()
    result = call()
    return result, time.perf_counter() - start


def difference(ours: Tensor, theirs: Tensor) -> str:
    """How far apart two tensors are, in words."""
    most, largest = float((ours - theirs).abs().max()), float(theirs.abs().max())
    return f"largest value {largest:.1f}, largest difference {most:.1e}, relative {most / largest:.1e}"


def peak_gib() -> float:
    """The most memory this process has held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


if __name__ == "__main__":
    main()
