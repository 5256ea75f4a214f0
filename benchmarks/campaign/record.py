"""What a campaign found: lines of JSON that a second start goes on from, mutants that broke something, and the table."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any


class Record:
    """The results in a folder, one line of JSON each.

    Args:
        folder: of `results.jsonl` and `findings/`.
        scratch: a quick place for files that come and go, for instance below /dev/shm.
    """

    def __init__(self, folder: Path, scratch: Path) -> None:
        self.folder, self.scratch = folder, scratch
        folder.mkdir(parents=True, exist_ok=True)
        scratch.mkdir(parents=True, exist_ok=True)
        self.path = folder / "results.jsonl"

    def add(self, line: dict[str, Any]) -> None:
        """Append a result; it is on the disk when this returns to the system."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def lines(self) -> Iterator[dict[str, Any]]:
        """All results. A last line that a kill cut short is left out."""
        if self.path.is_file():
            for line in self.path.read_text(encoding="utf-8").splitlines():
                try:
                    yield json.loads(line)
                except ValueError:
                    continue

    def of(self, kind: str) -> list[dict[str, Any]]:
        """The results of one kind."""
        return [line for line in self.lines() if line["kind"] == kind]

    def findings(self) -> list[dict[str, Any]]:
        """All results that say what broke."""
        return [line for line in self.lines() if line["kind"].endswith("finding")]

    def table(self) -> str:
        """A summary for people."""
        lines, found = list(self.lines()), self.findings()
        rows = ["| kind | tried | fine | findings |", "|---|---:|---:|---:|"]
        batches = [line for line in lines if line["kind"] == "files"]
        if batches:
            total = sum(line["mutants"] for line in batches)
            bad = [line for line in found if line["kind"] == "files finding"]
            rows.append(f"| mutated files ({len({b['case'] for b in batches})} files, {len({b['reader'] for b in batches})} "
                        f"readers) | {total:,} | {total - len(bad):,} | {len(bad):,} |")  # fmt: skip
        seeds = sorted({line["seed"] for line in lines if "seed" in line})
        rows += ["", f"seeds: {', '.join(map(str, seeds)) or 'none'}"]
        groups = Counter((line["kind"], line.get("case", ""), line["what"], line["why"][:160]) for line in found)
        rows += [f"{count} x {' | '.join(group)}" for group, count in groups.most_common(40)]
        return "\n".join(rows)
