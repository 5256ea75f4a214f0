"""The figure of the README: methods against a teacher that has not seen the rooms, from the tables of docs/results.md.

python docs/pictures/unseen.py [OUT.png]
"""

from __future__ import annotations

import sys
from pathlib import Path
from statistics import mean

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).resolve().parent
TABLES = {  # the line above a table, and its panel's title
    "Table 1 with the ADE20K network": "an ADE20K network",
    "Table 1 with the head of the other rooms": "DINOv2, head of other rooms",
}
NAMES = {
    "kfgs default": "kfgs",
    "decouple + ADC + SC": "DF-3DGS, run by kfgs",
    "decouple + ADC": "DF-3DGS without SC",
    "just decouple": "DF-3DGS, decouple only",
}


def rows_below(text: str, caption: str) -> dict[str, list[float | None]]:
    """The scores of each row of a table in the rooms, without the last column, the mean."""
    lines = text[text.index(f"**{caption}") :].splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("| row"))
    table = {}
    for line in lines[first + 2 :]:
        if not line.startswith("|"):
            break
        name, *cells = (cell.strip().strip("*") for cell in line.strip("|").split("|"))
        table[name] = [None if cell == "-" else float(cell) for cell in cells[:-1]]
    return table


def main(out: Path) -> None:
    """Draw the figure."""
    text = (HERE.parent / "results.md").read_text(encoding="utf-8")
    figure, panels = plt.subplots(1, len(TABLES), figsize=(9.2, 3.4), dpi=150, sharex=True)
    most = 0  # rows of a panel
    for axes, (caption, title) in zip(panels, TABLES.items(), strict=True):
        table = rows_below(text, caption)
        teacher = next(values for name, values in table.items() if name.startswith("the teacher"))
        gains = {
            NAMES.get(name, name.removesuffix(" (one level)")): [a - b for a, b in zip(values, teacher, strict=True)]  # type: ignore[operator]
            for name, values in table.items()
            if not name.startswith("the teacher") and None not in values
        }
        order = sorted(gains, key=lambda name: mean(gains[name]))
        for y, name in enumerate(order):
            color = "#d55e00" if name == "kfgs" else "#5b6b7b"
            axes.scatter(gains[name], [y] * len(gains[name]), s=12, color=color, alpha=0.5, linewidths=0)
            axes.scatter(mean(gains[name]), y, s=60, color=color, zorder=3)
        most = max(most, len(order))
        axes.set_ylim(len(order) - 0.5 - most, len(order) - 0.5)
        axes.axvline(0, color="#5b6b7b", linestyle="--", linewidth=1)
        axes.set_yticks(range(len(order)), order, fontsize=9)
        for label in axes.get_yticklabels():
            label.set_fontweight("bold" if label.get_text() == "kfgs" else "normal")
        axes.set_title(f"{title} (alone: {mean(teacher):.1f})", fontsize=10)  # type: ignore[type-var, arg-type]
        axes.set_xlabel("points of mIoU above the network alone", fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, axis="x")
    figure.tight_layout()
    figure.savefig(out, pil_kwargs={"optimize": True})


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "unseen.png")
