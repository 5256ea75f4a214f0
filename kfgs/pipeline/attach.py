"""Give a splat, or a cloud of points, the classes of a semantic field: find the common frame, and carry the classes over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from .._check import ORIGIN, check_choice, check_range
from .._files import as_path
from .._origin import recounted
from ..cameras import Camera, as_cameras
from ..cameras.similarity import Similarity
from ..fields import SemanticField, fuse_views
from ..formats import find_format, read_splats, write_splats
from ..formats.ply import points_from_columns, read_header, read_ply, write_ply
from ..formats.ply_3dgs import label_column
from ..formats.sidecar import write_names
from ..gaussians import Gaussians
from ..labels import LabelSet, Transfer, nearest_labels, number_instances
from ..labels.transfer import without_instances
from ..scenes import SceneError, align_by_cameras
from ..scenes.frames import Alignment, frames_agree
from ..splat import transform_gaussians, vote_labels
from ..splat.sh import rgb_to_sh0
from ..viz import palette
from ..viz.pictures import check_suffix

By = Literal["distance", "views"]
NEARNESS = "1 - distance / lambda"  # the meaning of a score
SOLID = 0.05  # fainter Gaussians are not used to compare frames: they can be anywhere


@dataclass(frozen=True, eq=False)
class Attached:
    """A splat with classes, and how they were found."""

    gaussians: Gaussians
    """The splat in its own frame, with labels, scores, class names, and things told apart (`number_instances`)."""
    transfer: Transfer
    """The labels decided by distance: of every Gaussian (`by="distance"`), or of those without a label by views."""
    similarity: Similarity
    """From the semantic field's frame to the splat's."""
    alignment: Alignment | None
    """How the similarity was found; None if the frames agreed or it was given."""
    notes: tuple[str, ...]
    """Sentences for people: what was done, and the results."""
    facts: dict[str, Any]
    """The same as JSON; `write_splats(..., facts=)` keeps them with the class names."""

    def __repr__(self) -> str:
        g, labelled, within = self.gaussians, int((self.labels >= 0).sum()), f"lambda {self.transfer.distance:.4g}"
        return f"Attached({labelled:,} of {len(g):,} Gaussians labelled, {len(g.names)} classes, {within})"

    @property
    def labels(self) -> Tensor:  # [N] int64
        """The class of each Gaussian, -1 = none."""
        assert self.gaussians.labels is not None
        return self.gaussians.labels


def attach(
    field: SemanticField,
    splats: Gaussians | str | Path,
    classes: LabelSet | None = None,
    *,
    cameras: Sequence[Camera] | None = None,
    frame: Similarity | Sequence[Camera] | None = None,
    distance: float | None = None,
    by: By | None = None,
) -> Attached:
    """Give every Gaussian of a splat the class that the semantic field has at its position.

    Frames: a given similarity is used. If cameras of the splat are given, a similarity is fitted to those with the same
    names. Otherwise `frames_agree` checks whether both share one frame, and if not, that is an error.

    Classes, `by="views"`: the field segments its training views, and each Gaussian of the splat takes the class of most of
    the pixels that it fills in them (the score is the winner's share of its votes). A Gaussian that no view shows takes the
    label of labelled ones of the splat within lambda (the distance within which a label is carried over). `by="distance"`,
    the paper's Sec. 3.4: the field's own Gaussians are classified, and those within lambda decide; the score is
    1 - d / lambda.

    Args:
        field: a finished field.
        splats: any splat of the same scene, or the path of its file; old labels are replaced.
        classes: names and embeddings in the teacher's space; None: the field's.
        cameras: undistorted views in the field's frame; None: its training views.
        frame: the similarity from the field's frame to the splat's (`Similarity.identity()` if they are the same), or views
            in the splat's frame, some with the same names as `cameras`. None compares the clouds.
        distance: lambda in the splat's world units; None: see `labels.nearest_labels`.
        by: None: "views", which follows the borders of objects much better, or "distance" for a field without cameras.

    Raises:
        ValueError: if `by` is unknown, cameras are missing, the splat is empty, the words have another D than
            the field, or (SceneError) no similarity fits.

    Note:
        Toy room, colour field of 40,000 Gaussians, protocol `kfgs-removal/1`, the chairs: by distance 0.979 of their
        pixels are removed and 0.969 of the others unchanged; by views 0.995 and 0.970 (the same with true label maps).
        A vote of neighbours for border Gaussians, or the class of the nearest rendered surface, was worse.
    """
    if not hasattr(field, "label"):
        raise TypeError(f"field: expected a SemanticField, got {type(field).__name__}; SemanticField.load opens one")
    splats = read_splats(splats) if isinstance(splats, str | Path) else splats
    cameras = as_cameras(cameras or field.cameras)
    by = by or ("views" if cameras else "distance")
    check_choice("by", by, ("distance", "views"))
    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    if len(splats) == 0:
        raise ValueError("splats: expected at least one Gaussian, got none; there is nothing to label")
    for name, needed in (('by="views"', by == "views"), ("frame", isinstance(frame, Sequence))):
        if needed and not cameras:
            raise ValueError(f"cameras: expected views in the field's frame (for {name}), got none; pass them as well")
    if field.fused is None and cameras:
        field = fuse_views(field, cameras)
    semantic = field.label(classes)  # checks the classes before the frames are compared
    similarity, alignment, frame_note = _common_frame(field, splats, cameras, frame)
    if by == "distance":
        transfer = _carry(transform_gaussians(semantic, similarity), splats, distance)
        labels, scores = transfer.labels, transfer.scores
        how: dict[str, Any] = {"labelled by": "distance to the field's Gaussians", "score": NEARNESS}
    else:
        views = ((similarity.apply_to_camera(camera), field.segment(camera, classes)) for camera in cameras)
        votes = vote_labels(splats, views, len(semantic.names), min_share=0.0)
        hidden = votes.labels < 0
        transfer = _carry(splats.replace(labels=votes.labels), splats.select(hidden), distance)
        labels = votes.labels.masked_scatter(hidden, transfer.labels)
        scores = votes.shares.masked_scatter(hidden, transfer.scores.to(votes.shares))
        how = {
            "labelled by": f"votes of {len(cameras)} segmented views",
            "score": f"share of the votes; where no view shows a Gaussian, {NEARNESS}, to those that have a class",
            "shown": len(splats) - len(transfer.labels),
        }
    counts = torch.bincount(labels + 1, minlength=len(semantic.names) + 1).tolist()
    facts = {
        **how,
        "lambda": transfer.distance if len(transfer.labels) else None,
        "lambda from": transfer.how if len(transfer.labels) else None,
        "frame": frame_note,
        "alignment": None if alignment is None else alignment.to_json(),
        "similarity": similarity.matrix().tolist(),
        "counts": {"none": counts[0], **dict(zip(semantic.names, counts[1:], strict=True))},
    }
    labelled = without_instances(splats).replace(labels=labels, scores=scores.float(), names=semantic.names)
    if cameras:
        labelled = number_instances(labelled, [similarity.apply_to_camera(camera) for camera in cameras])
    return Attached(labelled, transfer, similarity, alignment, (frame_note, _count(splats, how, transfer)), facts)


def _count(splats: Gaussians, how: dict[str, Any], transfer: Transfer) -> str:
    """How many Gaussians got a class in which way."""
    ways = [f"{how['shown']:,} got a class by the views"] if "shown" in how else []
    if transfer.labelled or not ways:
        who = "that no view shows" if ways else "got a class"
        ways.append(f"{transfer.labelled:,} {who} by distance (lambda {transfer.distance:.3g})")
    return f"{how['labelled by']}: of {len(splats):,} Gaussians {', '.join(ways)}, {transfer.orphaned:,} got none"


def _common_frame(
    field: SemanticField, splats: Gaussians, cameras: Sequence[Camera], frame: Similarity | Sequence[Camera] | None
) -> tuple[Similarity, Alignment | None, str]:
    """The similarity from the field's frame to the splat's, the alignment behind it, and a sentence about it."""
    if isinstance(frame, Similarity):
        return frame, None, "the similarity between the frames was given"
    if frame is not None:
        alignment = align_by_cameras(cameras, as_cameras(frame))
        return alignment.similarity, alignment, f"aligned by {alignment.summary}"
    origin, solid = field.gaussians.origin, []
    for cloud in (field.gaussians, splats):
        means = recounted(cloud.means, cloud.origin, origin)
        seen = (cloud.opacities > SOLID) & means.isfinite().all(1)
        solid.append(means[seen] if int(seen.sum()) >= 100 else means)  # all, if nearly all are faint
    check = frames_agree(*solid)
    if check.agree:
        return Similarity.identity(), None, check.summary
    raise SceneError(
        f"{check.summary}; give the cameras of the splat as frame, some with the names of the field's, or say that both share "
        "one frame (frame=Similarity.identity())"
    )


def _carry(source: Gaussians, target: Gaussians, distance: float | None) -> Transfer:
    """The labels of a cloud, by distance."""
    assert source.labels is not None
    means = recounted(target.means, target.origin, source.origin)
    return nearest_labels(source.means, source.labels, means, distance)


def is_cloud(path: Path) -> bool:
    """Whether a path is a PLY of points, which have no size."""
    if not path.is_file() or find_format(path).NAME != "ply":
        return False
    return "scale_0" not in {row.name for table in read_header(path).elements[:1] for row in table.properties}


def save_labelled(path: str | Path, gaussians: Gaussians, *, rule: str) -> list[Path]:
    """Write labelled Gaussians as a splat in the colours of their classes, with `class_id` and `score`.

    `rule` says how they were found, in the JSON file with the class names that is written next to it.
    """
    assert gaussians.labels is not None
    colors = torch.from_numpy(palette(gaussians.labels, gaussians.names)).to(gaussians.means) / 255
    painted = gaussians.replace(features=None, sh=rgb_to_sh0(colors)[:, None])
    return list(write_splats(painted, path, facts={"labelled by": rule}).paths)


def label_cloud(
    gaussians: Gaussians, cloud: str | Path, out: str | Path, *, distance: float | None = None
) -> tuple[Transfer, list[Path]]:
    """Carry labels to the points or Gaussians of a PLY file by distance (Sec. 3.4), keeping all their other columns.

    Label colours are added if the cloud has no colours; `class_id` is replaced. A JSON file with the class names is written
    next to `out`. `distance` is lambda, in world units; None: from the clouds' spacing. A ValueError if the file has no x, y,
    z, or holds more than points (faces would be lost).
    """
    assert gaussians.labels is not None
    cloud, out = as_path(cloud), check_suffix(out, ".ply", name="out")
    columns, header = read_ply(cloud), read_header(cloud)
    if others := [element.name for element in header.elements[1:] if element.rows]:  # for instance the faces of a mesh
        got = f"{', '.join(others)} too, which labelling would lose; save the vertices as a point cloud"
        raise ValueError(f"{cloud}: expected nothing but points, got {got}")
    local = recounted(points_from_columns(cloud, columns), ORIGIN, gaussians.origin)
    moved = nearest_labels(gaussians.means, gaussians.labels, local, distance)
    added = {"class_id": label_column(moved.labels)}
    if not {"red", "green", "blue"} & set(columns):
        rgb = palette(moved.labels, gaussians.names)
        added |= {name: np.ascontiguousarray(rgb[:, i]) for i, name in enumerate(("red", "green", "blue"))}
    write_ply(out, columns | added, comments=("labels carried by kfgs", *header.comments))
    names = write_names(out, gaussians.names, **{"distance": moved.distance, "distance from": moved.how})
    return moved, [out, names]
