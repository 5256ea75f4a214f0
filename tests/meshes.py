"""Tiny PLY meshes with an object per face, written byte by byte as Replica has them."""

import struct
from pathlib import Path

import numpy as np

XYZ = np.arange(18, dtype=np.float32).reshape(6, 3)
QUADS = [([0, 1, 2, 3], 4), ([0, 1, 4, 3], 9), ([1, 2, 4], 9), ([2, 3, 4, 1], 4)]


def write_mesh(path: Path, faces: list[tuple[list[int], int]], *, extra: bool = True) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    order = ["property list uchar int vertex_indices", "property int object_id"]
    header = [
        "ply", "format binary_little_endian 1.0", "element vertex 6", "property float x", "property float y",
        "property float z", f"element face {len(faces)}", *(order if extra else order[:1]),
        "end_header\n",
    ]  # fmt: skip
    body = XYZ.tobytes()
    for corners, number in faces:
        listed = struct.pack(f"<B{len(corners)}i", len(corners), *corners)
        own = struct.pack("<i", number) if extra else b""
        body += listed + own
    path.write_bytes("\n".join(header).encode() + body)
