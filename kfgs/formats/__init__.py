"""Read and write the splat files of other programs, with labels: 3DGS PLY, compressed PLY, .splat, SPZ, SOG, .ksplat, glTF."""

from .table import Written, find_format, read_splats, write_splats

__all__ = ["Written", "find_format", "read_splats", "write_splats"]
