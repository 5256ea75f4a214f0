"""Add new images to a scene whose cameras are known: their poses are estimated, the old ones do not move."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from tqdm import tqdm

from .._files import as_path, atomic_folder, check_output, file_stem, real_path
from .colmap import load_colmap
from .colmap_model import ADVISED, ColmapModel, read_whole_model
from .files import MASKS, SceneError, find_pictures, list_images, some
from .load import find_images
from .masks import folder_masks
from .pictures import refuse_heic
from .posed import picture_size
from .pycolmap_import import quiet_pycolmap, scene_errors
from .sfm import SfmConfig, SfmReport, SfmRun, fill_database, timed
from .sub_models import find_model

KEPT = ("classes.json", "text.npy", "text.safetensors")  # files of the scene that are the same for more images


def extend_sfm(
    images: str | Path,
    scene: str | Path,
    out: str | Path,
    *,
    config: SfmConfig | None = None,
    progress: bool = False,
) -> SfmReport:
    """Register new images in a scene with a COLMAP model, and write a larger scene. The old scene is not written to.

    Old images keep their poses and cameras, bit for bit. Their features are found again, and the points are triangulated
    from the known poses; then each new image is placed, and what it sees becomes points, too.

    Args:
        images: folder of the new images; their names differ from those of the scene.
        scene: scene folder with a COLMAP model, made by any program, and its pictures.
        out: the larger scene: `sparse/0`, and `images` and `masks` with links to the files. Classes and text table are linked.
        config: options. `min_registered` counts new images. `camera_model` is of new cameras: with `single_camera`, images
            as large as those of a scene of one camera are taken to be by that camera; others share a new one for each size.
        progress: show a bar.

    Returns:
        Counts of all images, the error and times. `missing` are new images without a pose.

    Raises:
        FileNotFoundError: if a folder, or a picture of the scene, is missing.
        FileExistsError: if `out` holds a scene.
        SceneError: if the scene has no COLMAP model, names repeat, or too few new images can be placed.
        ImportError: if pycolmap is not installed.
    """
    images, scene, out, config = as_path(images), as_path(scene), as_path(out), config or SfmConfig()
    for folder in (images, scene):
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: no such folder; expected images and a scene")
    refuse_heic(images)
    model, pictures = _old_model(scene)
    check_output("out", out, "a folder")
    if out.exists() and any(out.iterdir()):
        raise FileExistsError(f"out: expected a new folder, got {out}, which holds something; name another")
    old, new = read_whole_model(model), list_images(images)
    files = _check_names(old, pictures, new, images)
    with (
        tempfile.TemporaryDirectory(prefix="kfgs-sfm-") as scratch,
        quiet_pycolmap() as pycolmap,
        scene_errors(
            f"{images}: expected images that pycolmap can register", "check the images and the free disk space"
        ),
        tqdm(disable=not progress, unit="image") as bar,
        atomic_folder(out) as larger,
    ):
        names = sorted(image.name for image in old.images.values())
        files |= {name: images / name for name in new}
        masks = folder_masks(names, pictures, scene)[0] or [None] * len(names)
        masks += folder_masks(new, images)[0] or [None] * len(new)
        photos = {name: (files[name], mask) for name, mask in zip([*names, *new], masks, strict=True)}
        _link(larger / "images", files)
        _link(larger / MASKS, {f"{name}{mask.suffix}": mask for name, (_, mask) in photos.items() if mask is not None})
        for name in KEPT:
            if (scene / name).is_file():
                (larger / name).symlink_to(real_path(scene / name))
        run = SfmRun(pycolmap, larger / "images", [*names, *new], Path(scratch), config, bar, photos)
        known = pycolmap.Reconstruction(str(model))
        fill_database(pycolmap, run.database, known)
        shared = {(lens.width, lens.height): number for number, lens in old.cameras.items()}
        shared = shared if config.single_camera and len(old.cameras) == 1 else {}
        seconds = {"features": timed(lambda: run.extract(names, None, False))}
        seconds["features"] += timed(lambda: run.extract(new, shared))
        seconds["matching"] = timed(run.match)
        found: list[Any] = []
        seconds["mapping"] = timed(lambda: found.append(_place(run, known, Path(scratch), len(new))))
        placed = {image.name for image in found[0].images.values() if image.has_pose}
        missing = tuple(name for name in new if name not in placed)
        needed = config.min_registered * len(new)
        if len(new) - len(missing) < needed:
            raise SceneError(
                f"{images}: expected at least {needed:.0f} of {len(new)} new images registered (min_registered = "
                f"{config.min_registered:g}), got {len(new) - len(missing)}; take photos that overlap with the scene's, "
                "or lower min_registered"
            )
        (larger / "sparse" / "0").mkdir(parents=True)
        found[0].write(str(larger / "sparse" / "0"))
        return SfmReport(
            registered=len(placed),
            total=len(names) + len(new),
            points=len(found[0].points3D),
            mean_reprojection_error=float(found[0].compute_mean_reprojection_error()),
            seconds=seconds,
            missing=missing,
            model_sizes=(len(placed),),
        )


def _old_model(scene: Path) -> tuple[Path, Path]:
    """The folders of the scene's model and of its pictures; the model is read once, and refused if it is damaged."""
    model = find_model(scene)
    if model is None:
        raise SceneError(
            f"{scene}: expected a scene with a COLMAP model (sparse/0), got none; estimate one with `kfgs sfm`"
        )
    pictures = find_images(scene, model)
    load_colmap(model, pictures)
    return model, pictures


def _check_names(old: ColmapModel, pictures: Path, new: list[str], images: Path) -> dict[str, Path]:
    """The pictures of the old images by their names."""
    if not new:
        raise SceneError(f"{images}: expected new images (PNG, JPEG, TIFF, WebP), got none; name another folder")
    names = [image.name for image in old.images.values()]
    files = find_pictures(pictures, names)
    lost = [name for name in names if name not in files]
    if lost:
        raise FileNotFoundError(
            f"{pictures}: expected all images of the model, {some(lost)} are missing; put them there"
        )
    sizes = (
        (image.name, picture_size(files[image.name]), old.cameras[image.camera_id]) for image in old.images.values()
    )
    wrong = [f"{name} ({size[0]}x{size[1]})" for name, size, lens in sizes if size != (lens.width, lens.height)]
    if wrong:
        raise SceneError(
            f"{pictures}: expected pictures as large as the model says, got {some(wrong)}; give the originals"
        )
    taken = {file_stem(name) for name in names}
    twice = [name for name in new if file_stem(name) in taken]
    if twice:
        raise SceneError(f"{images}: expected names that the scene does not have, got {some(twice)} again; rename them")
    if any(image.pose is None for image in old.images.values()):
        raise SceneError(f"scene: expected a model whose images all have poses, got some without; {ADVISED}")
    return files


def _link(folder: Path, files: dict[str, Path]) -> None:
    """Link files into one folder, under names of their own."""
    for name, file in files.items():
        place = folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(real_path(file))


def _place(run: SfmRun, known: Any, scratch: Path, count: int) -> Any:
    """Triangulate from the known poses, then place the new images; the old poses and cameras are constant."""
    colmap, options = run.pycolmap, run.options()
    run.begin("mapping", count, "image")
    poses = {number: frame.rig_from_world for number, frame in known.frames.items()}
    lenses = {number: camera.params.copy() for number, camera in known.cameras.items()}
    for name in ("triangulated", "models"):
        (scratch / name).mkdir()
    folder = str(scratch / "triangulated")
    colmap.triangulate_points(known, run.database, str(run.images), folder, True, options)
    options.fix_existing_frames, options.multiple_models = True, False
    options.constant_cameras = set(lenses)
    models = colmap.incremental_mapping(
        run.database, str(run.images), str(scratch / "models"), options=options, input_path=folder,
        next_image_callback=lambda: run.bar.update(1),
    )  # fmt: skip
    found = max(models.values(), key=lambda model: model.num_reg_images()) if models else colmap.Reconstruction(folder)
    for number, pose in poses.items():  # the mapper normalises constant rotations again: the last bit would differ
        found.frames[number].rig_from_world = pose
    for number, params in lenses.items():
        found.cameras[number].params = params
    return found
