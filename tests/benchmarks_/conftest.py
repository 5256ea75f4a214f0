"""The baselines lie beside the benchmarks and are no part of the package."""

import sys
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
if not (BENCHMARKS / "baselines").is_dir():  # a source distribution comes without them
    collect_ignore_glob = ["test_*.py"]
elif str(BENCHMARKS) not in sys.path:
    sys.path.append(str(BENCHMARKS))
