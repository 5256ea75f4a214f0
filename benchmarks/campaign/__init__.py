"""Mutated files against the readers of kfgs: `python benchmarks/campaign OUT` runs it, docs/results.md says what it found.

Kills and crowds of processes are in tests/test_files.py.
"""
