"""Tables and curves of the engines' benchmark, from its numbers alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

COLORS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")  # Okabe and Ito
MARKERS = "osD^vP"
FORWARD, BACKWARD = (28, 2), (45, 4)  # operations per composited pair: fixed, and per channel

Report = dict[str, Any]
Entry = dict[str, Any]


# tables ---------------------------------------------------------------------------------------------------------------


def write_tables(report: Report) -> str:
    """The whole report as markdown."""
    machine = report["machine"]
    gpu = "" if machine.get("gpu") is None else f"{machine['gpu']}; "
    lines = [
        "# Engines side by side",
        "",
        f"{gpu}{machine['processor']}, {machine['cores']} cores, {', '.join(machine['flags'])}; {machine['system']}; Python "
        f"{machine['python']}, torch {machine['torch']}, numba {machine['numba']}. Wall-clock milliseconds, median and "
        f"(least) of {report['repeats']} rounds in turn (at most 3 of what takes longer than a second).",
    ]
    if report["quick"]:
        lines += ["", "**A quick run: it shows that everything works, and says little about speed.**"]
    for threads, peak in report["peak"].items():
        lines.append(
            f"\nPeak with {_where(report, int(threads))}: {peak['flops'] / 1e9:.0f} GFLOP/s (float32 matrix product), "
            f"{peak['bandwidth'] / 1e9:.1f} GB/s (copy, read and written)."
        )
    lines += [f"\nNot measured: {line}." for line in report.get("missing", [])]
    off = [value for entry in report["cases"] for value in entry["difference"].values()]
    if off:
        lines.append(
            f"\nNo engine's map is further than {max(off):.1g} from the first one's, features being normal: that is a pixel "
            "where an alpha lies on 1/255 or T on 1e-4, and rounding decides."
        )
    off = [value for entry in report["cases"] for value in entry.get("frame_difference", {}).values()]
    if off:
        lines.append(
            f"\ngsplat's maps differ from kfgs's by at most {max(off):.1g}, as a mean over pixels and channels, features being "
            "normal: its thresholds are its own."
        )
    lines += _steps(report)
    for threads in report["peak"]:
        for name, cases in report["slices"].items():
            lines += _slice(report, name, cases, int(threads))
    for part in WHOLE:
        lines += _whole(report, part)
    lines += _throughput(report) + _ratios(report) + _growth(report) + _memory(report)
    return "\n".join(lines) + "\n"


def _table(head: list[str], rows: list[list[str]]) -> list[str]:
    lines = [head, ["---"] * len(head), *rows]
    return ["", *("| " + " | ".join(line) + " |" for line in lines)] if rows else ["", "(not measured yet)"]


def _threads(count: int) -> str:
    return "1 thread" if count == 1 else f"{count} threads"


def _where(report: Report, threads: int) -> str:
    """The GPU if one was used, else the threads."""
    return report["machine"].get("gpu") or _threads(threads)


def _case(case: list[int]) -> str:
    count, channels, width, height = case
    return f"{count / 1000:g}k, {width}x{height}, {channels}"


def _ms(times: dict[str, float] | None) -> str:
    if times is None:
        return "-"
    digits = 2 if times["median"] < 1e-3 else 1 if times["median"] < 1 else 0
    return f"{1e3 * times['median']:.{digits}f} ({1e3 * times['least']:.{digits}f})"


def _engines(report: Report) -> list[str]:
    entries = report["cases"] + report["memory"]
    return list(dict.fromkeys(e for entry in entries for e in [*entry.get("seconds", {}), *entry.get("left_out", {})]))


def _compositors(report: Report) -> list[str]:
    """The engines that composite given lists of tiles."""
    return [engine for engine in _engines(report) if not engine.startswith("gsplat")]


def _find(report: Report, case: list[int], threads: int) -> Entry | None:
    found = [e for e in report["cases"] if e["case"] == case and e["threads"] == threads]
    return found[0] if found else None


def _times(entry: Entry, engine: str, name: str) -> dict[str, float] | None:
    return entry["seconds"].get(engine, {}).get(name)


def _steps(report: Report) -> list[str]:
    lines = ["", "## A whole training step", "", "Projection, binning, compositing, L1 loss, backward, fused Adam."]
    rows, stages = [], []
    for entry in report["steps"]:
        for engine, times in entry["step"].items():
            rows.append([_case(entry["case"]), str(entry["threads"]), engine, _ms(times)])
        for engine, parts in entry["stages"].items():
            total = {key: sum(times[key] for times in parts.values()) for key in ("median", "least")}
            stages.append([str(entry["threads"]), engine, *(_ms(times) for times in parts.values()), _ms(total)])
    lines += _table(["N, size, channels", "threads", "engine", "ms"], rows)
    names = next((list(parts) for entry in report["steps"] for parts in entry["stages"].values()), [])
    return [*lines, "", "Its stages, each called alone:", *_table(["threads", "engine", *names, "sum"], stages)]


def _slice(report: Report, name: str, cases: list[list[int]], threads: int) -> list[str]:
    engines = _compositors(report)
    lines = ["", f"## Compositing against {name}, {_where(report, threads)}", "", "Forward / backward."]
    rows = []
    for case in cases:
        entry = _find(report, case, threads)
        if entry is None:
            continue
        cells = []
        for engine in engines:
            both = [_ms(_times(entry, engine, part)) for part in ("forward", "backward")]
            cells.append(entry["left_out"].get(engine, " / ".join(both)))
        pairs = entry["pairs"]
        rows.append([_case(case), f"{pairs['listed'] / 1e3:.0f}k", f"{pairs['composited'] / 1e6:.1f}M", *cells])
    return lines + _table(["N, size, channels", "tile pairs", "pixel pairs", *engines], rows)


WHOLE = {
    "frame": ("A whole frame", "Project, bin and composite, without gradients."),
    "step": ("Forward and backward of a whole frame", "The same, and the gradients of all tensors; no loss, no Adam."),
    "labels": ("A label map", "The best of so many classes at each pixel, from scores of the Gaussians."),
    "uplift": (
        "Uplift of a map",
        "Its pixels summed into the Gaussians by rendering weight, without projection and binning.",
    ),
}


def _whole(report: Report, part: str) -> list[str]:
    engines = [e for e in _engines(report) if any(_times(entry, e, part) for entry in report["cases"])]
    peers = [engine for engine in engines if engine.startswith("gsplat")]
    rows = []
    for entry in report["cases"]:
        times = {engine: _times(entry, engine, part) for engine in engines}
        cells = [_ms(found) for found in times.values()]
        if peers:
            quickest = min((times[peer]["median"] for peer in peers if times[peer]), default=0)
            own = times[engines[0]]
            cells.append(f"{quickest / own['median']:.2f}" if own and quickest else "-")
        rows.append([_case(entry["case"]), str(entry["threads"]), *cells])
    title, about = WHOLE[part]
    ratio = [f"quicker gsplat's time / {engines[0]}'s"] if peers else []
    return ["", f"## {title}", "", about, *_table(["N, size, channels", "threads", *engines, *ratio], rows)]


def _throughput(report: Report) -> list[str]:
    engines = [engine for engine in _engines(report) if engine in ("kfgs numba", "kfgs triton")]
    rows = []
    for entry in report["cases"]:
        channels, peak = entry["case"][1], report["peak"][str(entry["threads"])]["flops"]
        cells = []
        for engine in engines:
            for part, (fixed, per_channel) in (("forward", FORWARD), ("backward", BACKWARD)):
                times = _times(entry, engine, part)
                rate = entry["pairs"]["composited"] / times["median"] if times else 0
                cells.append(
                    f"{rate / 1e6:.0f} ({rate * (fixed + per_channel * channels) / peak:.0%})" if times else "-"
                )
        rows.append([_case(entry["case"]), str(entry["threads"]), *cells])
    head = [f"{engine} {part}" for engine in engines for part in ("forward", "backward")]
    lines = ["", "## Pairs per second and share of the peak", ""]
    lines += [
        "Millions of composited (pixel, Gaussian) pairs per second; in brackets the share of the matrix product's "
        f"rate, counting {FORWARD[0]} + {FORWARD[1]} D operations a pair forward and {BACKWARD[0]} + {BACKWARD[1]} D "
        "backward."
    ]
    return lines + _table(["N, size, channels", "threads", *head], rows)


def _ratios(report: Report) -> list[str]:
    engines = _compositors(report)
    if len(engines) < 2:
        return []
    rows = []
    for entry in report["cases"]:
        own = _both(entry, engines[0])
        cells = [f"{_both(entry, e) / own:.2f}" if _both(entry, e) and own else "-" for e in engines[1:]]
        rows.append([_case(entry["case"]), str(entry["threads"]), *cells])
    lines = ["", f"## Times as long as {engines[0]}", "", "Forward + backward of compositing."]
    return lines + _table(["N, size, channels", "threads", *engines[1:]], rows)


def _both(entry: Entry, engine: str) -> float:
    parts = [_times(entry, engine, part) for part in ("forward", "backward")]
    return sum(times["median"] for times in parts if times) if all(parts) else 0.0


def _growth(report: Report) -> list[str]:
    rows = []
    for threads in map(int, report["peak"]):
        for engine in _engines(report):
            slopes = [_slope(report, axis, engine, part, threads) for axis in ("Gaussians", "pixels") for part in PARTS]
            rows.append([str(threads), engine, *slopes, _wide_ratio(report, engine, threads)])
    head = [f"{part} in {axis}" for axis in ("N", "pixels") for part in PARTS]
    lines = [
        "",
        "## Growth",
        "",
        "Slope of log time against log N and log pixels (1: in proportion), and time of the frame "
        "with most channels over the one with 9 (compositing where there is no frame).",
    ]
    return lines + _table(["threads", "engine", *head, "frames"], rows)


PARTS = ("forward", "backward", "frame")


def _series(report: Report, axis: str, engine: str, part: str, threads: int) -> tuple[np.ndarray, np.ndarray]:
    """The sizes along a slice, and the median seconds, where they were measured."""
    points = []
    for case in report["slices"].get(axis, []):
        entry = _find(report, case, threads)
        times = _times(entry, engine, part) if entry else None
        if times:
            size = case[1] if "channels" in axis else case[0] if axis == "Gaussians" else case[2] * case[3]
            points.append((size, times["median"]))
    return np.array(points).reshape(-1, 2).T


def _slope(report: Report, axis: str, engine: str, part: str, threads: int) -> str:
    sizes, seconds = _series(report, axis, engine, part, threads)
    return f"{np.polyfit(np.log(sizes), np.log(seconds), 1)[0]:.2f}" if len(sizes) > 1 else "-"


def _wide_ratio(report: Report, engine: str, threads: int) -> str:
    found = []
    for axis in report["slices"]:
        for part in ("frame", "forward") if "channels" in axis else ():
            channels, seconds = _series(report, axis, engine, part, threads)
            if 9 in channels and channels.max() > 9:
                ratio = seconds[channels.argmax()] / seconds[list(channels).index(9)]
                found.append(f"{ratio:.1f} ({channels.max():.0f} channels, {axis.split(', ')[1]}, {part})")
                break
    return ", ".join(found) or "-"


def _memory(report: Report) -> list[str]:
    engines = list(dict.fromkeys(entry["engine"] for entry in report["memory"]))
    cases = list(dict.fromkeys(tuple(entry["case"]) for entry in report["memory"]))
    mebibytes = {(e["engine"], tuple(e["case"])): f"{e['bytes'] / 2**20:.0f}" for e in report["memory"]}
    rows = [[_case(list(case)), *(mebibytes.get((engine, case), "-") for engine in engines)] for case in cases]
    what = "one forward and one backward pass" if report["machine"].get("gpu") is None else "one step, on the GPU"
    lines = ["", "## Peak memory", "", f"MiB above the input, of {what}, in a fresh process."]
    return lines + _table(["N, size, channels", *engines], rows)


# curves ---------------------------------------------------------------------------------------------------------------


def write_curves(report: Report, out: Path) -> None:
    """One picture for each axis, with most threads: forward and backward of compositing, or on a GPU frame and step."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    threads, gpu = max(map(int, report["peak"])), report["machine"].get("gpu") is not None
    parts, what = (("frame", "step"), "A view") if gpu else (("forward", "backward"), "Compositing")
    for axis, cases in report["slices"].items():
        figure, panels = plt.subplots(1, 2, figsize=(10, 4.2), sharey=True, layout="constrained")
        for part, panel in zip(parts, panels, strict=True):
            for number, engine in enumerate(_engines(report)):
                sizes, seconds = _series(report, axis, engine, part, threads)
                style = {"color": COLORS[number % len(COLORS)], "marker": MARKERS[number % len(MARKERS)]}
                panel.plot(sizes, 1e3 * seconds, label=engine, **style)
            _decorate(panel, axis, cases, part)
        panels[0].set_ylabel("median time (ms)")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
        figure.suptitle(f"{what}, {_fixed(axis, cases[0])}, {_where(report, threads)}")
        figure.savefig(out / f"engines_{axis.split(',')[0].lower()}{_suffix(axis)}.png", dpi=120)
        plt.close(figure)


def _decorate(panel: Any, axis: str, cases: list[list[int]], part: str) -> None:
    label = {"Gaussians": "Gaussians N", "pixels": "image size (pixels)"}.get(axis, "channels")
    ticks = [
        case[1] if label == "channels" else case[0] if axis == "Gaussians" else case[2] * case[3] for case in cases
    ]
    names = [f"{c[2]}x{c[3]}" if axis == "pixels" else f"{t:,}" for c, t in zip(cases, ticks, strict=True)]
    panel.set(xscale="log", yscale="log", xlabel=label, title=part)
    panel.set_xticks(ticks, names)
    panel.minorticks_off()
    panel.grid(alpha=0.3)


def _fixed(axis: str, case: list[int]) -> str:
    count, channels, width, height = case
    size = f"{width}x{height} pixels"
    if axis == "Gaussians":
        return f"{size}, {channels} channels"
    return f"N = {count:,}, " + (f"{channels} channels" if axis == "pixels" else size)


def _suffix(axis: str) -> str:
    return "_" + axis.split("=")[1].replace(",", "") if "=" in axis else ""
