"""The CPU engine: projection, binning and compositing compiled by numba. README.md beside this file explains it."""
