"""What a page or a notebook widget asks of Python: answers to texts, connected parts, and files.

The viewer keeps its own state in the browser, so several pages do not disturb each other. Masks travel as bits, one for each
Gaussian of a side, the lowest bit first.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from itertools import count
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._check import check_choice
from .._files import as_path, write_json
from ..formats import write_splats
from ..gaussians import Gaussians
from ..labels import EditList, Selection, connected_parts
from ..labels.edit_list import read_edits
from ..viz.linked import evenly
from .state import Exploration, Side

Answer = tuple[dict[str, Any], bytes]
EDITS = ("recolor", "opacity", "move", "duplicate", "remove")
"""What the viewer can do to a cloud. `Insert` is not among them: it would read files of this machine for who has the link."""
CALLS = ("ask", "similar", "parts", "save_selection", "save_edits")
MOST_PARTS = 16  # parts listed: as many as `connected_parts` renders in one pass of a view
MOST_VIEWS = 30  # views compared, evenly chosen: 0.2 s with 600,000 Gaussians


class Session:
    """Answers the viewer's calls; safe to call from several threads. Files get the next free number in the folder `out`.

    The question, gamma and lambda of the state become those of the last file that was saved.
    """

    def __init__(self, state: Exploration, out: str | Path = "kfgs_view") -> None:
        self.state, self.out = state, as_path(out)
        self._lock = Lock()

    def call(self, name: str, args: dict[str, Any], attached: bytes = b"") -> Answer:
        """Answer a call.

        - `ask` {words}: attaches the scores of the semantic Gaussians, float32, NaN where nothing is known
        - `similar` {}, with a mask of the semantic side: as `ask`, for what is like these Gaussians
        - `parts` {side, edits}, with a mask of it: connected parts, largest first; attaches the part of each Gaussian,
          int16, -1 for none
        - `save_selection` {words, gamma, lambda, sides, edits}, with a mask of each side
        - `save_edits` {lambda, edits}

        `edits` has a list for each side that was edited, in the form of `EditList.save`. Masks are of the cloud with its
        copies, before Gaussians are removed. A ValueError for an unknown call or wrong arguments.
        """
        check_choice("name", name, CALLS)
        with self._lock:
            try:
                return getattr(self, f"_{name}")(args, attached)  # type: ignore[no-any-return]
            except (KeyError, AttributeError, TypeError) as error:
                raise ValueError(
                    f"args: expected those of {name!r}, got {args!r:.80} ({error}); send what the page makes"
                ) from None

    def _ask(self, args: dict[str, Any], _: bytes) -> Answer:
        words = args["words"]
        if not isinstance(words, str) or not words.strip():
            raise ValueError(f"words: expected text, got {words!r:.80}; ask for a class or a phrase")
        return self.state.meaning.ask(words).packed()

    def _similar(self, _: dict[str, Any], attached: bytes) -> Answer:
        (mask,) = _masks({"semantic": len(self.state.cloud("semantic"))}, attached).values()
        return self.state.meaning.similar(mask).packed()

    def _parts(self, args: dict[str, Any], attached: bytes) -> Answer:
        side = args["side"]
        cloud = self._edited(side, args)
        (mask,) = _masks({side: len(cloud)}, attached).values()
        parts = connected_parts(cloud, Selection.of(mask, "in the viewer"), most=MOST_PARTS)
        numbers = np.full(len(mask), -1, "<i2")
        for number, part in enumerate(parts):
            numbers[part.indices.cpu().numpy()] = number
        shown = [{"count": part.count, "corners": part.box.corners.tolist()} for part in parts]
        return {"parts": shown}, numbers.tobytes()

    def _save_selection(self, args: dict[str, Any], attached: bytes) -> Answer:
        state = self.state
        state.ask(args.get("words"))
        if state.asked is not None and args.get("gamma") is not None:
            state.set_gamma(args["gamma"])
        if args.get("lambda") is not None:
            state.set_distance(args["lambda"])
        edited = {side: self._edited(side, args) for side in args["sides"]}
        masks = _masks({side: len(splats) for side, splats in edited.items()}, attached)
        return {"paths": [str(path) for path in save_selection(state, edited, masks, self.out)]}, b""

    def _save_edits(self, args: dict[str, Any], _: bytes) -> Answer:
        made = {side: edits for side, given in args["edits"].items() if len(edits := edit_list(given))}
        if not made:
            raise ValueError("edits: expected at least one, got none; remove or recolour something first")
        if args.get("lambda") is not None:
            self.state.set_distance(args["lambda"])
        results = {side: edits.apply(labelled(self.state, side)) for side, edits in made.items()}
        folder, paths = next_folder(self.out, "edited"), []
        for side, edits in made.items():
            paths += [edits.save(folder / f"{side}.json"), folder / f"{side}.ply"]
            write_splats(results[side].replace(scores=None), paths[-1])
        return {"paths": [str(path) for path in paths]}, b""

    def _edited(self, side: Side, args: dict[str, Any]) -> Gaussians:
        """A side with what was done to it, but nothing removed: masks are of these Gaussians."""
        kept = tuple(edit for edit in edit_list(args.get("edits", {}).get(side, [])) if edit.op != "remove")
        return EditList(kept).apply(labelled(self.state, side))


def save_selection(
    state: Exploration, clouds: Mapping[Side, Gaussians], masks: Mapping[Side, Tensor], out: Path
) -> list[Path]:
    """Write a selection into the next numbered folder: numbers as selection.json, Gaussians as selection_<side>.ply.

    selection.json lists the connected parts (at most the 16 largest), each with the best of at most 30 evenly chosen views.
    A ValueError if nothing is selected on any side.
    """
    chosen = [side for side, mask in masks.items() if bool(mask.any())]
    if not chosen:
        raise ValueError("selection: expected at least one Gaussian, got none; ask or select first, or lower gamma")
    details = state.details() | {"parts": {}}
    for side, mask in masks.items():
        details[side]["selected"] = int(mask.sum())
    places = evenly(len(state.cameras), MOST_VIEWS).tolist()
    views = [state.cameras[place] for place in places] or None
    for side in chosen:
        scores = torch.nan_to_num(clouds[side].scores)  # type: ignore[arg-type]  # `labelled` gives them
        selection = Selection(masks[side], scores, state.gamma, state.gamma_how or "in the viewer")
        parts = [part.to_json() for part in connected_parts(clouds[side], selection, views, most=MOST_PARTS)]
        for part in parts:
            if part["best_view"] is not None:
                part["best_view"]["index"] = places[part["best_view"]["index"]]
        details["parts"][side] = parts
    folder = next_folder(out, "selection")
    write_json(folder / "selection.json", details)
    for side in chosen:
        splats = clouds[side].select(masks[side])
        unknown = splats.scores is None or bool(splats.scores.isnan().any())
        write_splats(splats.replace(scores=None) if unknown else splats, folder / f"selection_{side}.ply")
    return sorted(folder.iterdir())


def labelled(state: Exploration, side: Side) -> Gaussians:
    """A side with its labels and scores at the present lambda."""
    cloud = state.cloud(side).replace(labels=torch.from_numpy(state.labels(side)))
    scores = torch.from_numpy(state.scores(side).astype(np.float32))
    return cloud.detach().to("cpu").replace(scores=scores, names=tuple(state.meaning.names))


def next_folder(out: Path, stem: str) -> Path:
    """Make the first free folder `stem_001` in `out`."""
    for number in count(1):
        folder = out / f"{stem}_{number:03d}"
        with suppress(FileExistsError):
            folder.mkdir(parents=True)
            return folder
    raise AssertionError("there is always a next number")


def _masks(counts: dict[Side, int], attached: bytes) -> dict[Side, Tensor]:
    masks: dict[Side, Tensor] = {}
    for side, size in counts.items():
        length = -(-size // 8)
        own, attached = np.frombuffer(attached[:length], np.uint8), attached[length:]
        if len(own) < length:
            raise ValueError(f"attached: expected {length} bytes for {side!r}, got {len(own)}; load the page again")
        masks[side] = torch.from_numpy(np.unpackbits(own, bitorder="little")[:size].astype(bool))
    return masks


def edit_list(given: list[dict[str, Any]]) -> EditList:
    """Edits as the viewer sends them."""
    for edit in given:
        check_choice("edits: op", edit["op"], EDITS)
        check_choice("edits: where", edit["where"]["kind"], ("index",))
    return EditList(read_edits(given))
