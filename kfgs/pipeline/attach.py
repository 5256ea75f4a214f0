"""Give any splat the classes of a semantic field: check or find the common frame, and carry the classes over."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from .._card import LINE, cut
from .._check import check_choice, check_range
from .._origin import recounted
from .._typed import typed
from ..cameras import Camera
from ..cameras.similarity import Similarity
from ..fields import SemanticField, fuse_views
from ..formats import read_splats
from ..gaussians import Gaussians
from ..labels import LabelSet, Transfer, nearest_labels
from ..scenes import Alignment, SceneError, align_by_cameras, frames_agree
from ..splat import transform_gaussians, vote_labels

By = Literal["distance", "views"]
WAYS: tuple[By, ...] = ("distance", "views")
NEARNESS = "1 - distance / lambda"  # the meaning of a score
SOLID = 0.05  # fainter Gaussians are not used to find the frame: they can be anywhere


@dataclass(frozen=True, eq=False)
class Attached:
    """A splat with classes, and how they were found."""

    gaussians: Gaussians
    """The splat in its own frame, with labels, scores and class names."""
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
        labelled, names = int((self.labels >= 0).sum()), len(self.gaussians.names)
        frame = "" if self.alignment is None else f"; {self.alignment!r}"
        within = f"lambda {self.transfer.distance:.4g}"
        return cut(
            f"Attached({labelled:,} of {len(self.gaussians):,} Gaussians labelled, {names} classes, {within}{frame})",
            LINE,
        )

    @property
    def labels(self) -> Tensor:  # [N] int64
        """The class of each Gaussian, -1 = none."""
        assert self.gaussians.labels is not None
        return self.gaussians.labels


@typed
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
    the paper's Sec. 3.4: the field's own Gaussians are classified, and those within lambda decide; the score
    is 1 - d / lambda.

    Args:
        field: a finished field.
        splats: any splat of the same scene, or the path of its file; old labels are replaced.
        classes: names and embeddings in the teacher's space.
        cameras: undistorted views in the field's frame, usually the training views.
        frame: the similarity from the field's frame to the splat's (`Similarity.identity()` if they are the same), or views
            in the splat's frame, some with the same names as `cameras`. None compares the clouds.
        distance: lambda in the splat's world units; None: `default_distance`.
        by: None: "views", which follows the borders of objects much better, or "distance" for a field without cameras.

    Raises:
        ValueError: if `by` is unknown, cameras are missing, the splat is empty, the words have another D than
            the field, or (SceneError) no similarity fits.
        TypeError: if `frame` is neither.

    Note:
        Toy room, colour field of 40,000 Gaussians, protocol `kfgs-removal/1`, the chairs: by distance 0.979 of their
        pixels are removed and 0.969 of the others unchanged; by views 0.995 and 0.970 (the same with true label maps).
        Gaussians across a border cause the rest: with only those of score 0.6 or more, 0.969 are removed and 0.976
        unchanged. A vote of neighbours for border Gaussians, or the class of the nearest rendered surface, was worse.
    """
    if isinstance(splats, str | Path):
        splats = read_splats(splats)
    classes = field.classes if classes is None else classes
    cameras = cameras or field.cameras or None
    if field.fused is None and cameras:
        field = fuse_views(field, cameras)
    by = by or ("distance" if cameras is None else "views")
    check_choice("by", by, WAYS)
    _check_frame(frame)
    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    if len(splats) == 0:
        raise ValueError("splats: expected at least one Gaussian, got none; there is nothing to label")
    for name, needed in (('by="views"', by == "views"), ("frame", not isinstance(frame, Similarity | None))):
        if needed and not cameras:
            raise ValueError(f"cameras: expected views in the field's frame (for {name}), got none; pass them as well")
    semantic = field.label(classes)  # checks the classes before the frames are compared
    assert classes is not None
    similarity, alignment, frame_note = _common_frame(field, splats, cameras, frame)
    carry = partial(_carry, distance=distance)
    if by == "distance":
        labels, scores, transfer, found = _by_distance(semantic, splats, similarity, carry)
    else:
        assert cameras is not None
        labels, scores, transfer, found = _by_views(field, splats, classes, cameras, similarity, carry)
    nothing_open = len(transfer.labels) == 0
    counts = torch.bincount(labels + 1, minlength=len(classes) + 1).tolist()
    details = {
        **found,
        "lambda": None if nothing_open else transfer.distance,
        "lambda from": None if nothing_open else transfer.how,
        "frame": frame_note,
        "alignment": alignment.to_json() if alignment is not None else None,
        "similarity": similarity.matrix().tolist(),
        "counts": {"none": counts[0], **dict(zip(classes.names, counts[1:], strict=True))},
    }
    labelled = splats.replace(labels=labels, scores=scores.float(), names=classes.names)
    labelled_by = f"{details['labelled by']}: {len(splats) - counts[0]} of {len(splats)} Gaussians have a class"
    notes = frame_note, labelled_by, _about(transfer, len(splats), by)
    return Attached(labelled, transfer, similarity, alignment, notes, details)


def _check_frame(frame: Any) -> None:
    if isinstance(frame, Similarity | None):
        return
    if not isinstance(frame, Sequence) or not all(isinstance(camera, Camera) for camera in frame):
        raise TypeError(
            f"frame: expected a Similarity, views in the splat's frame, or None, got {type(frame).__name__}; a matrix "
            "becomes one by Similarity.from_matrix"
        )


def _common_frame(
    field: SemanticField,
    splats: Gaussians,
    cameras: Sequence[Camera] | None,
    frame: Similarity | Sequence[Camera] | None,
) -> tuple[Similarity, Alignment | None, str]:
    """The similarity from the field's frame to the splat's, the alignment behind it, and a sentence about it."""
    if isinstance(frame, Similarity):
        return frame, None, "the similarity between the frames was given"
    if frame is not None:
        assert cameras is not None
        alignment = align_by_cameras(cameras, frame)
        return alignment.similarity, alignment, f"aligned by {alignment.summary}"
    a, b = field.gaussians, splats
    places = a.means, recounted(b.means, b.origin, a.origin)
    clouds = [_solid(means, cloud.opacities) for means, cloud in zip(places, (a, b), strict=True)]
    check = frames_agree(*clouds)
    if check.agree:
        return Similarity.identity(), None, check.summary
    raise SceneError(
        f"{check.summary}; give the cameras of the splat, some with the names of the field's (frame=, --splat-scene), or say "
        "that both share one frame (frame=Similarity.identity(), --same-frame)"
    )


def _solid(means: Tensor, opacities: Tensor) -> Tensor:  # [N, 3], [N] -> [n, 3]
    """The positions of Gaussians that are not faint; all positions if nearly all are faint."""
    seen = (opacities > SOLID) & means.isfinite().all(1)
    return means[seen] if int(seen.sum()) >= 100 else means


def _by_distance(
    semantic: Gaussians,
    splats: Gaussians,
    similarity: Similarity,
    carry: Callable[[Gaussians, Gaussians], Transfer],
) -> tuple[Tensor, Tensor, Transfer, dict[str, Any]]:
    """Labels [N], scores [N], the transfer and details, by the rule of Sec. 3.4."""
    transfer = carry(transform_gaussians(semantic, similarity), splats)
    details = {
        "labelled by": "distance to the field's Gaussians",
        "score": NEARNESS,
        "ambiguous": transfer.ambiguous,
    }
    return transfer.labels, transfer.scores, transfer, details


def _by_views(
    field: SemanticField,
    splats: Gaussians,
    classes: LabelSet,
    cameras: Sequence[Camera],
    similarity: Similarity,
    carry: Callable[[Gaussians, Gaussians], Transfer],
) -> tuple[Tensor, Tensor, Transfer, dict[str, Any]]:
    """Labels [N], scores [N], the transfer and details: each Gaussian takes the class of most pixels that it fills."""

    def segmented() -> Iterator[tuple[Camera, Tensor]]:
        for camera in cameras:
            yield similarity.apply_to_camera(camera), field.segment(camera, classes.embeddings)

    votes = vote_labels(splats, segmented(), len(classes), min_share=0.0)
    open_ = votes.labels < 0
    carried = carry(splats.replace(labels=votes.labels), splats.select(open_))
    labels, scores = votes.labels.clone(), votes.shares.clone()
    labels[open_], scores[open_] = carried.labels, carried.scores.to(scores)
    details = {
        "labelled by": f"votes of {len(cameras)} segmented views",
        "score": f"share of the votes; where no view shows a Gaussian, {NEARNESS}, to those that have a class",
        "shown": int((~open_).sum()),
        "not shown": int(open_.sum()),
    }
    return labels, scores, carried, details


def _carry(source: Gaussians, target: Gaussians, distance: float | None) -> Transfer:
    """`transfer_labels`, and where each label came from."""
    assert source.labels is not None
    means = recounted(target.means, target.origin, source.origin)
    return nearest_labels(source.means, source.labels, means, distance)


def _about(transfer: Transfer, total: int, by: By) -> str:
    """How many of all Gaussians got their class from the views, how many by distance, and how many got none."""
    shown, lambda_ = total - len(transfer.labels), f"(lambda {transfer.distance:.3g})"
    if by == "distance":
        ways = [f"{transfer.labelled:,} got a class by distance {lambda_}"]
    else:
        ways = [f"{shown:,} got a class by the views"]
        ways += [f"{transfer.labelled:,} that no view shows by distance {lambda_}"] if transfer.labelled else []
    return f"{total:,} Gaussians: {', '.join(ways)}, {transfer.orphaned:,} got none"
