"""Many scenes on many machines: every scene through all stages, on Dask or any other executor."""

from .batch import SceneResult, map_scenes, run_batch
from .clients import open_client
from .options import BatchOptions
from .scene_list import SceneEntry, read_scenes

__all__ = [
    "BatchOptions",
    "SceneEntry",
    "SceneResult",
    "map_scenes",
    "open_client",
    "read_scenes",
    "run_batch",
]
