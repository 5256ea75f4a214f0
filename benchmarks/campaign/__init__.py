"""A standing campaign against kfgs: mutated files, kills, pairs of processes, signals, full disks, long runs.

`python benchmarks/campaign OUT` runs it; docs/promises.md says what it checks, docs/results.md what it found.
"""
