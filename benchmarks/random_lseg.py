"""Write a checkpoint in the layout of LSeg's `demo_e200.ckpt` with random weights: 730 tensors, 2.0 GB (1.7 GB with --half-text).

With it everything that needs the released file can be run and measured where that is not at hand; the features mean
nothing. `python benchmarks/random_lseg.py OUT` takes ten seconds.
"""

import argparse
import sys
from pathlib import Path

import torch

from kfgs._files import atomic_path
from kfgs.teachers.lseg import LSegConfig

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from lseg_layout import random_state


def save_random_checkpoint(out: Path, config: LSegConfig, *, seed: int = 0, half_text: bool = False) -> int:
    """Draw the weights and write them as Lightning does; returns how many tensors there are."""
    state = random_state(config, torch.Generator().manual_seed(seed), half_text=half_text)
    checkpoint = {
        "epoch": 200,
        "global_step": 0,
        "pytorch-lightning_version": "1.3.5",
        "hyper_parameters": {"backbone": "clip_vitl16_384", "num_features": 256, "arch_option": 0},
        "state_dict": state,
    }
    with atomic_path(out) as temporary:
        torch.save(checkpoint, temporary)
    return len(state)


def main() -> None:
    """Write the file that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="the file to write")
    parser.add_argument("--half-text", action="store_true", help="CLIP's matrices in float16, as in the released file")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    count = save_random_checkpoint(arguments.out, LSegConfig(), seed=arguments.seed, half_text=arguments.half_text)
    print(f"{arguments.out}: {arguments.out.stat().st_size / 1e9:.2f} GB, {count} tensors")


if __name__ == "__main__":
    main()
