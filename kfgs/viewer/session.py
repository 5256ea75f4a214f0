"""What a page or a notebook widget asks of Python: answers to texts, what surrounds a Gaussian, and files.

The viewer keeps its own state in the browser, so several pages do not disturb each other. Masks travel as bits, one for each
Gaussian of a side, the lowest bit first.
"""

from __future__ import annotations

from pathlib import Path
from threading import Lock
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from .._check import check_choice
from .._files import as_path
from ..formats import SplatFile, write_splats
from ..formats.splat_file import SCORE
from ..labels import EditList, Selection, connected_parts
from ..labels.edits.edit_list import FORMAT, VERSION
from .meaning import Asked
from .numbered_files import numbered_path
from .picked import Side
from .saved import MOST_PARTS, SelectedSide, save_sides
from .state import Exploration

Answer = tuple[dict[str, Any], bytes]
EDITS = ("recolor", "opacity", "move", "duplicate", "remove")
"""What the viewer can do to a cloud. `Insert` is not among them: it would read files of this machine for who has the link."""


class Session:
    """Answers the viewer's calls; safe to call from several threads.

    Args:
        state: the clouds and their answers. Its question, gamma and lambda become those of the last file that was saved.
        out: folder for saved files, which get the next free number.
    """

    def __init__(self, state: Exploration, out: str | Path = "kfgs_view") -> None:
        self.state, self.out = state, as_path(out)
        self._lock = Lock()
        self._calls = {
            "ask": self._ask,
            "similar": self._similar,
            "describe": self._describe,
            "parts": self._parts,
            "save_selection": self._save_selection,
            "save_edits": self._save_edits,
        }

    def call(self, name: str, args: dict[str, Any], attached: bytes = b"") -> Answer:
        """Answer one call.

        Args:
            name: one of

                - `ask` {words}: attaches the scores of the semantic Gaussians, float32, NaN where nothing is known
                - `similar` {}, with a mask of the semantic side: as `ask`, for what is like these Gaussians
                - `describe` {side, index}: the views that see a Gaussian
                - `parts` {side, edits}, with a mask of it: connected parts, largest first; attaches the part of each Gaussian,
                  int16, -1 for none
                - `save_selection` {words, gamma, lambda, sides, edits}, with a mask of each side
                - `save_edits` {lambda, edits}

                `edits` has a list for each side that was edited, in the form of `EditList.save`. Masks are of the cloud with
                its copies, before Gaussians are removed.
            args: its arguments.
            attached: bytes that belong to them.

        Raises:
            ValueError: for an unknown call or wrong arguments.
            TypeError: for arguments of another type.
        """
        check_choice("name", name, list(self._calls))
        for key, kind in (("sides", list), ("edits", dict)):
            if not isinstance(args.get(key, kind()), kind):
                raise ValueError(f"{key}: expected a {kind.__name__}, got {args[key]!r:.80}; send what the page makes")
        with self._lock:
            try:
                return self._calls[name](args, attached)
            except (KeyError, AttributeError) as error:
                raise ValueError(
                    f"args: expected those of {name!r}, got {args!r:.80} ({error}); send what the page makes"
                ) from None

    def _ask(self, args: dict[str, Any], _: bytes) -> Answer:
        words = args["words"]
        if not isinstance(words, str) or not words.strip():
            raise ValueError(f"words: expected text, got {words!r:.80}; ask for a class or a phrase")
        asked = self.state.meaning.ask(words)
        packed = list(dict.fromkeys(self.state.meaning.names))  # classes of one name are one question
        number = packed.index(asked.words) if asked.words in packed else None
        return _answer(asked, number)

    def _similar(self, _: dict[str, Any], attached: bytes) -> Answer:
        (mask,) = self._masks({"semantic": len(self.state.cloud("semantic"))}, attached).values()
        return _answer(self.state.meaning.similar(mask), None)

    def _describe(self, args: dict[str, Any], _: bytes) -> Answer:
        picked = self.state.pick(args["side"], args["index"])
        return {"views": [{"index": one.index, "name": one.name, "weight": one.weight} for one in picked.views]}, b""

    def _parts(self, args: dict[str, Any], attached: bytes) -> Answer:
        side = _side(args["side"])
        cloud = self._edited(side, args).gaussians
        (mask,) = self._masks({side: len(cloud)}, attached).values()
        found = connected_parts(cloud, Selection.of(mask, "in the viewer"), most=MOST_PARTS)
        numbers = np.full(len(mask), -1, "<i2")
        for number, part in enumerate(found):
            numbers[part.indices.cpu().numpy()] = number
        parts = [{"count": one.count, "volume": one.volume, "corners": one.box.corners.tolist()} for one in found]
        return {"parts": parts}, numbers.tobytes()

    def _save_selection(self, args: dict[str, Any], attached: bytes) -> Answer:
        state = self.state
        state.ask(args.get("words"))
        if state.asked is not None and args.get("gamma") is not None:
            state.set_gamma(args["gamma"])
        if args.get("lambda") is not None:
            state.set_distance(args["lambda"])
        edited = {side: self._edited(side, args) for side in map(_side, args["sides"])}
        masks = self._masks({side: len(splats.gaussians) for side, splats in edited.items()}, attached)
        sides = {side: _selected(edited[side], mask, state.gamma) for side, mask in masks.items() if bool(mask.any())}
        if not sides:
            raise ValueError("selection: expected at least one Gaussian, got none; select some first")
        details = state.details()
        for side, mask in masks.items():
            details[side]["selected"] = int(mask.sum())
        with numbered_path(self.out, "selection") as folder:
            return _wrote(save_sides(sides, details, state.meaning.names, state.cameras, folder))

    def _save_edits(self, args: dict[str, Any], _: bytes) -> Answer:
        made = {_side(side): edits for side in args["edits"] if len(edits := _edit_list(args, side))}
        if not made:
            raise ValueError("edits: expected at least one, got none; remove or recolour something first")
        if args.get("lambda") is not None:
            self.state.set_distance(args["lambda"])
        results = {side: edits.apply(self._splats(side)) for side, edits in made.items()}
        paths = []
        with numbered_path(self.out, "edited") as folder:
            for side, edits in made.items():
                paths += [edits.save(folder / f"{side}.json"), folder / f"{side}.ply"]
                write_splats(paths[-1], results[side].replace(extra={}))
        return _wrote(paths)

    def _splats(self, side: Side) -> SplatFile:
        """A side with its labels and scores at the present lambda."""
        cloud = self.state.cloud(side).replace(labels=torch.from_numpy(self.state.labels(side)))
        scores = self.state.scores(side).astype(np.float32)
        return SplatFile(cloud.detach().to("cpu"), {SCORE: scores}, tuple(self.state.meaning.names))

    def _edited(self, side: Side, args: dict[str, Any]) -> SplatFile:
        """A side with what was done to it, but nothing removed: masks are of these Gaussians."""
        kept = tuple(edit for edit in _edit_list(args, side) if edit.op != "remove")
        return EditList(kept).apply(self._splats(side))

    def _masks(self, counts: dict[Side, int], attached: bytes) -> dict[Side, Tensor]:
        masks: dict[Side, Tensor] = {}
        begin = 0
        for side, count in counts.items():
            own = np.frombuffer(attached[begin : begin + -(-count // 8)], np.uint8)
            begin += -(-count // 8)
            if len(own) < -(-count // 8):
                raise ValueError(
                    f"attached: expected {-(-count // 8)} bytes for {side!r}, got {len(own)}; load the page again"
                )
            masks[side] = torch.from_numpy(np.unpackbits(own, bitorder="little")[:count].astype(bool))
        return masks


def _answer(asked: Asked, number: int | None) -> Answer:
    known = asked.selection
    scores = torch.where(asked.valid, known.scores, torch.nan).cpu().numpy().astype("<f4")
    answer = {"words": asked.words, "number": number, "gamma": known.threshold, "how": known.how}
    return answer | {"low": asked.low, "high": asked.high}, scores.tobytes()


def _side(name: str) -> Side:
    check_choice("side", name, get_args(Side))
    return name  # type: ignore[return-value]


def _edit_list(args: dict[str, Any], side: str) -> EditList:
    """The edits of one side, as the viewer sends them."""
    given = args.get("edits", {}).get(_side(side), [])
    for edit in given:
        check_choice("edits: op", edit["op"], EDITS)
        check_choice("edits: where", edit["where"]["kind"], ("index",))
    return EditList.from_json({"format": FORMAT, "version": VERSION, "edits": given}, "edits")


def _selected(splats: SplatFile, mask: Tensor, gamma: float | None) -> SelectedSide:
    cloud, scores = splats.gaussians, torch.from_numpy(splats.extra[SCORE])
    assert cloud.labels is not None
    known = Selection(mask, torch.nan_to_num(scores), gamma, "in the viewer")
    return SelectedSide(cloud, known, cloud.labels, scores)


def _wrote(paths: list[Path]) -> Answer:
    return {"paths": [str(path) for path in paths]}, b""
