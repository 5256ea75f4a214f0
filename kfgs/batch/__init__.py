"""Many scenes, or one scene in blocks, as a graph of Dask."""

from .blocks import fit_blocks, join_blocks
from .clients import open_client
from .run import run_batch
from .scene_list import read_scenes
from .scene_task import BatchOptions

__all__ = ["BatchOptions", "fit_blocks", "join_blocks", "open_client", "read_scenes", "run_batch"]
