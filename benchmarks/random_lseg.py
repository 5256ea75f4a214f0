"""Write a checkpoint in the layout of LSeg's `demo_e200.ckpt` with random weights: 730 tensors, 2.0 GB.

With it everything that the released file is needed for can be run and measured where that file is not at hand; the features
mean nothing. `python benchmarks/random_lseg.py OUT` takes half a minute.
"""

import argparse
from pathlib import Path

import torch

from kfgs._files import atomic_path
from kfgs.teachers.lseg import LSegConfig
from kfgs.teachers.lseg.layout import random_state


def main() -> None:
    """Draw the weights and write them as Lightning does."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="the file to write")
    parser.add_argument("--half-text", action="store_true", help="CLIP's matrices in float16, as in the released file")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    generator = torch.Generator().manual_seed(arguments.seed)
    checkpoint = {
        "epoch": 200,
        "global_step": 0,
        "pytorch-lightning_version": "1.3.5",
        "hyper_parameters": {"backbone": "clip_vitl16_384", "num_features": 256, "arch_option": 0},
        "state_dict": random_state(LSegConfig(), generator, half_text=arguments.half_text),
    }
    with atomic_path(arguments.out) as temporary:
        torch.save(checkpoint, temporary)
    print(f"{arguments.out}: {arguments.out.stat().st_size / 1e9:.2f} GB, {len(checkpoint['state_dict'])} tensors")


if __name__ == "__main__":
    main()
