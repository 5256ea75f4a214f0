"""How long does a label map take in this checkout and in an older one? Both in turns, each in a process of its own.

    python benchmarks/labels_before.py OLD_CHECKOUT FIELD SCENE [--size 640x480] [--repeats 30] [--threads 2]

FIELD is the folder of a default field (`RUN/field`), SCENE has its classes. The oldest versions know no linear latents: both
sides get the Gaussians as a field of the teacher's features in the latents' space, and the texts projected there. So both
answer the same question, the class most similar to the rendered feature.
"""

from __future__ import annotations

import argparse
import inspect
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

SIDE = "--side"


def main() -> None:
    """Print the medians, the quickest, and how many labels differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", type=Path)
    parser.add_argument("field", type=Path)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument(SIDE, action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.side:
        answer(args)
        return
    sides = [start(checkout) for checkout in (args.old, Path(__file__).parents[1])]
    labels = [ask(side, "labels") for side in sides]
    times = [[float(ask(side, "time")) for side in sides] for _ in range(args.repeats)]
    old, new = zip(*times, strict=True)
    for name, found in (("old", old), ("new", new)):
        print(f"{name}: {statistics.median(found):.1f} ms, at best {min(found):.1f}")
    print(f"ratio {statistics.median(old) / statistics.median(new):.2f}, of the quickest {min(old) / min(new):.2f}")
    differing = sum(one != other for one, other in zip(*(text.split() for text in labels), strict=True))
    print(f"{differing} of {len(labels[0].split())} labels differ")


def start(checkout: Path) -> subprocess.Popen[str]:
    """A process that imports kfgs from a checkout, and answers line by line."""
    command = [sys.executable, os.path.abspath(__file__), *sys.argv[1:], SIDE]
    environment = os.environ | {"PYTHONPATH": str(checkout.resolve())}
    return subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def ask(side: subprocess.Popen[str], question: str) -> str:
    """One question, one line."""
    assert side.stdin is not None
    assert side.stdout is not None
    side.stdin.write(question + "\n")
    side.stdin.flush()
    return side.stdout.readline().strip()


def answer(args: argparse.Namespace) -> None:
    """One side: questions from standard input."""
    import numpy as np
    import torch
    from safetensors.torch import load_file

    from kfgs import Gaussians
    from kfgs.fields import SemanticField
    from kfgs.scenes import load_scene

    torch.set_num_threads(args.threads)
    width, height = map(int, args.size.split("x"))
    tensors = load_file(args.field / "field.safetensors")
    parts = {name.split(".")[1]: value for name, value in tensors.items() if name.startswith("gaussians.")}
    texts = torch.from_numpy(np.load(args.scene / "text.npy")).float()
    rows = torch.nn.functional.normalize(texts, dim=1) @ tensors["linear.basis"]
    camera, gaussians = load_scene(args.scene).cameras[0].resized(height, width), Gaussians(**parts)
    options = {"rule": "paper"} if "rule" in inspect.signature(SemanticField.segment).parameters else {}
    if "linear" in inspect.signature(SemanticField).parameters:
        from kfgs.quant import LinearLatents

        field = SemanticField(gaussians, linear=LinearLatents(torch.eye(gaussians.features.shape[1])))
    else:
        field = SemanticField(gaussians)
    found = field.segment(camera, rows, **options)
    for question in sys.stdin:
        if question.strip() == "labels":
            print(*found.flatten().tolist(), flush=True)
        else:
            began = time.perf_counter()
            field.segment(camera, rows, **options)
            print(1e3 * (time.perf_counter() - began), flush=True)


if __name__ == "__main__":
    main()
