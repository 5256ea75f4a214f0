"""Estimate cameras for a folder of images: structure from motion with pycolmap, on the CPU."""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tqdm import tqdm

from .._check import check_choice, check_range
from .._files import as_path, atomic_folder, check_output, file_stem, real_path
from .colmap import LENSES, quiet_pycolmap
from .colmap_model import has_model
from .files import SceneError, folder_masks, list_images, picture_size, some, write_colmap_masks

OVERLAP = 10  # next images that one of a video is compared with, and as many at distances 1, 2, 4, ... (as COLMAP)
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
        check_choice("camera_model", self.camera_model, tuple(LENSES))
        check_range("min_registered", self.min_registered, 0, 1, closed=(False, True))
        check_range("max_features", self.max_features, 100)
        if self.num_threads != -1:
            check_range("num_threads", self.num_threads, 1)


@dataclass(frozen=True)
class SfmReport:
    """The result of structure from motion."""

    registered: int  # images with a pose
    total: int  # images in the folder
    points: int  # 3-D points
    mean_reprojection_error: float  # over the points, in pixels
    missing: tuple[str, ...] = ()  # images without a pose

    def __str__(self) -> str:
        placed = f"{self.registered} of {self.total} images registered, {self.points} points"
        lost = f"; without a pose: {some(list(self.missing))}" if self.missing else ""
        return f"{placed}, mean reprojection error {self.mean_reprojection_error:.2f} px{lost}"


def run_sfm(
    images: str | Path,
    out: str | Path,
    *,
    config: SfmConfig | None = None,
    replace: bool = False,
    progress: bool = False,
) -> SfmReport:
    """Estimate cameras and a sparse cloud with pycolmap, and write them to `out/sparse/0`.

    Nothing is found where a photo is transparent, or black in its mask (`masks/NAME.png`, in the folder or next to it). Every
    random choice is seeded; several threads may still differ in the last digits.

    Args:
        images: folder of images (with subfolders); other files are ignored.
        out: scene folder; `out/sparse/0` appears complete or not at all.
        config: options; the default suits up to a few hundred photos of one camera.
        replace: replace the files of a model that is in `out/sparse/0` already; other files there stay.
        progress: show a bar: images described, pairs compared, images placed.

    Raises:
        FileNotFoundError: if there is no such folder.
        FileExistsError: if `out/sparse/0` holds a model, and `replace` is False.
        ValueError: if `out` is a file.
        SceneError: if there are fewer than 3 images, pycolmap fails, or the largest model places fewer than
            `min_registered` of the images (the rest is lost, or COLMAP split the scene into unconnected models).
        ImportError: if pycolmap is not installed.
    """
    images, out, config = as_path(images), as_path(out), config or SfmConfig()
    if not images.is_dir():
        raise FileNotFoundError(f"{images}: no such folder; expected the images there")
    model = check_output("out", out, "a folder") / "sparse" / "0"
    if has_model(model) and not replace:
        advice = "name another folder, or pass replace=True (--replace) to give up that model"
        raise FileExistsError(f"out: expected a scene folder without a model, got one in {model}; {advice}")
    names = list_images(images)
    stems = {file_stem(name) for name in names}  # of converted ones, too
    heic = [name for name in list_images(images, (".heic", ".heif")) if file_stem(name) not in stems]
    if heic:
        how = "`magick mogrify -format jpg *.heic`, in the app of the phone, or in its settings before the next photo"
        got = f"HEIC photographs ({some(heic, 3)}); save them as JPEG, with their EXIF: {how}"
        raise SceneError(f"{images}: expected pictures that pycolmap reads, got {got}")
    if len(names) < 3:
        raise SceneError(f"{images}: expected at least 3 images (PNG, JPEG, TIFF, WebP), got {len(names)}; add views")
    pairs = None if config.matching == "exhaustive" else sequential_pairs(names)
    if pairs is not None and any(len(name.split()) > 1 for name in names):  # pycolmap cuts them in a list of pairs
        got = f"{some(names, 3)}; rename the images or use matching='exhaustive' (--matching exhaustive)"
        raise SceneError(f"{images}: expected names without blanks for sequential matching, got {got}")
    masks = folder_masks(names, images)[0] or [None] * len(names)
    photos = {name: (images / name, mask) for name, mask in zip(names, masks, strict=True)}
    what, advice = f"{images}: expected images that pycolmap can register", "check the images and the free disk space"
    with sfm_run(images, photos, config, what, advice, progress) as run:
        run.extract()
        run.match(pairs)
        models = sorted(run.map(), key=lambda model: -model.num_reg_images())
        sizes = [model.num_reg_images() for model in models]
        if not sizes or sizes[0] < config.min_registered * len(names):
            raise SceneError(f"{images}: {_too_few(images, sizes, names, config)}")
        with atomic_folder(model) as folder:
            models[0].write(str(folder))
        placed = {image.name for image in models[0].images.values() if image.has_pose}
        missing = tuple(name for name in names if name not in placed)
        error = float(models[0].compute_mean_reprojection_error())
        return SfmReport(len(placed), len(names), len(models[0].points3D), error, missing)


@contextmanager
def sfm_run(
    images: Path, photos: dict[str, tuple[Path, Path | None]], config: SfmConfig, what: str, advice: str, progress: bool
) -> Iterator[SfmRun]:
    """A run over the images of a folder in a scratch folder; errors of pycolmap begin with `what` and end with `advice`."""
    with (
        tempfile.TemporaryDirectory(prefix="kfgs-sfm-") as scratch,
        quiet_pycolmap(what, advice) as pycolmap,
        tqdm(disable=not progress, unit="image") as bar,
    ):
        yield SfmRun(pycolmap, images, Path(scratch), config, bar, photos)


def link_images(images: str | Path, out: str | Path) -> bool:
    """Link `out/images` to the folder of the images, so that `load_scene(out)` finds them; False if something is there."""
    link = as_path(out) / "images"
    if os.path.lexists(link):
        return False
    link.symlink_to(real_path(images), target_is_directory=True)
    return True


@dataclass
class SfmRun:
    """The stages of structure from motion, over one database."""

    pycolmap: Any
    images: Path
    scratch: Path
    config: SfmConfig
    bar: Any
    photos: dict[str, tuple[Path, Path | None]]  # the file and the mask of each image by its name

    def __post_init__(self) -> None:
        self.database = str(self.scratch / "database.db")  # of features and matches

    def extract(self, known: bool = False) -> None:
        """Compute features of a few images at a time, so that the bar moves and Ctrl-C works.

        Images of one size share the camera of the first ones, unless `known`: the database has the cameras of all already.
        """
        colmap, config, names = self.pycolmap, self.config, list(self.photos)
        colmap.set_random_seed(config.seed)
        self.bar.set_description("features")
        self.bar.reset(total=len(names))
        single = config.single_camera and not known
        mode = colmap.CameraMode.SINGLE if single else colmap.CameraMode.PER_IMAGE
        reader: dict[str, Any] = {"camera_model": config.camera_model}
        if (masks := write_colmap_masks(self.scratch / "masks", self.photos)) is not None:
            reader["mask_path"] = masks
        options = {"num_threads": config.num_threads, "sift": {"max_num_features": config.max_features}}
        sizes = {name: _size(self.photos[name][0]) if single else (0, 0) for name in names}
        for size in Counter(sizes.values()):
            group, camera = [name for name in names if sizes[name] == size], dict[str, int]()
            for few in (group[i : i + 8] for i in range(0, len(group), 8)):
                colmap.extract_features(
                    self.database, str(self.images), image_names=few, camera_mode=mode, reader_options=reader | camera,
                    extraction_options=options, device=colmap.Device.cpu,
                )  # fmt: skip
                with colmap.Database.open(self.database) as database:
                    ids = {image.name: image.camera_id for image in database.read_all_images()}
                placed = [ids[name] for name in few if name in ids]
                if single and placed:
                    camera.setdefault("existing_camera_id", int(placed[0]))
                self.bar.update(len(few))
        if len(ids) < min(3, len(names)):
            lost = some([name for name in names if name not in ids], 3)
            got = f"{len(ids)} of {len(names)}; not {lost}: save them again as PNG or JPEG"
            raise SceneError(f"{self.images}: expected at least 3 images that can be decoded, got {got}")

    def match(self, pairs: Sequence[tuple[str, str]] | None = None) -> None:
        """Compare pairs of images, whose names may have no blank; None: each with each."""
        colmap, count, pairing = self.pycolmap, len(self.photos), dict[str, Any]()
        if pairs is not None:
            listed = self.scratch / "pairs.txt"
            listed.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
            pairing["pairing_options"] = colmap.ImportedPairingOptions(match_list_path=str(listed))
        total = count * (count - 1) // 2 if pairs is None else len(pairs)
        self.bar.set_description("matching")
        self.bar.reset(total=total)
        self.bar.set_postfix_str("no count until all are done")  # pycolmap reports no progress meanwhile
        (colmap.match_exhaustive if pairs is None else colmap.match_image_pairs)(
            self.database, matching_options={"num_threads": self.config.num_threads}, **pairing,
            verification_options={"ransac": {"random_seed": self.config.seed}}, device=colmap.Device.cpu,
        )  # fmt: skip
        self.bar.set_postfix_str("")
        self.bar.update(total)

    def options(self) -> Any:
        """Of the mapping, with its seeds."""
        seed, threads = self.config.seed, self.config.num_threads
        options = self.pycolmap.IncrementalPipelineOptions(random_seed=seed, num_threads=threads)
        options.mapper.random_seed = options.triangulation.random_seed = seed
        return options

    def map(self) -> list[Any]:
        """Estimate the pose of one image after the other; the models that result."""
        self.bar.set_description("mapping")
        self.bar.reset(total=len(self.photos))
        (self.scratch / "models").mkdir()
        models = self.pycolmap.incremental_mapping(
            self.database, str(self.images), str(self.scratch / "models"), options=self.options(),
            initial_image_pair_callback=lambda: self.bar.update(2), next_image_callback=lambda: self.bar.update(1),
        )  # fmt: skip
        return list(models.values())


def sequential_pairs(names: list[str]) -> list[tuple[str, str]]:
    """Pairs of each image of a video with the next 10, and with those 1, 2, 4, ..., 512 later, as COLMAP's matcher takes them."""
    steps = sorted({*range(1, OVERLAP + 1), *(2**k for k in range(OVERLAP))})
    return [(name, names[i + step]) for i, name in enumerate(names) for step in steps if i + step < len(names)]


def _too_few(images: Path, sizes: list[int], names: list[str], config: SfmConfig) -> str:
    """Why a model that leaves out too many images is refused: a scene that silently lacks a room is worse than none."""
    got = f"{sizes[0] if sizes else 0}"
    if len(sizes) > 1:
        got = f"a scene split into {len(sizes)} unconnected models of {', '.join(map(str, sizes))} images"
    width, height = max((_size(images / name) for name in names), key=max)
    advice = []
    if 0 < max(width, height) < SMALL:
        small = f"these are small ({width}x{height} pixels)"
        advice.append(f"use the original photos, or enlarge them to twice their size: {small}")
    advice.append("take overlapping photos between the parts")
    if config.matching == "sequential":
        advice.append("use matching='exhaustive' (--matching exhaustive)")
    if config.single_camera:
        advice.append("give single_camera=False (--no-single-camera) if several cameras took them, or zoom differs")
    advice.append("lower min_registered (--min-registered)")
    return (
        f"expected at least {config.min_registered * len(names):.0f} of {len(names)} images registered in one model "
        f"(min_registered = {config.min_registered:g}), got {got}; {', or '.join(advice)}"
    )


def _size(path: Path) -> tuple[int, int]:
    """(width, height) of a photo; (0, 0) if it cannot be read."""
    with suppress(SceneError, ImportError, OSError):
        return picture_size(path)
    return 0, 0
