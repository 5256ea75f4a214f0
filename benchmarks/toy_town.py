"""Write a toy town: toy rooms side by side in one frame, with exact truth, as one scene."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from kfgs._check import check_whole
from kfgs._files import as_path, atomic_folder, check_output, read_json, write_json
from kfgs.scenes.colmap import quiet_pycolmap
from kfgs.toy.geometry import Array
from kfgs.toy.room_folder import ToyConfig, make_toy_room

STEP = 8.0, 7.0  # metres from one room to the next: rooms are 6 x 5
FOLDERS = ("images", "labels", "features")


def make_toy_town(
    path: str | Path, rooms: tuple[int, int] = (3, 3), config: ToyConfig | None = None, *, progress: bool = False
) -> Path:
    """Write rooms of different seeds on a grid, with one COLMAP model, as a scene folder.

    The rooms have the same classes and embeddings, but other textures, hues and places of the chairs. Names of room i
    begin with "r<i>_". `surface.npz` has `points`, `normals`, `labels` and `seen` of all rooms.

    Args:
        path: the folder to make. It appears complete or not at all.
        rooms: along x and y.
        config: of each room; `seed` is that of the first, the others have the following ones.
        progress: show a bar over the rooms.

    Raises:
        FileExistsError: if `path` holds anything.
    """
    path, config = check_output("path", as_path(path), "a folder"), config or ToyConfig()
    for i, count in enumerate(rooms):
        check_whole(f"rooms[{i}]", count, 1)
    if path.exists() and any(path.iterdir()):
        raise FileExistsError(f"{path}: expected no folder or an empty one, got files; choose another")
    split: dict[str, list[str]] = {"train": [], "test": []}
    surfaces: list[dict[str, Array]] = []
    with atomic_folder(path) as town, tempfile.TemporaryDirectory() as scratch, quiet_pycolmap() as pycolmap:
        model = pycolmap.Reconstruction()
        for name in FOLDERS:
            (town / name).mkdir()
        for number in tqdm(range(rooms[0] * rooms[1]), desc="toy town", disable=not progress):
            offset = np.array([number % rooms[0] * STEP[0], number // rooms[0] * STEP[1], 0.0])
            folder, prefix = Path(scratch) / "room", f"r{number:03d}_"
            make_toy_room(folder, replace(config, seed=config.seed + number), embeddings_of=config.seed)
            for kind in FOLDERS:
                for file in sorted((folder / kind).iterdir()):
                    shutil.move(file, town / kind / (prefix + file.name))
            for name, stems in read_json(folder / "split.json").items():
                split[name] += [prefix + stem for stem in stems]
            surface = dict(np.load(folder / "surface.npz"))
            surfaces.append(surface | {"points": (surface["points"] + offset).astype(np.float32)})
            _add_room(model, pycolmap, folder / "sparse" / "0", prefix, offset)
            for name in ("classes.json", "text.npy"):
                shutil.copy(folder / name, town / name)
            shutil.rmtree(folder)
        (town / "sparse" / "0").mkdir(parents=True)
        model.write(str(town / "sparse" / "0"))
        write_json(town / "split.json", split)
        joined: dict[str, Any] = {name: np.concatenate([one[name] for one in surfaces]) for name in surfaces[0]}
        np.savez(town / "surface.npz", **joined)
    return path


def _add_room(model: Any, pycolmap: Any, folder: Path, prefix: str, offset: Array) -> None:
    """Add a model, moved by an offset, with names that begin with a prefix."""
    room = pycolmap.Reconstruction(str(folder))
    room.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), offset))
    first = max([0, *model.images])
    if not first:
        camera = next(iter(room.cameras.values()))
        model.add_camera_with_trivial_rig(camera)
    for number, image in sorted(room.images.items()):
        new = pycolmap.Image(name=prefix + image.name, camera_id=1, image_id=first + number)
        new.points2D = pycolmap.Point2DList([pycolmap.Point2D(point.xy) for point in image.points2D])
        model.add_image_with_trivial_frame(new, image.cam_from_world())
    for point in room.points3D.values():
        track = pycolmap.Track()
        for element in point.track.elements:
            track.add_element(first + element.image_id, element.point2D_idx)
        model.points3D[model.add_point3D(point.xyz, track, point.color)].error = point.error
