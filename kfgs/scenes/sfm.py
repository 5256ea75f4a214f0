"""Estimate cameras for a folder of images: structure from motion with pycolmap, on the CPU."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tqdm import tqdm

from .._check import check_choice, check_range
from .._files import as_path, atomic_folder, check_output, real_path
from ..formats.folders import newest_splat
from .colmap import SUPPORTED_MODELS
from .colmap_model import has_model
from .files import SceneError, is_file, list_images, open_picture, some
from .masks import folder_masks, write_colmap_masks
from .pictures import refuse_heic
from .pycolmap_import import quiet_pycolmap, scene_errors

OVERLAP = 10
"""An image of a video is compared with this many next images, and with this many at distances 1, 2, 4, ... (COLMAP's default)."""

SMALL = 400
"""Pixels of the longer side; smaller photos have too few features: of 22 with 192x144 pixels 8 got a pose, enlarged all."""


@dataclass(frozen=True)
class SfmConfig:
    """Options of the estimation."""

    matching: Literal["exhaustive", "sequential"] = "exhaustive"
    """Which pairs of images are compared: all (90 images take minutes), or neighbours in natural order of names (video)."""
    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP's name of the lens model to fit."""
    single_camera: bool = True
    """True: one camera took all images of a size, at one zoom. False: fit intrinsics to each image."""
    min_registered: float = 0.9
    """The share of the images that one model must place at least, in (0, 1]."""
    max_features: int = 8192
    """SIFT features per image, at most."""
    seed: int = 0
    """Seed of every random choice; with `num_threads=1` a rerun is bit-equal."""
    num_threads: int = -1
    """CPU threads; -1 takes all."""

    def __post_init__(self) -> None:
        check_choice("matching", self.matching, ("exhaustive", "sequential"))
        check_choice("camera_model", self.camera_model, SUPPORTED_MODELS)
        check_range("min_registered", self.min_registered, 0, 1, closed=(False, True))
        check_range("max_features", self.max_features, 100)
        if self.num_threads != -1:
            check_range("num_threads", self.num_threads, 1)


@dataclass(frozen=True)
class SfmReport:
    """The result of structure from motion."""

    registered: int
    """Images with a pose."""
    total: int
    """Images in the folder."""
    points: int
    """3-D points."""
    mean_reprojection_error: float
    """Mean over the points, in pixels."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall-clock time of features, matching, mapping."""
    missing: tuple[str, ...] = ()
    """Images without a pose."""
    model_sizes: tuple[int, ...] = ()
    """Number of images of each model that was found, largest first. Only the first model is written."""

    def __str__(self) -> str:
        lost = f"; without a pose: {some(list(self.missing))}" if self.missing else ""
        times = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in self.seconds.items())
        return (
            f"{self.registered} of {self.total} images registered, {self.points} points, mean reprojection error "
            f"{self.mean_reprojection_error:.2f} px ({times}){lost}"
        )


def run_sfm(
    images: str | Path,
    out: str | Path,
    *,
    config: SfmConfig | None = None,
    replace: bool = False,
    progress: bool = False,
) -> SfmReport:
    """Estimate cameras and a sparse cloud, and write them to `out/sparse/0`.

    Nothing is found where a photo is transparent, or black in its mask (`masks/NAME.png`, in the folder or beside it).

    Args:
        images: folder of images (with subfolders); other files are ignored.
        out: scene folder; `out/sparse/0` appears complete or not at all.
        config: options; the default suits up to a few hundred photos of one camera.
        replace: replace the files of a model that is in `out/sparse/0` already; other files there stay.
        progress: show a bar: images described, pairs compared, images placed.

    Returns:
        Counts, error and times.

    Raises:
        FileNotFoundError: if there is no such folder.
        FileExistsError: if `out/sparse/0` holds a model, and `replace` is False; or if `out/point_cloud` holds a splat, which was
            trained with other poses.
        ValueError: if `out` is a file, or the folder of the images.
        SceneError: if there are fewer than 3 images, pycolmap fails, or the largest model places fewer than
            `min_registered` of the images (the rest is lost, or COLMAP split the scene into unconnected models).
        ImportError: if pycolmap is not installed.

    Note:
        Every random choice is seeded; several threads may still differ in the last digits.
    """
    images, out, config = as_path(images), as_path(out), config or SfmConfig()
    if not images.is_dir():
        raise FileNotFoundError(f"{images}: no such folder; expected the images there")
    check_output("out", out, "a folder")
    if real_path(out) == real_path(images):
        raise ValueError(f"out: expected another folder than that of the images, got {out}; name the folder above it")
    model = out / "sparse" / "0"
    if has_model(model) and not replace:
        raise FileExistsError(
            f"out: expected a scene folder without a model, got one in {model}; name another folder, or pass replace=True "
            "(--replace) to give up that model"
        )
    splat = newest_splat(out)
    if splat is not None and splat.is_relative_to(
        out / "point_cloud"
    ):  # `load_scene` would take it for one of these poses
        raise FileExistsError(
            f"out: expected a scene folder without a splat of other poses, got {splat}, which will not fit the new ones; move "
            f"{out / 'point_cloud'} away, or name another folder"
        )
    refuse_heic(images)
    names = list_images(images)
    if len(names) < 3:
        raise SceneError(f"{images}: expected at least 3 images (PNG, JPEG, TIFF, WebP), got {len(names)}; add views")
    with (
        tempfile.TemporaryDirectory(prefix="kfgs-sfm-") as scratch,
        quiet_pycolmap() as pycolmap,
        scene_errors(
            f"{images}: expected images that pycolmap can register", "check the images and the free disk space"
        ),
        tqdm(disable=not progress, unit="image") as bar,
    ):
        masks = folder_masks(names, images)[0] or [None] * len(names)
        photos = {name: (images / name, mask) for name, mask in zip(names, masks, strict=True)}
        run = SfmRun(pycolmap, images, names, Path(scratch), config, bar, photos)
        seconds = {name: timed(stage) for name, stage in (("features", run.extract), ("matching", run.match))}
        seconds["mapping"] = timed(run.map)
        models = sorted(run.models, key=lambda model: -model.num_reg_images())
        sizes = tuple(model.num_reg_images() for model in models)
        _require_one_model(images, sizes, names, config)
        with atomic_folder(model) as folder:
            models[0].write(str(folder))
        placed = {image.name for image in models[0].images.values() if image.has_pose}
        return SfmReport(
            registered=len(placed),
            total=len(names),
            points=len(models[0].points3D),
            mean_reprojection_error=float(models[0].compute_mean_reprojection_error()),
            seconds=seconds,
            missing=tuple(name for name in names if name not in placed),
            model_sizes=sizes,
        )


def link_images(images: str | Path, out: str | Path) -> bool:
    """Link `out/images` to the folder of the images, so that `load_scene(out)` finds them; False if something is there."""
    beside = as_path(out) / "images"
    if os.path.lexists(beside):
        return False
    beside.symlink_to(real_path(images), target_is_directory=True)
    return True


def timed(stage: Callable[[], None]) -> float:
    """Seconds of wall-clock time that a stage takes."""
    start = time.perf_counter()
    stage()
    return time.perf_counter() - start


@dataclass
class SfmRun:
    """The three stages, over one database."""

    pycolmap: Any
    images: Path
    names: list[str]
    scratch: Path
    config: SfmConfig
    bar: Any
    photos: dict[str, tuple[Path, Path | None]]
    """The file and the mask of each image."""
    models: list[Any] = field(default_factory=list)

    @property
    def database(self) -> str:
        """Where features and matches are kept."""
        return str(self.scratch / "database.db")

    def begin(self, name: str, total: int, unit: str) -> None:
        """Start the bar of a stage."""
        self.bar.reset(total=total)
        self.bar.unit = unit
        self.bar.set_description(name)

    def extract(
        self,
        names: list[str] | None = None,
        known: Mapping[tuple[int, int], int] | None = None,
        single: bool | None = None,
    ) -> None:
        """Compute features of a few images at a time, so that the bar moves and Ctrl-C works.

        Args:
            names: which images; None: all.
            known: cameras of the database by the size (width, height) of their images; images of another size get new ones.
            single: whether one camera took all of a size; None: as the config says. An image of the database keeps its camera.
        """
        colmap, config = self.pycolmap, self.config
        names, single = self.names if names is None else names, config.single_camera if single is None else single
        colmap.set_random_seed(config.seed)
        self.begin("features", len(names), "image")
        mode = colmap.CameraMode.SINGLE if single else colmap.CameraMode.PER_IMAGE
        reader: dict[str, Any] = {"camera_model": config.camera_model}
        cameras = {size: {"existing_camera_id": camera} for size, camera in (known or {}).items()}
        masks = write_colmap_masks(self.scratch / "masks", {name: self.photos[name] for name in names})
        if masks is not None:
            reader["mask_path"] = masks
        options = {"num_threads": config.num_threads, "sift": {"max_num_features": config.max_features}}
        sizes = {name: _size(self.images / name) if single or cameras else (0, 0) for name in names}
        groups = [(size, [name for name in names if sizes[name] == size]) for size in dict.fromkeys(sizes.values())]
        for size, some_names in ((s, group[i : i + 8]) for s, group in groups for i in range(0, len(group), 8)):
            colmap.extract_features(
                self.database, str(self.images), image_names=some_names, camera_mode=mode,
                reader_options=reader | cameras.get(size, {}), extraction_options=options, device=colmap.Device.cpu,
            )  # fmt: skip
            if single and not cameras.get(size):
                cameras[size] = self._camera_of(some_names)
            self.bar.update(len(some_names))
        with colmap.Database.open(self.database) as database:
            read = {image.name for image in database.read_all_images()}
        if len(read) < min(3, len(self.names)):
            raise SceneError(
                f"{self.images}: expected at least 3 images that can be decoded, got {len(read)} of {len(self.names)}; not "
                f"{some([name for name in self.names if name not in read], 3)}: save them again as PNG or JPEG"
            )

    def _camera_of(self, names: list[str]) -> dict[str, Any]:
        """The option that makes the next images share the camera of these; empty while no image could be read."""
        with self.pycolmap.Database.open(self.database) as database:
            found = [image for image in database.read_all_images() if image.name in names]
        return {"existing_camera_id": int(found[0].camera_id)} if found else {}

    def match(self) -> None:
        """Compare pairs."""
        colmap, config, count = self.pycolmap, self.config, len(self.names)
        exhaustive = config.matching == "exhaustive"
        self.begin("matching", count * (count - 1) // 2 if exhaustive else count, "pair" if exhaustive else "image")
        match, pairing = (colmap.match_exhaustive, {}) if exhaustive else self._sequential(colmap)
        self._match(match, pairing)

    def match_pairs(self, pairs: list[tuple[str, str]]) -> None:
        """Compare given pairs of images; no name may have a blank."""
        self.begin("matching", len(pairs), "pair")
        self._match(self.pycolmap.match_image_pairs, self._listed(pairs))

    def _match(self, match: Callable[..., None], pairing: dict[str, Any]) -> None:
        """Compare pairs. pycolmap does not report progress meanwhile, and the bar says so."""
        self.bar.set_postfix_str("no count until all are done")
        match(
            self.database, matching_options={"num_threads": self.config.num_threads}, **pairing,
            verification_options={"ransac": {"random_seed": self.config.seed}}, device=self.pycolmap.Device.cpu,
        )  # fmt: skip
        self.bar.set_postfix_str("")
        self.bar.update(self.bar.total)

    def _listed(self, pairs: list[tuple[str, str]]) -> dict[str, Any]:
        """The option that names the pairs."""
        listed = self.scratch / "pairs.txt"
        listed.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
        return {"pairing_options": self.pycolmap.ImportedPairingOptions(match_list_path=str(listed))}

    def _sequential(self, colmap: Any) -> tuple[Callable[..., None], dict[str, Any]]:
        """The function that matches a video, and its options.

        COLMAP orders names letter by letter (10.png before 9.png), so it gets a list of pairs. In a list it cuts names at
        blanks; names with blanks are only possible without a list, if both orders are the same.
        """
        if any(character.isspace() for name in self.names for character in name):
            if sorted(self.names) == self.names:
                return colmap.match_sequential, {}
            raise SceneError(
                f"{self.images}: expected names without blanks, or padded with zeros, for sequential matching, got "
                f"{some(self.names, 3)}; rename the images or use --matching exhaustive (in Python: matching='exhaustive')"
            )
        return colmap.match_image_pairs, self._listed(sequential_pairs(self.names))

    def options(self) -> Any:
        """Of the mapping, with its seeds."""
        seed = self.config.seed
        options = self.pycolmap.IncrementalPipelineOptions(random_seed=seed, num_threads=self.config.num_threads)
        options.mapper.random_seed = options.triangulation.random_seed = seed
        return options

    def map(self) -> None:
        """Estimate the pose of one image after the other."""
        colmap, options = self.pycolmap, self.options()
        self.begin("mapping", len(self.names), "image")
        (self.scratch / "models").mkdir()
        found = colmap.incremental_mapping(
            self.database, str(self.images), str(self.scratch / "models"), options=options,
            initial_image_pair_callback=lambda: self.bar.update(2), next_image_callback=lambda: self.bar.update(1),
        )  # fmt: skip
        self.models = list(found.values())


def fill_database(pycolmap: Any, path: str, known: Any) -> None:
    """Write the cameras and images of a model, with their ids, into a new database."""
    with pycolmap.Database.open(path) as database:
        for camera in known.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        for rig in known.rigs.values():
            database.write_rig(rig, use_rig_id=True)
        for frame in known.frames.values():
            database.write_frame(frame, use_frame_id=True)
        for image in known.images.values():
            database.write_image(image, use_image_id=True)


def sequential_pairs(
    names: list[str],  # in the order of the video
) -> list[tuple[str, str]]:
    """Pairs of each image with the next 10, and with those 1, 2, 4, ..., 512 further on, as COLMAP's matcher takes them."""
    steps = sorted({*range(1, OVERLAP + 1), *(2**k for k in range(OVERLAP))})
    return [(name, names[i + step]) for i, name in enumerate(names) for step in steps if i + step < len(names)]


def _require_one_model(images: Path, sizes: tuple[int, ...], names: list[str], config: SfmConfig) -> None:
    """Refuse a model that leaves out too many images: a scene that silently lacks a room is worse than none."""
    needed = config.min_registered * len(names)
    if sizes and sizes[0] >= needed:
        return
    if len(sizes) > 1:
        got = f"a scene split into {len(sizes)} unconnected models of {', '.join(map(str, sizes))} images"
    else:
        got = f"{sizes[0] if sizes else 0}"
    size, advice = _largest(images, names), list[str]()
    if 0 < max(size) < SMALL:
        advice.append(
            f"use the original photos, or enlarge them to twice their size: these are small ({size[0]}x{size[1]} pixels)"
        )
    if config.matching == "sequential":
        advice.append("use --matching exhaustive (in Python: matching='exhaustive')")
    advice.append("take overlapping photos between the parts")
    if config.single_camera:
        advice.append(
            "give --no-single-camera (in Python: single_camera=False) if several cameras took them, or zoom differs"
        )
    raise SceneError(
        f"{images}: expected at least {needed:.0f} of {len(names)} images registered in one model (min_registered = "
        f"{config.min_registered:g}), got {got}; {', or '.join(advice)}, or lower --min-registered (in Python: min_registered)"
    )


def _largest(images: Path, names: list[str]) -> tuple[int, int]:
    """(width, height) of the photo with the longest side; (0, 0) if none can be read."""
    return max((_size(images / name) for name in names), key=max, default=(0, 0))


def _size(path: Path) -> tuple[int, int]:
    """(width, height) of a photo; (0, 0) if it cannot be read."""
    if is_file(path):
        with suppress(SceneError, ImportError), open_picture(path) as picture:
            return picture.size
    return 0, 0
