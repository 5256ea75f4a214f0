"""How long does a label map take: one kernel that keeps the best class, against maps of all scores?

    python benchmarks/labels.py [--field FOLDER] [--scene SCENE] [--size 640x480] [--gaussians 30000] [--classes 18]
                                [--repeats 20] [--threads 2] [--device cuda] [--quick]

Without a field: a furnished room of Gaussians with random linear latents, and a random decoder of the paper's widths. With
one: its Gaussians, seen from its first training view or from the scene's first camera, at its own size. Both sides of a row
take turns in one process. The old side of each row is written here, on public functions.
"""

from __future__ import annotations

import argparse
import os
import statistics
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import torch
from devices import add_device, clock, device_name
from engines_room import room, view
from torch import Tensor

from kfgs import Camera
from kfgs.fields import Autoencoded, Linear, SemanticField
from kfgs.labels import classify
from kfgs.labels.classify import pixel_codewords
from kfgs.labels.scores import LOGIT_SCALE, TEMPERATURE
from kfgs.labels.selection import select_by_similarity
from kfgs.quant import Autoencoder, Codebook
from kfgs.scenes import load_scene
from kfgs.splat import bin_tiles, project, rasterize, rasterize_labels

DIM, LINEAR, LATENTS, CODEWORDS = 512, 24, 9, 100
BATCH = 16  # texts that are asked at once
DECODER = 9, 32, 64, 128, 256, 1024, 512  # Sec. 4 of the paper
CHUNK = 8192


class Row(NamedTuple):
    """What is compared: seconds of the old and of the new way, and whether their results are equal."""

    name: str
    old: list[float]
    new: list[float]
    equal: str

    def __str__(self) -> str:
        old, new = statistics.median(self.old), statistics.median(self.new)
        quickest = min(self.old) / min(self.new)
        return (
            f"| {self.name} | {1e3 * old:.1f} | {1e3 * new:.1f} | {old / new:.1f} | {quickest:.1f} | {1 / new:.0f} "
            f"| {1 / min(self.new):.0f} | {self.equal} |"
        )


def main() -> None:
    """Print a table of both sides, and the parts of the new one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--field", type=Path)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--gaussians", type=int, default=30_000)
    parser.add_argument("--classes", type=int, default=18)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--threads", type=int)
    add_device(parser)
    parser.add_argument("--quick", action="store_true", help="a tiny case, which only proves that it runs")
    args = parser.parse_args()
    if args.classes < 5:
        parser.error(f"--classes: expected at least 5, of which a row takes the best, got {args.classes}")
    if args.quick:
        args.size, args.gaussians, args.repeats = "48x32", 500, 2
    if args.threads:
        torch.set_num_threads(args.threads)
    width, height = map(int, args.size.split("x"))
    g = torch.Generator().manual_seed(0)
    rows = torch.randn(args.classes, DIM, generator=g)
    if args.field:
        field = SemanticField.load(args.field)
        cameras = load_scene(args.scene).cameras if args.scene else field.cameras
        fields, camera = [field], cameras[0].resized(height, width)
        own = field.classes  # whatever --classes says
        rows = torch.randn(args.classes, field.dim, generator=g) if own is None else own.embeddings
        if len(rows) < 5:
            parser.error(
                f"--field: expected a field of at least 5 classes, of which a row takes the best, got {len(rows)}"
            )
    else:
        fields, camera = (
            [random_linear(args.gaussians, rows, g), random_decoded(args.gaussians, g)],
            view(width, height),
        )
    fields, camera, rows = [field.to(args.device) for field in fields], camera.to(args.device), rows.to(args.device)
    print(f"{width} x {height} pixels, {len(fields[0])} Gaussians, {len(rows)} classes")
    print(
        f"{device_name(args.device)}, {torch.get_num_threads()} threads, load {os.getloadavg()[0]:.1f} at the start\n"
    )
    print("| what | old, ms | new, ms | ratio | of the quickest | per second | at best | equal |\n" + "|---" * 8 + "|")
    for field in fields:
        for row in compare(field, camera, rows, args.repeats):
            print(row, flush=True)
        if isinstance(field.decoder, Linear):
            print(parts(field, camera, rows, args.repeats), flush=True)
    print(f"\nload {os.getloadavg()[0]:.1f} at the end")


def random_linear(count: int, rows: Tensor, g: torch.Generator) -> SemanticField:
    """A fused field, in which boxes of half a metre have one of the classes, and features some noise."""
    basis = torch.linalg.qr(torch.randn(DIM, LINEAR, generator=g)).Q
    cloud = room(count, LINEAR)
    noise = 0.1 * torch.randn(count, LINEAR, generator=g)
    latents = torch.nn.functional.normalize(rows @ basis)[boxes(cloud.means) % len(rows)] + noise
    return SemanticField(cloud.replace(features=latents), Linear(basis))


def boxes(means: Tensor) -> Tensor:
    """A number for each box of half a metre, the same for all Gaussians in it."""
    return ((means + 10) * 2).floor().long() @ torch.tensor([1, 7, 31])


def random_decoded(count: int, g: torch.Generator) -> SemanticField:
    """A field of the paper's method: Gaussians near random latents, and codewords that are their decoded features."""
    state = {"range": torch.tensor([-1.0, 1.0], dtype=torch.float64)}
    for name, widths in (("encoder", DECODER[::-1]), ("decoder", DECODER)):
        for i, (into, out) in enumerate(pairwise(widths)):
            state[f"{name}.{i}.weight"] = torch.randn(out, into, generator=g) * (2 / into) ** 0.5
            state[f"{name}.{i}.bias"] = 0.1 * torch.randn(out, generator=g)
    autoencoder = Autoencoder.from_state_dict(state)
    latents = torch.rand(CODEWORDS, LATENTS, generator=g)
    cloud = room(count, LATENTS)
    cloud = cloud.replace(
        features=latents[boxes(cloud.means) % CODEWORDS] + 0.02 * torch.randn(count, LATENTS, generator=g)
    )
    return SemanticField(cloud, Autoencoded(Codebook(autoencoder.decode(latents)), autoencoder))


def compare(field: SemanticField, camera: Camera, rows: Tensor, repeats: int) -> list[Row]:
    """The rows of a field of either kind."""
    if isinstance(field.decoder, Linear):
        many = torch.randn(64, *rows.shape, generator=torch.Generator().manual_seed(1)).to(rows)
        texts = (iter([*many] * 2 * (1 + repeats)) for _ in range(2))
        old_texts, new_texts = texts
        return [
            measure("label map", lambda: blended(field, camera, rows), lambda: field.segment(camera, rows), repeats),
            measure(
                "label map by rendered features",
                lambda: similar(field, camera, rows),
                lambda: field.paper.segment(camera, rows),
                repeats,
            ),
            measure(
                "label map, another text each time",
                lambda: blended(field, camera, next(old_texts)),
                lambda: field.segment(camera, next(new_texts)),
                repeats,
            ),
            measure(
                "text query, score of each pixel",
                lambda: compared(field, camera, next(old_texts)),
                lambda: scored(field, camera, next(new_texts)[0], rows[1:5]),
                repeats,
                "blended scores, not scores of blended features",
            ),
            measure(
                f"{BATCH} text queries of a view, one by one and at once",
                lambda: torch.stack([scored(field, camera, text, rows[1:5]) for text in many[:BATCH, 0]]),
                lambda: scored_at_once(field, camera, many[:BATCH, 0], rows[1:5]),
                max(2, repeats // 5),
                "to 3e-7",
            ),
            measure(
                "5 best classes",
                lambda: blended(field, camera, rows, 5),
                lambda: field.rank(camera, rows, top=5).labels,
                repeats,
            ),
        ]
    if not isinstance(field.decoder, Autoencoded):
        raise SystemExit("--field: expected one with linear latents or with an autoencoder")
    book, coder = field.decoder.codebook, field.decoder.autoencoder
    table = classify(book.codewords, rows).labels
    rendering = field.render(camera)
    covered = rendering.alpha > 0
    return [
        measure(
            "exact decode",
            lambda: decoded(field, rendering.map, table, covered),
            lambda: table[pixel_codewords(rendering.map, book, coder, covered=covered)].masked_fill(~covered, -1),
            max(2, repeats // 5),
        )
    ]


def measure(
    name: str, old: Callable[[], Tensor], new: Callable[[], Tensor], repeats: int, equal: str | None = None
) -> Row:
    """Both sides in turn, after one call each that compiles."""
    one, other = old(), new()
    if equal is None:
        differing = int((one != other).sum())
        equal = "yes" if differing == 0 else f"but {differing} of {one.numel()}"
    seconds: tuple[list[float], list[float]] = ([], [])
    for _ in range(repeats):
        for call, times in zip((old, new), seconds, strict=True):
            times.append(clock(call))
    return Row(name, *seconds, equal)


def blended(field: SemanticField, camera: Camera, rows: Tensor, top: int = 1) -> Tensor:
    """The old label map: votes of all classes rendered to a map, and the largest of each pixel taken from it."""
    cosines, known = field.cosines(rows), field.known
    with torch.no_grad():
        winners = cosines.argmax(dim=1)[known].unique()
        votes = torch.softmax(LOGIT_SCALE * cosines[:, winners], dim=1) * known[:, None]
        seen = rasterize(field.gaussians.replace(features=votes.contiguous(), sh=None), camera).map
        if top == 1:
            most, index = seen.max(dim=-1)
        else:
            most, index = (value[..., :top] for value in seen.sort(dim=-1, descending=True, stable=True))
        return winners[index].masked_fill(most <= 0, -1)


def scored(field: SemanticField, camera: Camera, text: Tensor, negatives: Tensor) -> Tensor:  # [H, W]
    """How well each pixel fits a text: the mean score of the Gaussians that it shows, by how much it shows of each."""
    scores = field.query(text, None, 0.0, negatives=negatives).scores
    shown = rasterize_labels(field.gaussians.replace(features=scores[:, None].contiguous(), sh=None), camera)
    return shown.scores[..., 0] / shown.alphas.clamp_min(1e-6)


def scored_at_once(field: SemanticField, camera: Camera, texts: Tensor, negatives: Tensor) -> Tensor:  # [Q, H, W]
    """`scored` for Q texts: their scores are the channels of one picture, so a view is projected and composited once."""
    cosines = field.cosines(torch.cat([texts, negatives]))
    against = cosines[:, len(texts) :].amax(dim=1, keepdim=True)
    scores = torch.sigmoid(TEMPERATURE * (cosines[:, : len(texts)] - against)) * field.known[:, None]
    with torch.no_grad():
        shown = rasterize(field.gaussians.replace(features=scores, sh=None), camera)
    return (shown.map / shown.alpha[..., None].clamp_min(1e-6)).permute(2, 0, 1)


def similar(field: SemanticField, camera: Camera, rows: Tensor) -> Tensor:
    """The label map of the first versions: the features rendered, and similarities [H W, C] of all pixels."""
    seen = field.render(camera)
    unit = torch.nn.functional.normalize(rows, dim=1)
    pixels = seen.map.flatten(0, 1)
    labels = torch.cat([field.decoder.cosines(part, unit).argmax(dim=1) for part in pixels.split(CHUNK)])
    return labels.view(camera.size).masked_fill(seen.alpha <= 0, -1)


def compared(field: SemanticField, camera: Camera, rows: Tensor) -> Tensor:
    """The old text query: the features rendered, and each pixel compared with the target and four negatives."""
    unit = torch.nn.functional.normalize(rows[:5], dim=1)
    pixels = field.render(camera).map.flatten(0, 1)
    cosines = torch.cat([field.decoder.cosines(part, unit) for part in pixels.split(CHUNK)])
    return select_by_similarity(cosines[:, 0], cosines[:, 1:]).scores.view(camera.size)


def decoded(field: SemanticField, latents: Tensor, table: Tensor, covered: Tensor) -> Tensor:
    """The old exact decode: every pixel's feature, and the codeword most similar to it."""
    decoder = field.decoder
    assert isinstance(decoder, Autoencoded)
    labels = torch.full(covered.shape, -1, device=covered.device)
    with torch.no_grad():
        parts = latents[covered].split(CHUNK)
        labels[covered] = torch.cat([table[decoder.codebook.quantize(decoder.decode(part))] for part in parts])
    return labels


def parts(field: SemanticField, camera: Camera, rows: Tensor, repeats: int) -> str:
    """Medians of the parts of a label map, in ms."""
    votes = torch.softmax(LOGIT_SCALE * field.cosines(rows), dim=1)
    cloud = field.gaussians.replace(features=votes)
    with torch.no_grad():
        projected = project(cloud, camera)
        calls = {
            "projection": lambda: project(cloud, camera),
            "binning": lambda: bin_tiles(projected, camera.width, camera.height),
            "projection, binning, compositing and arg-max": lambda: rasterize_labels(cloud, camera),
            "the same for labels alone": lambda: rasterize_labels(cloud, camera, early=True),
            "the map of the same scores": lambda: rasterize(cloud, camera),
        }
        times = {name: statistics.median(measure(name, call, call, repeats, "").new) for name, call in calls.items()}
    return "\nParts: " + ", ".join(f"{name} {1e3 * value:.1f} ms" for name, value in times.items()) + "\n"


if __name__ == "__main__":
    main()
