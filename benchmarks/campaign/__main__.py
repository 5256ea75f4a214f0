"""`python benchmarks/campaign OUT [--minutes N] [--seed S]`; a second start continues."""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: processes are forked
os.environ.setdefault("NUMBA_NUM_THREADS", "1")
if __package__ in (None, ""):
    sys.path[0] = str(Path(__file__).resolve().parents[1])  # instead of this folder, whose names are common words

from campaign.files import run_files
from campaign.record import Record


def main(words: list[str] | None = None) -> int:
    """Run the campaign; the exit code is 1 if it has found anything, now or earlier in the same folder."""
    parser = argparse.ArgumentParser(prog="python benchmarks/campaign", description=__doc__)
    parser.add_argument("out", type=Path, help="folder of results.jsonl and of what broke; a second start continues")
    parser.add_argument("--minutes", type=float, default=10.0, help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, help="processes at once (default: 1)")
    parser.add_argument("--only", default="", help="files whose name holds this word")
    parser.add_argument("--most", type=int, help="most mutants of this start")
    parser.add_argument(
        "--scratch", type=Path, help="place for working files; default: /dev/shm if there is one, else OUT"
    )
    given = parser.parse_args(words)
    quick = Path("/dev/shm")
    scratch = given.scratch or (quick if quick.is_dir() else given.out) / f"kfgs-campaign-{os.getpid()}"
    record = Record(given.out, scratch)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the scratch folder is deleted
    try:
        run_files(
            record,
            workers=given.workers,
            seed=given.seed,
            seconds=60 * given.minutes,
            only=given.only,
            most=given.most,
        )
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    print(record.table())
    return 1 if record.findings() else 0


if __name__ == "__main__":
    sys.exit(main())
