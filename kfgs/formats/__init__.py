"""Splat files of other programs: 3DGS PLY, compressed PLY, .splat, SPZ, SOG, .ksplat, glTF; read, written, labels kept."""

from .order import morton_order
from .splat_file import Precision, SplatFile
from .spz import write_spz
from .table import Written, find_format, formats, read_splats, write_splats

__all__ = [
    "Precision",
    "SplatFile",
    "Written",
    "find_format",
    "formats",
    "morton_order",
    "read_splats",
    "write_splats",
    "write_spz",
]
