"""A semantic field meets any splat: check or find the common frame, carry the classes over, say how it went."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from .._card import short_repr
from .._check import check_choice, check_range
from ..align.by_cameras import Alignment, align_by_cameras
from ..align.by_shape import align_clouds
from ..align.frames import frames_agree
from ..cameras import Camera
from ..cameras.similarity import Similarity
from ..evaluation import LabelSet
from ..fields import SemanticField
from ..formats import read_splats
from ..formats.splat_file import SCORE, SplatFile
from ..gaussians import Gaussians
from ..labels import Transfer, transfer_labels, vote_labels
from ..labels.transfer import Method
from ..scenes import SceneError
from ..splat.transform import transform_gaussians

By = Literal["distance", "views"]
WAYS: tuple[By, ...] = ("distance", "views")
SOLID = 0.05  # opacity from which a Gaussian takes part in finding the frame: fainter ones float anywhere
STAYS = 0.005  # of the scene's size: an alignment that moves half of the points by less moves nothing


@dataclass(frozen=True, eq=False)
class Attached:
    """A splat with classes, and how it came to them."""

    splats: SplatFile
    """The splat in its own frame, with `labels`, the extra column `score`, class names and `info["labels"]`."""
    transfer: Transfer
    """What distance decided: every Gaussian (`by="distance"`), or those that the views left open (`by="views"`)."""
    similarity: Similarity
    """From the semantic field's frame to the splat's."""
    alignment: Alignment | None
    """How the similarity was found; None where the frames agreed or it was given."""
    words: tuple[str, ...]
    """What was done and found, a sentence each."""

    __repr__ = short_repr

    @property
    def labels(self) -> Tensor:  # [N] int64
        """The class of each Gaussian, -1 = none."""
        assert self.splats.gaussians.labels is not None
        return self.splats.gaussians.labels


def attach(
    field: SemanticField,
    splats: SplatFile | Gaussians | str | Path,
    classes: LabelSet | None = None,
    *,
    cameras: Sequence[Camera] | None = None,
    frame: Similarity | Sequence[Camera] | None = None,
    distance: float | None = None,
    by: By | None = None,
    method: Method = "nearest",
) -> Attached:
    """Give every Gaussian of a splat the class that the semantic field has at its place.

    Frames: a similarity is taken as it is given; to cameras of the splat's own, one is fitted by their names; without
    either, both share one frame where `frames_agree` says so, and else the clouds themselves are aligned.

    Classes, `by="views"`: the field segments its training views, and each Gaussian of the splat takes the class of most of
    the pixels that it fills in them (the score is the winner's share of its votes); on one that no view shows, those of the
    splat that have a class decide, within lambda (the distance within which a label is carried over). `by="distance"`, the
    paper's Sec. 3.4: the field's own Gaussians are classified, and those within lambda decide. How distance decides is
    `method`'s: "nearest" gives a score of 1 - d / lambda, "vote" and "mahalanobis" the winner's share of the weights.

    Args:
        field: a finished field.
        splats: any splat of the same scene, its Gaussians alone, or the path of a splat file; labels that it has are replaced.
        classes: names and embeddings in the teacher's space.
        cameras: undistorted views in the field's frame, usually those it was trained on.
        frame: what tells the splat's frame: the similarity from the field's to it (`Similarity.identity()` says that they
            are one), or views in it, some of which share their names with `cameras`. None compares the clouds.
        distance: lambda in the splat's world units; None takes `default_distance`.
        by: None: "views", which follows the borders of objects much better, or "distance" for a field without cameras.
        method: which label wins where distance decides, see `transfer_labels`; "nearest" is the paper's.

    Raises:
        ValueError: if `by` or `method` is unknown, cameras are missing, the splat is empty, the words have another D than
            the field, or (SceneError) no similarity fits.
        TypeError: if `frame` is neither.

    Note:
        Toy room, colour field of 40,000 Gaussians, protocol `kfgs-removal/1`, the chairs: by distance 0.979 of their
        pixels are gone and 0.969 of the others untouched, by views 0.995 and 0.970 (true label maps instead of
        segmented ones give the same). Gaussians across a border cost the rest: with a score of at least 0.6 alone,
        0.969 are gone and 0.976 untouched. A vote of neighbours for such Gaussians, or the class of the nearest
        rendered surface, made it worse.
    """
    if isinstance(splats, str | Path):
        splats = read_splats(splats)
    elif isinstance(splats, Gaussians):
        splats = SplatFile(splats)
    classes = field.label_set() if classes is None else classes
    cameras = cameras or field.cameras or None
    if field.linear is None and cameras:
        field = field.with_answers(cameras)
    by = by or ("distance" if cameras is None else "views")
    check_choice("by", by, WAYS)
    _check_frame(frame)
    check_choice("method", method, get_args(Method))
    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    if len(splats) == 0:
        raise ValueError("splats: expected at least one Gaussian, got none; there is nothing to label")
    for name, needed in (('by="views"', by == "views"), ("frame", not isinstance(frame, Similarity | None))):
        if needed and not cameras:
            raise ValueError(f"cameras: expected views in the field's frame (for {name}), got none; pass them as well")
    semantic = field.label(classes)  # refuses words of another teacher before the frames are compared
    similarity, alignment, said = _common_frame(field, splats, cameras, frame)
    carry = partial(transfer_labels, distance=distance, method=method)
    if by == "distance":
        labels, scores, transfer, found = _by_distance(semantic, splats, similarity, carry)
    else:
        assert cameras is not None
        labels, scores, transfer, found = _by_views(field, splats, classes, cameras, similarity, carry)
    nothing_open = len(transfer.labels) == 0
    counts = torch.bincount(labels + 1, minlength=len(classes) + 1).tolist()
    facts = {
        **found,
        "lambda": None if nothing_open else transfer.distance,
        "lambda from": None if nothing_open else transfer.how,
        "frame": said,
        "alignment": alignment.to_json() if alignment is not None else None,
        "similarity": similarity.matrix().tolist(),
        "counts": {"none": counts[0], **dict(zip(classes.names, counts[1:], strict=True))},
    }
    labelled = splats.replace(
        gaussians=splats.gaussians.replace(labels=labels),
        extra=splats.extra | {SCORE: scores.to(torch.float32).cpu().numpy()},
        classes=classes.names,
        info=splats.info | {"labels": facts},
    )
    labelled_by = f"{facts['labelled by']}: {len(splats) - counts[0]} of {len(splats)} Gaussians have a class"
    words = said, labelled_by, _about(transfer, by)
    return Attached(labelled, transfer, similarity, alignment, words)


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
    splats: SplatFile,
    cameras: Sequence[Camera] | None,
    frame: Similarity | Sequence[Camera] | None,
) -> tuple[Similarity, Alignment | None, str]:
    """From the field's frame to the splat's, how it was found, and that in words."""
    if isinstance(frame, Similarity):
        return frame, None, "the similarity between the frames was given"
    if frame is not None:
        assert cameras is not None
        alignment = align_by_cameras(cameras, frame)
        return alignment.similarity, alignment, f"aligned by {alignment.summary}"
    clouds = [_solid(gaussians.means, gaussians.opacities) for gaussians in (field.gaussians, splats.gaussians)]
    check = frames_agree(*clouds)
    if check.agree:
        return Similarity.identity(), None, check.summary
    try:
        alignment = align_clouds(*clouds)
    except SceneError as error:
        raise SceneError(f"{error} (frame=Similarity.identity() says that both share one frame)") from error
    if _stays(clouds[0], alignment):
        words = (
            f"at first {check.summary}; but of all frames their own fits best, by the {alignment.how}: they share it"
        )
        return Similarity.identity(), None, words
    return alignment.similarity, alignment, f"{check.summary}; aligned by {alignment.summary}"


def _stays(means: Tensor, alignment: Alignment) -> bool:  # [N, 3]
    """Whether an alignment leaves the points where they are, but for what sparse clouds are uncertain about."""
    places = means.detach().double().cpu()
    shifts = (alignment.similarity.apply(places) - places).norm(dim=1)
    return float(shifts.median()) < STAYS * alignment.size


def _solid(means: Tensor, opacities: Tensor) -> Tensor:  # [N, 3], [N] -> [n, 3]
    """The places of Gaussians that are there to see; all of them where hardly any is."""
    seen = (opacities > SOLID) & means.isfinite().all(1)
    return means[seen] if int(seen.sum()) >= 100 else means


def _by_distance(
    semantic: Gaussians,
    splats: SplatFile,
    similarity: Similarity,
    carry: Callable[[Gaussians, Tensor, Gaussians], Transfer],
) -> tuple[Tensor, Tensor, Transfer, dict[str, Any]]:
    """Labels [N], scores [N], the transfer and facts: the rule of Sec. 3.4."""
    assert semantic.labels is not None
    transfer = carry(transform_gaussians(semantic, similarity), semantic.labels, splats.gaussians)
    facts = {
        "labelled by": "distance to the field's Gaussians",
        "method": transfer.method,
        "score": transfer.score_meaning,
        "ambiguous": transfer.ambiguous,
    }
    return transfer.labels, transfer.scores, transfer, facts


def _by_views(
    field: SemanticField,
    splats: SplatFile,
    classes: LabelSet,
    cameras: Sequence[Camera],
    similarity: Similarity,
    carry: Callable[[Gaussians, Tensor, Gaussians], Transfer],
) -> tuple[Tensor, Tensor, Transfer, dict[str, Any]]:
    """Labels [N], scores [N], the transfer and facts: each Gaussian asks the pixels that it fills."""

    def segmented() -> Iterator[tuple[Camera, Tensor]]:
        for camera in cameras:
            yield similarity.apply_to_camera(camera), field.segment(camera, classes.embeddings)

    colour = splats.gaussians
    votes = vote_labels(colour, segmented(), len(classes), min_share=0.0)
    open_ = votes.labels < 0
    carried = carry(colour, votes.labels, colour.select(open_))
    labels, scores = votes.labels.clone(), votes.shares.clone()
    labels[open_], scores[open_] = carried.labels, carried.scores.to(scores)
    facts = {
        "labelled by": f"votes of {len(cameras)} segmented views",
        "method": carried.method,
        "score": f"share of the votes; where no view shows a Gaussian, {carried.score_meaning}, to those that have a class",
        "shown": int((~open_).sum()),
        "not shown": int(open_.sum()),
    }
    return labels, scores, carried, facts


def _about(transfer: Transfer, by: By) -> str:
    """What distance decided, in words."""
    if by == "distance":
        return repr(transfer)
    count = len(transfer.labels)
    return f"of {count} that no view shows: {transfer!r}" if count else "there is none that no view shows"
