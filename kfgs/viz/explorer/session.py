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

from ..._check import check_choice, check_whole
from ...formats import SplatFile, write_splats
from ...labels import EditList, Opacity, Recolor, Remove, Selection, connected_parts
from ...labels.where import OfIndex
from .numbered_files import numbered_path
from .picked import Side
from .saved import MOST_PARTS, SelectedSide, save_sides
from .state import Exploration, check_number

Answer = tuple[dict[str, Any], bytes]
PNG = b"\x89PNG\r\n\x1a\n"


class Session:
    """Answers the viewer's calls; safe to call from several threads.

    Args:
        state: the clouds and their answers. Its question, gamma and lambda become those of the last file that was saved.
        out: folder for saved files, which get the next free number.
    """

    def __init__(self, state: Exploration, out: str | Path = "kfgs_view") -> None:
        self.state, self.out = state, Path(out)
        self._lock = Lock()
        self._calls = {
            "ask": self._ask,
            "describe": self._describe,
            "parts": self._parts,
            "save_selection": self._save_selection,
            "save_edits": self._save_edits,
            "save_picture": self._save_picture,
        }

    def call(self, name: str, args: dict[str, Any], attached: bytes = b"") -> Answer:
        """Answer one call.

        Args:
            name: one of

                - `ask` {words}: attaches the scores of the semantic Gaussians, float32, NaN where nothing is known
                - `describe` {side, index}: neighbours and views
                - `parts` {side}, with a mask of it: connected parts, largest first; attaches the part of each Gaussian, int16,
                  -1 for none
                - `save_selection` {words, gamma, lambda, sides}, with a mask of each side
                - `save_edits` {lambda, sides: {side: {removed, recolored, opacity}}}: Gaussians by number
                - `save_picture` {}, with a PNG file
            args: its arguments.
            attached: bytes that belong to them.

        Raises:
            ValueError: for an unknown call or wrong arguments.
            TypeError: for arguments of another type.
        """
        check_choice("name", name, list(self._calls))
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
        known = asked.selection
        scores = torch.where(asked.valid, known.scores, torch.nan).cpu().numpy().astype("<f4")
        packed = list(dict.fromkeys(self.state.meaning.names))  # classes of one name are one question
        answer = {
            "words": asked.words,
            "number": packed.index(asked.words) if asked.words in packed else None,
            "gamma": known.threshold,
            "how": known.how,
            "low": asked.low,
            "high": asked.high,
        }
        return answer, scores.tobytes()

    def _describe(self, args: dict[str, Any], _: bytes) -> Answer:
        picked = self.state.pick(args["side"], args["index"])
        neighbours = [{"index": i, "distance": far} for i, far, _ in picked.neighbours]
        views = [{"index": sight.index, "name": sight.name, "weight": sight.weight} for sight in picked.views]
        return {"neighbours": neighbours, "views": views}, b""

    def _parts(self, args: dict[str, Any], attached: bytes) -> Answer:
        ((side, mask),) = self._masks([args["side"]], attached).items()
        found = connected_parts(self.state.cloud(side), Selection.of(mask, "in the viewer"), most=MOST_PARTS)
        numbers = np.full(len(mask), -1, "<i2")
        for number, part in enumerate(found):
            numbers[part.indices.cpu().numpy()] = number
        return {"parts": [{"count": part.count, "volume": part.volume} for part in found]}, numbers.tobytes()

    def _save_selection(self, args: dict[str, Any], attached: bytes) -> Answer:
        state = self.state
        state.ask(args.get("words"))
        if state.asked is not None and args.get("gamma") is not None:
            state.set_gamma(args["gamma"])
        if args.get("lambda") is not None:
            state.set_distance(args["lambda"])
        masks = self._masks(args["sides"], attached)
        sides = {
            side: SelectedSide(
                state.cloud(side),
                Selection(mask, torch.from_numpy(np.nan_to_num(state.scores(side))), state.gamma, "in the viewer"),
                torch.from_numpy(state.labels(side)),
                torch.from_numpy(state.scores(side)),
            )
            for side, mask in masks.items()
            if bool(mask.any())
        }
        if not sides:
            raise ValueError("selection: expected at least one Gaussian, got none; select some first")
        details = state.details()
        for side, mask in masks.items():
            details[side]["selected"] = int(mask.sum())
        with numbered_path(self.out, "selection") as folder:
            return _wrote(save_sides(sides, details, state.meaning.names, state.cameras, folder))

    def _save_edits(self, args: dict[str, Any], _: bytes) -> Answer:
        made = {side: _edit_list(found) for side, found in args["sides"].items()}
        made = {side: edits for side, edits in made.items() if len(edits)}
        if not made:
            raise ValueError("edits: expected at least one, got none; remove or recolour something first")
        if args.get("lambda") is not None:
            self.state.set_distance(args["lambda"])
        results = {side: edits.apply(self._splats(_side(side))) for side, edits in made.items()}
        paths = []
        with numbered_path(self.out, "edited") as folder:
            for side, edits in made.items():
                paths += [edits.save(folder / f"{side}.json"), folder / f"{side}.ply"]
                write_splats(paths[-1], results[side])
        return _wrote(paths)

    def _splats(self, side: Side) -> SplatFile:
        """A side with its labels at the present lambda."""
        cloud = self.state.cloud(side).replace(labels=torch.from_numpy(self.state.labels(side)))
        return SplatFile(cloud.detach().to("cpu"), {}, tuple(self.state.meaning.names))

    def _save_picture(self, _: dict[str, Any], attached: bytes) -> Answer:
        if not attached.startswith(PNG):
            raise ValueError(f"picture: expected a PNG file, got {len(attached)} other bytes; send what the page makes")
        with numbered_path(self.out, "picture", ".png") as path:
            path.write_bytes(attached)
            return _wrote([path])

    def _masks(self, sides: list[str], attached: bytes) -> dict[Side, Tensor]:
        masks: dict[Side, Tensor] = {}
        begin = 0
        for side in map(_side, sides):
            count = len(self.state.cloud(side))
            own = np.frombuffer(attached[begin : begin + -(-count // 8)], np.uint8)
            begin += -(-count // 8)
            if len(own) < -(-count // 8):
                raise ValueError(
                    f"attached: expected {-(-count // 8)} bytes for {side!r}, got {len(own)}; load the page again"
                )
            masks[side] = torch.from_numpy(np.unpackbits(own, bitorder="little")[:count].astype(bool))
        return masks


def _side(name: str) -> Side:
    check_choice("side", name, get_args(Side))
    return name  # type: ignore[return-value]


def _edit_list(found: dict[str, Any]) -> EditList:
    """The edits of one side, from the state of the viewer: colours and opacities first, so that numbers stay valid."""
    edits = EditList()
    for color, indices in found.get("recolored", {}).items():
        red, green, blue = (_part(part) for part in color.split(","))
        edits = edits.then(Recolor(OfIndex(tuple(indices)), (red, green, blue)))
    for factor, indices in found.get("opacity", {}).items():
        check_number("opacity", float(factor))
        edits = edits.then(Opacity(OfIndex(tuple(indices)), float(factor)))
    if found.get("removed"):
        edits = edits.then(Remove(OfIndex(tuple(found["removed"]))))
    return edits


def _part(text: str) -> float:
    check_whole("recolored", int(text), 0, 255)
    return int(text) / 255


def _wrote(paths: list[Path]) -> Answer:
    return {"paths": [str(path) for path in paths]}, b""
