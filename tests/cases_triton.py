"""The Triton engine's cases, and a script that runs them in a process of its own and prints the results as JSON.

    TRITON_INTERPRET=1 python tests/cases_triton.py run cpu     # the kernels in numpy
    python tests/cases_triton.py run cuda                       # on a GPU
    python tests/cases_triton.py run cuda 2/6                   # the third of six shares of that
    python tests/cases_triton.py compile                        # for GPUs that are not there

Triton decides at its import whether it interprets, and pytest may have imported it before: hence the process.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import traceback
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import torch
from cases_splat import a_camera, gaussians_before, random_splats
from torch import Tensor

from kfgs.splat import Projected, Tiles, accumulate_pixels, bin_tiles, composite, project, rasterize
from kfgs.splat.engines import rank_channels
from kfgs.splat.engines.contract import Splats

GRADS = ("means2d", "conics", "opacities", "features", "background")
OF_FRAME = ("means", "quats", "scales", "opacities", "features", "background")


class Case(NamedTuple):
    """A scene of random Gaussians, or a stack of flat ones that covers one tile."""

    channels: int = 3
    tile_size: int = 16
    count: int = 20  # Gaussians
    size: tuple[int, int] = (18, 13)  # width, height: the tiles of 16 are cut off
    rows_of_features: int | None = None  # index into that many rows, the last of which none shows
    opacities: tuple[float, ...] = (0.05, 0.95)  # range of random ones, or the stack's
    sigma: tuple[float, float] = (0.7, 6.0)
    stack: bool = False
    manners: bool = False  # also ask for each gradient alone, and for the same again
    integers: tuple[torch.dtype, torch.dtype] = (torch.int32, torch.int64)  # of tiles.rows and tiles.offsets


CASES = {
    "one channel": Case(1),
    "9 channels": Case(9),
    "40 channels": Case(40),
    "130 channels": Case(130, count=8),
    "indexed": Case(9, count=12, rows_of_features=20, manners=True),
    "indexed, more rows than Gaussians": Case(40, rows_of_features=90),
    "tiles of 5": Case(tile_size=5),
    "tiles of 12": Case(tile_size=12),
    "tiles of 32, wide": Case(70, tile_size=32, size=(34, 20), count=12),
    "rows int64, offsets int32": Case(integers=(torch.int64, torch.int32)),
    "many that stop": Case(count=150, size=(12, 9), opacities=(0.3, 0.6), sigma=(3.0, 30.0)),
    "clamped": Case(opacities=(0.999,), stack=True),
    # 1e-3 is left after three; the fourth would leave 5e-5, so it is not drawn, nor the fifth, which would leave 9e-4
    "stop": Case(5, opacities=(0.9, 0.9, 0.9, 0.95, 0.1), stack=True),
    "stop in the third chunk": Case(opacities=(*[0.1] * 36, 0.9, 0.9, 0.995, *[0.02] * 20), stack=True),
    "ties": Case(70, opacities=(0.5, 0.5, 0.5), stack=True),
    "skipped": Case(opacities=(0.999 / 255, 0.5, 0.999 / 255), stack=True),
    "opacity 0": Case(opacities=(0.0, 0.5), stack=True),
    "empty tiles": Case(count=3, size=(60, 13), sigma=(0.7, 2.0)),
    "no Gaussians, indexed": Case(count=0, rows_of_features=4, manners=True),
}


def make_scene(case: Case, device: str) -> tuple[list[Tensor], Tensor | None, Tiles, Tensor, Tensor]:
    """The five differentiable inputs, index, tiles, and cotangents of maps and alphas, float32."""
    if case.stack:
        M = len(case.opacities)
        means2d, flat = torch.full((M, 2), 8.0), torch.tensor([[1e-13, 0.0, 1e-13]]).repeat(M, 1)
        tiles = Tiles(torch.arange(M, dtype=torch.int32), torch.tensor([0, M]), 16, 16, 16)
        splats = [means2d, flat, torch.tensor(case.opacities)]
    else:
        M = case.count
        projected, _ = random_splats(
            M, *case.size, seed=3, dtype=torch.float32, opacities=case.opacities[:2], sigma=case.sigma
        )
        tiles = bin_tiles(projected, *case.size, case.tile_size)
        splats = [projected.means2d, projected.conics, projected.opacities]
    tiles = tiles._replace(rows=tiles.rows.to(case.integers[0]), offsets=tiles.offsets.to(case.integers[1]))
    g = torch.Generator().manual_seed(4)
    N, D = case.rows_of_features or M, case.channels
    index = torch.randint(0, N - 1, (M,), generator=g) if case.rows_of_features else None
    features, background = torch.randn(N, D, generator=g), torch.randn(D, generator=g)
    cotangents = (
        torch.randn(tiles.height, tiles.width, D, generator=g),
        torch.randn(tiles.height, tiles.width, generator=g),
    )
    tiles = tiles._replace(rows=tiles.rows.to(device), offsets=tiles.offsets.to(device))
    inputs = [value.to(device) for value in (*splats, features, background)]
    return inputs, index if index is None else index.to(device), tiles, *(value.to(device) for value in cotangents)


def reference(
    inputs: list[Tensor], index: Tensor | None, tiles: Tiles, grad_maps: Tensor, grad_alphas: Tensor
) -> dict[str, Tensor]:
    """What the engine should give, by the reference engine in float64 on the CPU."""
    inputs = [value.detach().cpu().double().requires_grad_() for value in inputs]
    index = torch.arange(len(inputs[0])) if index is None else index.cpu()
    tiles = tiles._replace(rows=tiles.rows.cpu(), offsets=tiles.offsets.cpu())
    grad_maps, grad_alphas = grad_maps.cpu().double(), grad_alphas.cpu().double()
    splats = inputs[:3]
    maps, alphas = composite(*splats, inputs[3][index], tiles, background=inputs[4], engine="reference")
    grads = torch.autograd.grad((maps, alphas), inputs, (grad_maps, grad_alphas))
    # the gradient in the features is weights^T · cotangent; a channel of ones gives the weights' sums
    of = torch.zeros(len(index), grad_maps.shape[2] + 1, dtype=torch.float64, requires_grad=True)
    seen, _ = composite(*(value.detach() for value in splats), of, tiles, engine="reference")
    (weighted,) = torch.autograd.grad(seen, of, torch.cat([grad_maps, torch.ones_like(grad_maps[..., :1])], dim=2))
    named = dict(zip(GRADS, grads, strict=True))
    return {"maps": maps, "alphas": alphas, **named, "sums": weighted[:, :-1], "weights": weighted[:, -1]}


def run_case(case: Case, device: str) -> dict[str, float | bool]:
    """Largest errors: of maps and alphas as they are, of all else relative to the largest number; and some facts."""
    inputs, index, tiles, *cotangents = make_scene(case, device)
    before = [value.clone() for value in inputs]
    inputs = [value.requires_grad_() for value in inputs]
    maps, alphas = composite(*inputs[:4], tiles, background=inputs[4], index=index, engine="triton")
    grads = torch.autograd.grad((maps, alphas), inputs, cotangents)
    sums, weights = accumulate_pixels(*inputs[:3], cotangents[0], tiles, engine="triton")
    actual = {"maps": maps, "alphas": alphas, "sums": sums, "weights": weights, **dict(zip(GRADS, grads, strict=True))}
    facts = compare(actual, reference(inputs, index, tiles, *cotangents))
    facts |= check_ranks(inputs, index, tiles, ties=set(case.opacities) == {0.5})
    facts["inputs untouched"] = all(torch.equal(a, b) for a, b in zip(inputs, before, strict=True))
    facts["differentiable"] = (
        maps.requires_grad and alphas.requires_grad and not (sums + weights[:, None]).requires_grad
    )
    return facts | check_manners(inputs, index, tiles, cotangents, grads) if case.manners else facts


def check_ranks(inputs: list[Tensor], index: Tensor | None, tiles: Tiles, *, ties: bool) -> dict[str, float | bool]:
    """Whether the best channels are those of the maps of the reference, in order, wherever rounding cannot change it."""
    truth, alphas = composite(
        *(value.detach().cpu().double() for value in inputs[:3]),
        inputs[3].detach().cpu().double(),
        tiles._replace(rows=tiles.rows.cpu(), offsets=tiles.offsets.cpu()),
        index=index if index is None else index.cpu(),
        engine="reference",
    )
    facts: dict[str, float | bool] = {}
    channels = truth.shape[2]
    for top in sorted({1, min(3, channels)}):
        found = rank_channels(*inputs[:4], tiles, top=top, index=index, engine="triton")
        labels, scores = found.labels.cpu(), found.scores.cpu().double()
        drawn = (alphas > 0)[..., None]
        ordered = truth.sort(dim=-1, descending=True).values[..., :top]
        facts[f"top {top}: drawn"] = torch.equal(labels >= 0, drawn.expand_as(labels))
        facts[f"top {top}: scores"] = largest((scores - ordered) * drawn) <= 1e-5
        facts[f"top {top}: labels"] = largest((truth.gather(2, labels.clamp_min(0)) - ordered) * drawn) <= 1e-5
        distinct = labels.sort(dim=-1).values.diff(dim=-1) > 0
        facts[f"top {top}: each once"] = bool((distinct | ~drawn).all())
        facts[f"top {top}: alphas"] = largest(found.alphas.cpu().double() - alphas) <= 1e-5
    from kfgs.splat.engines.triton import engine as triton_engine

    most, triton_engine.MOST_RANKED = triton_engine.MOST_RANKED, 0  # as for more channels than registers hold
    try:
        many = rank_channels(*inputs[:4], tiles, top=top, index=index, engine="triton")
    finally:
        triton_engine.MOST_RANKED = most
    facts["sorted maps: drawn"] = torch.equal(many.labels >= 0, found.labels >= 0)
    chosen = truth.gather(2, many.labels.cpu().clamp_min(0))
    facts["sorted maps: labels"] = largest((chosen - ordered) * drawn) <= 1e-5
    facts["sorted maps: scores"] = largest(many.scores - found.scores) <= 1e-5
    nothing = rank_channels(*inputs[:3], inputs[3] * torch.nan, tiles, index=index, engine="triton")
    facts["no label out of range"] = bool((nothing.labels == -1).all())
    if ties:  # sums of halves, quarters and so on are exact
        same = rank_channels(*inputs[:3], torch.ones_like(inputs[3]), tiles, top=channels, index=index, engine="triton")
        facts["ties go to the lowest"] = torch.equal(
            same.labels.cpu(), torch.arange(channels).where((alphas > 0)[..., None], -1)
        )
    return facts


def check_manners(
    inputs: list[Tensor], index: Tensor | None, tiles: Tiles, cotangents: list[Tensor], grads: tuple[Tensor, ...]
) -> dict[str, float | bool]:
    """Whether the same comes out again, and whether what is asked for alone is what comes with the others."""
    from kfgs.splat.engines.triton import engine as triton_gpu

    facts: dict[str, float | bool] = {}
    values = [value.detach() for value in inputs]
    splats = Splats(*values, index)
    outputs, again = (triton_gpu.ENGINE.forward(splats, tiles) for _ in range(2))
    same = (torch.equal(a, b) for a, b in zip(again[:2], outputs[:2], strict=True))  # the trace has an unwritten gap
    facts["forward repeats to the bit"] = all(same)
    for k, name in enumerate(GRADS):
        leaves = [value.clone().requires_grad_(j == k) for j, value in enumerate(values)]
        seen = composite(*leaves[:4], tiles, background=leaves[4], index=index, engine="triton")
        (alone,) = torch.autograd.grad(seen, leaves[k], cotangents)
        facts[f"{name} wanted alone"] = largest(alone - grads[k]) <= 1e-5 * largest(grads[k])
        # autograd drops what is not wanted; the engine must not have computed it
        given = triton_gpu.ENGINE.backward(cotangents, [k == j for j in range(5)], splats, tiles, outputs)
        facts[f"nothing but {name} computed"] = all(value is None for j, value in enumerate(given) if j != k)
    return facts


def run_frame(device: str) -> dict[str, float | bool]:
    """A whole frame of 60 Gaussians, forward and backward, and what the reference engine makes of it in float64."""

    def run(dtype: torch.dtype, place: str, engine: str) -> dict[str, Tensor]:
        camera = a_camera(dtype=torch.float32)
        gaussians = gaussians_before(camera, 60, seed=5, spread=1.5, channels=9).to(dtype).to(place)
        leaves = {name: getattr(gaussians, name).requires_grad_() for name in OF_FRAME[:-1]}
        g = torch.Generator().manual_seed(6)
        shapes = (9,), (camera.height, camera.width, 9), (camera.height, camera.width)
        background, *cotangents = (torch.randn(shape, generator=g).to(place, dtype) for shape in shapes)
        leaves["background"] = background.requires_grad_()
        seen = rasterize(gaussians, camera, background=background, engine=engine)
        seen.projected.means2d.retain_grad()  # as densification does
        torch.autograd.backward((seen.map, seen.alpha), cotangents)
        grads = {name: leaf.grad for name, leaf in leaves.items()}
        return {"map": seen.map, "alpha": seen.alpha, **grads, "means2d": seen.projected.means2d.grad}

    expected = run(torch.float64, "cpu", "reference")
    facts = compare(run(torch.float32, device, "triton"), expected)
    facts["most can be seen"] = len(expected["means2d"]) > 30 and bool((expected["alpha"] > 0.1).double().mean() > 0.5)
    return facts


PROJECTED = ("means2d", "conics", "depths", "opacities", "extents")
OF_PROJECTION = ("grad of means", "grad of quats", "grad of scales", "grad of opacities")
PROJECTIONS = {  # Gaussians, low_pass, tile_size
    "thin": (150, 0.0, 5), "as usual": (150, 0.3, 8), "wide": (150, 1.0, 16), "one": (1, 0.3, 8), "none": (0, 0.3, 8),
}  # fmt: skip


def run_projection(count: int, low_pass: float, tile_size: int, device: str) -> dict[str, float | bool]:
    """The projection, its gradient and the lists of tiles, of a cloud that has every reason for culling."""
    camera = a_camera(dtype=torch.float32)
    cloud = gaussians_before(camera, max(count, 1), seed=7, spread=2.5 if count > 1 else 0.1, channels=3)
    cloud = cloud.to(torch.float32)[torch.arange(max(count, 1)) < count]
    means, quats, scales, opacities = (getattr(cloud, name).clone() for name in OF_FRAME[:4])
    if count > 1:
        means[:20] = camera.center - 2 * (means[:20] - camera.center)  # behind the camera
        means[20], scales[21], quats[22], opacities[23], opacities[24] = float("nan"), float("inf"), 0.0, 0.0, 1 / 256
    leaves = means, quats, scales, opacities

    def run(dtype: torch.dtype, place: str, engine: str) -> tuple[Projected, dict[str, Tensor]]:
        given = [value.to(place, dtype).requires_grad_() for value in leaves]
        shown = cloud.to(place, dtype).replace(**dict(zip(OF_FRAME[:4], given, strict=True)))
        seen = project(shown, camera, low_pass=low_pass, engine=engine)
        g = torch.Generator().manual_seed(8)
        cotangents = [torch.randn(count, *v.shape[1:], generator=g)[seen.index.cpu()].to(v) for v in seen[:4]]
        grads = torch.autograd.grad(seen[:4], given, cotangents)
        named = dict(zip(PROJECTED, seen, strict=False)) | dict(zip(OF_PROJECTION, grads, strict=True))
        return seen, {name: value.detach() for name, value in named.items()}

    (seen, actual), (truth, expected) = run(torch.float32, device, "triton"), run(torch.float64, "cpu", "reference")
    facts = {name: largest((actual[name].cpu().double() - v) / (1 + v.abs())) for name, v in expected.items()}
    for name in OF_PROJECTION:
        facts[name] = largest(actual[name].cpu().double() - expected[name]) / (largest(expected[name]) or 1.0)
    seen = Projected(*(value.detach() for value in seen))
    tiles = bin_tiles(seen, camera.width, camera.height, tile_size, engine="triton")
    lists = bin_tiles(Projected(*(v.cpu() for v in seen)), camera.width, camera.height, tile_size, engine="reference")
    facts["the same are seen"] = torch.equal(seen.index.cpu(), truth.index)
    facts["as many as meant"] = len(truth.index) == count if count < 2 else 30 < len(truth.index) < 120
    facts["offsets"] = torch.equal(tiles.offsets.cpu(), lists.offsets)
    facts["rows"] = torch.equal(tiles.rows.cpu()[: len(lists.rows)], lists.rows) and len(lists.rows) >= count // 3
    return facts


def compare(actual: dict[str, Tensor], expected: dict[str, Tensor]) -> dict[str, float | bool]:
    """The error of each result: the first two's as it is, the others' relative to the largest number."""
    facts: dict[str, float | bool] = {}
    for k, (name, truth) in enumerate(expected.items()):
        error, most = largest(actual[name].cpu().double() - truth), largest(truth)
        if k >= 2 and error > 0:
            error = error / most if most else float("inf")
        facts[name] = error
        facts[f"{name}: shape"] = list(actual[name].shape) == list(truth.shape)
    facts["float32"] = all(value.dtype == torch.float32 for value in actual.values())
    return facts


def find_faults(name: str, facts: dict[str, Any]) -> dict[str, Any]:
    """What is wrong with the facts of a case: errors beyond their limits, what is not so, and what is missing."""
    kind = name.split(",")[0]
    flat, sloped = {
        "frame": (("map", "alpha"), (*OF_FRAME, "means2d")),
        "projection": ((*PROJECTED, *OF_PROJECTION), ()),
    }.get(kind, (("maps", "alphas"), (*GRADS, "sums", "weights")))
    limits = dict.fromkeys(flat, 1e-5) | dict.fromkeys(sloped, 1e-4)
    wrong = {key: fact for key, fact in facts.items() if not (fact <= limits[key] if key in limits else fact is True)}
    return wrong | {key: None for key in limits if key not in facts}


def largest(value: Tensor) -> float:
    """The largest absolute value, 0 of nothing."""
    return float(value.detach().abs().max()) if value.numel() else 0.0


class Build(NamedTuple):
    """One of the kernels as the engine launches it, for a GPU by its compute capability."""

    kernel: str  # a key of triton_gpu.LAUNCHES
    channels: int
    capability: int  # 90: sm_90
    tile_size: int = 16
    indexed: bool = True


KERNELS = ("composite", "accumulate", "differentiate", "rank")
OTHERS = ("see", "project", "differentiate_projection", "count", "list")  # a Gaussian, or a candidate, for each thread
BUILDS = {
    **{f"{kernel}, 512 channels, sm_90": Build(kernel, 512, 90) for kernel in KERNELS},
    **{f"differentiate, 512 channels, sm_{cc}": Build("differentiate", 512, cc) for cc in (80, 100)},
    "differentiate, 130 channels, sm_90": Build("differentiate", 130, 90),
    **{f"{kernel}, 9 channels, sm_90": Build(kernel, 9, 90) for kernel in KERNELS},
    "composite, 1 channel, tiles of 5": Build("composite", 1, 80, tile_size=5, indexed=False),
    "differentiate, 1 channel, tiles of 5": Build("differentiate", 1, 80, tile_size=5, indexed=False),
    **{f"{kernel}, sm_90": Build(kernel, 0, 90) for kernel in OTHERS},
}
OF_SEE = "ends", "means2d", "conics", "depths", "out_opacities", "extents", "index"  # which the first call lacks


def compile_ahead(build: Build) -> dict[str, Any]:
    """Compile a kernel without the GPU it is for, and say what came out."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from kfgs.splat.engines.triton import (
        engine,
        kernels,
        kernels_backward,
        kernels_project,
        kernels_rank,
        kernels_tiles,
    )

    kernel = {
        "composite": kernels.composite_kernel,
        "accumulate": kernels.accumulate_kernel,
        "differentiate": kernels_backward.differentiate_kernel,
        "rank": kernels_rank.rank_kernel,
        "see": kernels_project.project_kernel,
        "project": kernels_project.project_kernel,
        "differentiate_projection": kernels_project.differentiate_projection_kernel,
        "count": kernels_tiles.count_kernel,
        "list": kernels_tiles.list_kernel,
    }[build.kernel]
    sizes = {"BLOCK": 128, "num_warps": 4, "num_stages": 1, "enable_fp_fusion": True}
    if build.kernel in engine.LAUNCHES:
        sizes = engine.launch_options(build.kernel, build.channels, build.tile_size)
    options = {name: sizes.pop(name) for name in ("num_warps", "num_stages", "enable_fp_fusion")}
    sizes |= {
        "differentiate": {"OF_SPLATS": True, "OF_FEATURES": True},
        "rank": {"TOP": 4},
        "see": dict.fromkeys(OF_SEE),
        "differentiate_projection": {"grad_depths": None},
        "count": {"SIDE": 8},
        "list": {"SIDE": 8},
    }.get(build.kernel, {})
    if build.channels == 1:  # as triton does with an argument that is 1
        sizes["channels"] = 1
    if not build.indexed and build.kernel != "accumulate":
        sizes["index"] = None
    types = {"index": "*i64", "rows": "*i32", "offsets": "*i64", "stops": "*i32", "labels": "*i64", "order": "*i64"}
    types |= {"hits": "*i64", "tiles": "*i16", "kept": "*i32", "ends": "*i64" if build.kernel == "list" else "*i32"}
    types |= dict.fromkeys(("width", "height", "columns", "channels", "top", "count", "total", "no_tile"), "i32")
    types |= dict.fromkeys(("near", "low_pass"), "fp32") | dict.fromkeys(sizes, "constexpr")
    signature = {name: types.get(name, "*fp32") for name in kernel.arg_names}
    aligned = {(k,): [["tt.divisibility", 16]] for k, of in enumerate(signature.values()) if of.startswith("*")}
    if build.channels and build.channels % 16 == 0:  # and with one that 16 divides
        aligned[(kernel.arg_names.index("channels"),)] = [["tt.divisibility", 16]]
    target = GPUTarget("cuda", build.capability, 32)
    compiled = triton.compile(ASTSource(kernel, signature, sizes, aligned), target=target, options=options)
    text = compiled.asm["ptx"]
    return {
        "cubin": len(compiled.asm["cubin"]),
        "products": [name for name in ("mma.sync", "wgmma.mma_async", "tcgen05.mma") if name in text],
        "shared": compiled.metadata.shared,
        "warps": options["num_warps"],
        **_read_resources(compiled.asm["cubin"], Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"),
    }


def _read_resources(cubin: bytes, tool: Path) -> dict[str, int]:
    """Registers and bytes of spills (the stack) of a thread, where triton brings the tool that reads them."""
    if not tool.exists():
        return {}
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        said = subprocess.run([tool, "-res-usage", file.name], capture_output=True, text=True, check=True)
    found = re.search(r"REG:(\d+) STACK:(\d+)", said.stdout + said.stderr)
    assert found
    return {"registers": int(found[1]), "stack": int(found[2])}


def main() -> None:
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", RuntimeWarning)  # the interpreter's, about NaN and infinity
    if sys.argv[1] == "run":
        device = sys.argv[2]
        runs = {name: (run_case, case, device) for name, case in CASES.items()} | {"frame": (run_frame, device)}
        runs |= {f"projection, {name}": (run_projection, *sizes, device) for name, sizes in PROJECTIONS.items()}
        first, step = map(int, sys.argv[3].split("/")) if len(sys.argv) > 3 else (0, 1)
        results = {name: _attempt(*runs[name]) for name in list(runs)[first::step]}
    else:
        results = {name: _attempt(compile_ahead, build) for name, build in BUILDS.items()}
    print(json.dumps(results))


def _attempt(function: Any, *arguments: Any) -> dict[str, Any]:
    """One case that fails does not take the others with it."""
    try:
        return function(*arguments)
    except Exception:
        return {"failed": traceback.format_exc()}


if __name__ == "__main__":
    main()
