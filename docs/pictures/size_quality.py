"""The figure of the README: quality against size of all methods of the leaderboard on room_0.

python docs/pictures/size_quality.py [OUT.png]
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).resolve().parent
RUNS = HERE.parent / "runs" / "room_0-cpu.json"
NAMES = {  # rows of the leaderboard, and where the name stands beside the point
    "kfgs": ("kfgs", (8, 4)),
    "feature3dgs-512": ("Feature 3DGS", (-8, 4)),
    "feature3dgs-128": ("Feature 3DGS, 128 channels", (6, -14)),
    "occam": ("Occam's LGS", (-8, -2)),
    "legaussians": ("LEGaussians", (8, -4)),
    "cf3": ("CF3", (8, -3)),
    "langsplatv2": ("LangSplatV2", (8, -3)),
    "langsplat": ("LangSplat", (-8, -3)),
    "adc+sc": ("DF-3DGS, run by kfgs", (8, -8)),
}


def main(out: Path) -> None:
    """Draw the figure."""
    runs = json.loads(RUNS.read_text(encoding="utf-8"))
    figure, axes = plt.subplots(figsize=(6.4, 3.3), dpi=150)
    for row in runs["rows"]:
        if row["row"] not in NAMES:
            continue
        name, place = NAMES[row["row"]]
        own = row["row"] == "kfgs"
        size, miou = row["storage"] / 2**20, 100 * row["miou"]
        axes.scatter(size, miou, s=70 if own else 36, color="#d55e00" if own else "#5b6b7b", zorder=3)
        axes.annotate(
            name,
            (size, miou),
            place,
            textcoords="offset points",
            ha="left" if place[0] > 0 else "right",
            fontsize=9,
            fontweight="bold" if own else "normal",
        )
    teacher = 100 * runs["teacher"]["miou"]
    axes.axhline(teacher, color="#5b6b7b", linestyle="--", linewidth=1)
    axes.annotate("the 2-D network itself", (700, teacher), (0, 4), textcoords="offset points", ha="right", fontsize=8)
    axes.set(
        xscale="log",
        xlim=(1, 900),
        ylim=(66, 89),
        xlabel="size of the semantic field, MiB",
        ylabel="mIoU of unseen views, %",
    )
    axes.set_xticks([1, 10, 100], ["1", "10", "100"])
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    figure.tight_layout()
    figure.savefig(out, pil_kwargs={"optimize": True})


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "size_quality.png")
