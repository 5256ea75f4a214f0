"""Gaussian splatting: project, bin, composite."""
