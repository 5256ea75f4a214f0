"""How much memory and time do 90 maps of 360 x 480 x 512 take, from pictures to index maps, or to a field?

    python benchmarks/streaming.py SCENE [--images 90] [--size 360 480] [--channels 512] [--epochs 28] [--folder DIR]
        [--splat PLY] [--device cuda]

With --epochs, the codebook is fitted as in the paper, in so many epochs. With --splat, the maps are also fused onto that file's
Gaussians, merged and compressed, as `kfgs fit --splat` does by default.

Each stage runs in a process of its own, whose highest resident memory is what Linux says (VmHWM): writing the maps with
`extract_features`, fitting the codebook, making the index maps. With --device cuda the stages compute on the GPU, and the table
also has the most memory that torch held there; `kfgs fit` does these stages on the CPU. The teacher is a seeded random matrix
on smoothed pictures, which takes next to nothing, so what is measured is all that surrounds a teacher. The maps (15.9 GB as
they stand) are deleted at the end, unless --folder names a place to keep them.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from devices import CPU, MapsOn, add_device, wait

from kfgs.cameras import resize_map
from kfgs.fields import UpliftConfig, uplift_maps
from kfgs.formats import read_splats
from kfgs.quant import Codebook, GrownCodebook, PaperCodebook, fit_codebook, quantize_maps
from kfgs.scenes import FeatureFolder, Scene, extract_features, load_scene

STAGES = ("start", "extract", "codebook", "index maps", "uplift")


class RandomTeacher:
    """Features that are a seeded random function of the smoothed colours: D channels, as many directions as colours."""

    name = "random"

    def __init__(self, size: tuple[int, int], channels: int, device: torch.device = CPU) -> None:
        self.size = size
        self.identity = {"name": self.name, "size": list(size), "channels": channels}
        self.matrix = torch.randn(channels, 3, generator=torch.Generator().manual_seed(0)).to(device)

    def encode_image(self, image: torch.Tensor) -> torch.Tensor:  # [3, H, W] -> [D, h, w]
        """Smooth, mix, bend."""
        cells = resize_map(image.to(self.matrix).permute(1, 2, 0), self.size, antialias=True) - 0.5
        return torch.tanh((cells @ self.matrix.T).mul_(4)).mul_(0.5).permute(2, 0, 1)

    def encode_text(self, prompts: object) -> torch.Tensor:
        """There is no text."""
        raise NotImplementedError


def main() -> None:
    """Run every stage in its own process and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument(
        "--images", type=int, default=90, help="views are taken again under other names if there are fewer"
    )
    parser.add_argument("--size", type=int, nargs=2, default=(360, 480), metavar=("H", "W"))
    parser.add_argument("--channels", type=int, default=512)
    parser.add_argument("--epochs", type=int, help="fit the codebook as in the paper, in so many epochs")
    parser.add_argument("--folder", type=Path, help="where the maps go, and stay; a temporary folder if not given")
    parser.add_argument("--splat", type=Path, help="also fuse the maps onto these Gaussians")
    parser.add_argument("--json", type=Path, help="also write the numbers here")
    add_device(parser)
    parser.add_argument("--stage", choices=STAGES, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.stage:
        print(json.dumps(run_stage(args)))
        return
    with tempfile.TemporaryDirectory(prefix="kfgs_streaming_") as temporary:
        args.folder = args.folder or Path(temporary)
        rows = [run_apart(args, stage) for stage in STAGES if stage != "uplift" or args.splat]
    dense = args.images * args.size[0] * args.size[1] * args.channels * 2
    print(
        f"{args.images} maps of {args.size[0]} x {args.size[1]} x {args.channels}: {dense / 1e9:.2f} GB in half precision"
    )
    print(f"on {args.device}\n")
    print("| stage | seconds | peak memory, GB | on the GPU, GB | |\n| --- | --- | --- | --- | --- |")
    for row in rows:
        on_gpu = "-" if row["peak_gpu"] is None else f"{row['peak_gpu'] / 1e9:.2f}"
        print(f"| {row['stage']} | {row['seconds']:.1f} | {row['peak'] / 1e9:.2f} | {on_gpu} | {row['note']} |")
    if args.json:
        args.json.write_text(json.dumps({"dense_bytes": dense, "stages": rows}, indent=2) + "\n")


def run_apart(args: argparse.Namespace, stage: str) -> dict[str, Any]:
    """One stage in a fresh process."""
    size, options = map(str, args.size), ("images", "channels", "epochs", "folder", "splat", "device")
    command = [sys.executable, __file__, str(args.scene), "--stage", stage, "--size", *size]
    given = [name for name in options if getattr(args, name) is not None]
    command += [text for name in given for text in (f"--{name}", str(getattr(args, name)))]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)  # the bars go to the terminal
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def run_stage(args: argparse.Namespace) -> dict[str, Any]:
    """One stage in this process: its name, seconds, peaks of memory in bytes, and a word about the result."""
    start = time.perf_counter()
    work = {
        "start": lambda args: "imports alone", "extract": extract, "codebook": codebook, "index maps": index_maps,
        "uplift": uplift,
    }  # fmt: skip
    note = work[args.stage](args)
    wait()
    found = {"stage": args.stage, "seconds": time.perf_counter() - start, "peak": highest_memory(), "note": note}
    return found | {"peak_gpu": torch.cuda.max_memory_allocated(args.device) if args.device.type == "cuda" else None}


def extract(args: argparse.Namespace) -> str:
    """Pictures to maps."""
    scene = load_scene(args.scene)
    turns = [i % len(scene) for i in range(args.images)]
    cameras = [replace(scene.cameras[i], name=f"{number:04d}.png") for number, i in enumerate(turns)]
    named = Scene(cameras, [scene.image_paths[i] for i in turns], scene.points, scene.colors)
    teacher = RandomTeacher(tuple(args.size), args.channels, args.device)
    folder = args.folder / "maps"
    made = extract_features(teacher, named, folder, "all", progress=True)
    return f"{sum((folder / f'{stem}.npy').stat().st_size for stem in made.pictures) / 1e9:.2f} GB written"


def codebook(args: argparse.Namespace) -> str:
    """Maps to a codebook."""
    options = GrownCodebook() if args.epochs is None else PaperCodebook(epochs=args.epochs)
    book = fit_codebook(MapsOn(FeatureFolder(args.folder / "maps"), args.device), options, progress=True)
    book.save(args.folder / "codebook.safetensors")
    return f"K = {book.size}, coverage {book.report.coverage:.3f}"


def index_maps(args: argparse.Namespace) -> str:
    """Maps and codebook to index maps."""
    book = Codebook.load(args.folder / "codebook.safetensors").to(args.device)
    found = quantize_maps(MapsOn(FeatureFolder(args.folder / "maps"), args.device), book, progress=True)
    found.save(args.folder / "index_maps.safetensors")
    return f"{sum(indices.nbytes for indices in found) / 1e6:.1f} MB"


def uplift(args: argparse.Namespace) -> str:
    """Maps and Gaussians to a field."""
    scene, maps = load_scene(args.scene).undistorted(), FeatureFolder(args.folder / "maps")
    cameras = [scene.cameras[i % len(scene.cameras)] for i in range(len(maps))]
    splat, config = read_splats(args.splat), UpliftConfig.field()
    gaussians = uplift_maps(splat.to(args.device), cameras, maps, config, progress=True).gaussians
    return f"{len(gaussians)} Gaussians, {gaussians.features.shape[1]} latents"


def highest_memory() -> int:
    """Bytes that this process has had in memory at most (pages of mapped files that it has touched count)."""
    status = Path("/proc/self/status").read_text()
    found = re.search(r"^VmHWM:\s*(\d+) kB", status, re.MULTILINE)
    assert found is not None
    return int(found.group(1)) * 1024


if __name__ == "__main__":
    main()
