"""What a person sees and changes in the widget, as values that Python reads, sets and observes (traitlets)."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from traitlets import Any as Anything
from traitlets import Float, HasTraits, Unicode, observe, validate

from .._check import check_choice, check_whole, class_indices
from ..cameras import Camera
from ..gaussians import Gaussians
from ..labels import EditList, Selection
from ..labels.edit_list import read_edits
from ..labels.edits import Edit
from ..labels.selection import as_selection
from .pack import pack_camera
from .session import EDITS, labelled
from .state import Exploration, Picked, Side

USUAL = ("scale", 1), ("mode", "tint")  # of edits that the browser does
NAMES = ("question", "gamma", "distance", "hidden", "side", "selection", "edits", "picked", "camera")


class Shared(HasTraits):
    """The values, and `wire`: the same as the browser knows it, in the form of `Model.toJSON` (model.js), with the view.

    What is set here changes the wire, and the other way round; what is set before a browser shows the scene waits for it.
    """

    question = Unicode(None, allow_none=True)
    """What is searched for, a class or a phrase; None: nothing."""
    gamma = Float(None, allow_none=True)
    """The score that a selected Gaussian exceeds; None without a question. None sets what the question suggests."""
    distance = Float(1.0)
    """Lambda, world units: colour Gaussians closer than this to a semantic one take its label."""
    hidden = Anything(())
    """Names of the classes that are not drawn; "no class" is one of them."""
    side = Unicode()
    """The cloud that is shown, and that `selection` and `edits` are of: "semantic" or "color"."""
    selection = Anything()
    """A `Selection` of the Gaussians as they were given, without those that an edit removed. A class name, a
    rule like `InBox`, a mask [N] or None can be set, too; of another length than the cloud shown, it is of the other one, which
    is shown then."""
    edits = Anything(EditList())
    """The `EditList` of the cloud that is shown: `viewer.edits.apply(splat)`."""
    picked = Anything(None)
    """The picked Gaussian (`side, index, name, score, position`), or None. Its index can be set."""
    camera = Anything(None)
    """The `Camera` that the picture is seen through. The name of a camera of the scene can be set."""

    def __init__(self, state: Exploration) -> None:
        super().__init__()
        self.state = state
        sides: dict[str, Any] = {
            side: {"count": len(state.cloud(side)), "selected": None, "edits": []} for side in state.sides[::-1]
        }
        self.wire: dict[str, Any] = {
            "format": "kfgs.view", "version": 1, "words": state.asked and state.asked.words, "gamma": state.gamma,
            "lambda": state.distance if "color" in sides else None, "hidden": [], "side": state.sides[-1], "picked": None,
            "sides": sides, "view": {},
        }  # fmt: skip
        self._refresh(NAMES)

    def hear(self, told: dict[str, Any]) -> None:
        """Take over what a person changed: parts of the wire."""
        state, wire = self.state, self.wire | told
        if wire["lambda"] is not None and np.float32(wire["lambda"]) != np.float32(state.distance):
            state.set_distance(wire["lambda"])
        if wire["words"] != (state.asked and state.asked.words):
            state.ask(wire["words"])
        if state.asked is not None and wire["gamma"] not in (None, state.gamma):
            state.set_gamma(wire["gamma"])
        # JavaScript rounds lambda to float32, and has a gamma without words after "like the selection"
        self.wire = wire | {"lambda": wire["lambda"] and state.distance, "gamma": state.gamma}
        self._refresh(("camera",) if told.keys() == {"view"} else NAMES)

    def tell(self) -> None:
        """Show the wire in the browser, if there is one."""

    @validate(*NAMES)
    def _checked(self, proposal: Any) -> Any:
        """What is set, in the form in which it is read; an error if it cannot be set."""
        name, value, state = proposal["trait"].name, proposal["value"], self.state
        if name == "question" and value != self.wire["words"]:
            return state.meaning.ask(value).words if value and value.strip() else None
        if name == "gamma" and value != state.gamma:
            state.set_gamma(value)
            return state.gamma
        if name == "distance" and value != state.distance:
            state.set_distance(value)
        if name == "side":
            check_choice("side", value, state.sides)
        if name == "hidden":
            names = [value] if isinstance(value, str) else list(value or ())
            return tuple(state.class_name(label) for word in names for label in self._labels(word)[:1])
        if name == "camera" and not isinstance(value, Camera | None):
            check_choice("camera", value, known := {camera.name: camera for camera in state.cameras})
            return known[value]
        if name == "picked" and not isinstance(value, Picked | None):
            check_whole("picked", value, 0, len(state.cloud(self.side)) - 1)
            return state.describe(self.side, value)
        if name == "edits" and not isinstance(value, EditList):
            return EditList(value or ())
        if name == "selection":
            return as_selection(value, labelled(state, self.side))
        return value

    @observe(*NAMES)
    def _changed(self, change: Any) -> None:
        """Write a value that somebody set into the wire; those that the browser changed are there already."""
        name, value = change["name"], change["new"]
        if _same(value, self._read(name)):
            return
        try:
            self.wire = self.wire | self._written(name, value)
        finally:  # if it is refused, the value of before comes back
            self._refresh(NAMES)
        self.tell()

    def _written(self, name: str, value: Any) -> dict[str, Any]:
        """The parts of the wire that say a value."""
        wire, state = self.wire, self.state
        no_hand = {side: own | {"selected": None} for side, own in wire["sides"].items()}
        if name == "question":
            state.ask(value)
        if name == "gamma" and value is None and state.asked is not None:
            state.ask(state.asked.words)
        if name in ("question", "gamma"):
            return {"words": state.asked and state.asked.words, "gamma": state.gamma, "sides": no_hand}
        if name == "selection":
            if value is None or not len(value):
                state.ask(None)
                return {"words": None, "gamma": None, "sides": no_hand}
            side = next((side for side in (self.side, *no_hand) if len(value.mask) == no_hand[side]["count"]), None)
            if side is None:
                counts = " or ".join(str(own["count"]) for own in no_hand.values())
                raise ValueError(
                    f"selection: expected a mask of {counts} Gaussians, got {len(value.mask)}; select in this scene"
                )
            bits = base64.b64encode(np.packbits(value.mask.cpu().numpy(), bitorder="little").tobytes()).decode()
            return {"side": side, "sides": no_hand | {side: no_hand[side] | {"selected": bits}}}
        if name == "edits":
            own = wire["sides"][self.side] | {"edits": _numbered(value or (), labelled(state, self.side))}
            return {"sides": wire["sides"] | {self.side: own}}
        if name == "hidden":
            return {"hidden": sorted({label for word in value or () for label in self._labels(word)})}
        if name == "picked":
            return {"picked": value and {"side": value.side, "index": value.index}}
        if name == "camera":
            return {"view": pack_camera(value.with_origin(state.cloud("semantic").origin)) if value else {}}
        return {"lambda" if name == "distance" else name: value}

    def _refresh(self, names: Iterable[str]) -> None:
        """Give values what the wire says."""
        with self.hold_trait_notifications():
            for name in names:
                value = self._read(name)
                if not _same(getattr(self, name), value):
                    self.set_trait(name, value)

    def _read(self, name: str) -> Any:
        state, wire = self.state, self.wire
        own = wire["sides"][wire["side"]]
        if name == "distance":
            return wire["lambda"] or state.distance
        if name == "hidden":
            return tuple(state.class_name(label) for label in wire["hidden"])
        if name == "edits":
            return EditList(read_edits(own["edits"]))
        if name == "selection":
            return self._selection(wire["side"], own)
        if name == "picked":
            at = wire["picked"]  # what is known of a copy is known in the browser only
            return at and (state.describe(**at) if at["index"] < wire["sides"][at["side"]]["count"] else None)
        if name == "camera":
            if not wire["view"]:
                return state.cameras[0] if state.cameras else None
            (fx, fy, cx, cy), view = wire["view"]["K"], wire["view"]
            K, viewmat = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], np.reshape(view["viewmat"], (4, 4))
            rest = {part: view[part] for part in ("width", "height", "name", "near")}
            return Camera(
                torch.from_numpy(viewmat), torch.tensor(K).double(), **rest, origin=state.cloud("semantic").origin
            )
        return wire["words" if name == "question" else name]

    def _selection(self, side: Side, own: dict[str, Any]) -> Selection:
        state, asked = self.state, self.state.asked
        if any(other["selected"] is not None for other in self.wire["sides"].values()):
            bits = np.frombuffer(base64.b64decode(own["selected"] or b""), np.uint8)
            mask = np.unpackbits(bits, count=own["count"], bitorder="little").astype(bool)
            made = Selection.of(mask, "by hand")
        elif asked is None:
            return Selection.of(torch.zeros(own["count"], dtype=torch.bool), "nothing")
        else:
            mask, scores = state.selected(side), np.nan_to_num(state.scores(side))
            made = Selection(torch.from_numpy(mask), torch.from_numpy(scores).float(), state.gamma, state.gamma_how)
        removed = [i for edit in own["edits"] if edit["op"] == "remove" for i in edit["where"]["indices"]]
        made.mask[[i for i in removed if i < own["count"]]] = False
        return made

    def _labels(self, name: str) -> tuple[int, ...]:
        """The labels of a class; -1 for "no class"."""
        return (-1,) if name == self.state.class_name(-1) else class_indices(name, self.state.meaning.names)


def _numbered(edits: Iterable[Edit], cloud: Gaussians) -> list[dict[str, Any]]:
    """Edits as the browser does them: by index, where a Gaussian keeps its number when others are removed; removals last."""
    numbers, total = torch.arange(len(cloud)), len(cloud)
    made: list[dict[str, Any]] = []
    gone: list[int] = []
    for place, edit in enumerate(edits):
        plain = {key: part for key, part in edit.to_json().items() if key != "pivot"}
        if edit.op not in EDITS or "rotation" in plain or any(plain.get(key, usual) != usual for key, usual in USUAL):
            raise ValueError(
                f"edits[{place}]: expected {', '.join(EDITS)} (without rotation, scale and mode 'hue'), got {edit!r:.80}; "
                "apply it to the Gaussians, and explore the result"
            )
        mask = torch.stack([rule.select(cloud).mask for rule in edit.where]).any(dim=0)  # type: ignore[attr-defined]
        rows = numbers[mask].tolist()
        cloud = edit.apply(cloud)
        if edit.op == "remove":
            gone += rows
            numbers = numbers[~mask]
        else:
            made.append(plain | {"where": {"kind": "index", "indices": rows}})
        if edit.op == "duplicate":
            numbers = torch.cat([numbers, torch.arange(total, total + len(rows))])
            total += len(rows)
    return made + ([{"op": "remove", "where": {"kind": "index", "indices": sorted(gone)}}] if gone else [])


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, Selection) and isinstance(b, Selection):
        return a.threshold == b.threshold and torch.equal(a.mask, b.mask)
    if isinstance(a, Camera) and isinstance(b, Camera):
        return pack_camera(a) == pack_camera(b)
    if isinstance(a, Picked) and isinstance(b, Picked):
        return repr(a) == repr(b)  # an unknown score is NaN
    return type(a) is type(b) and bool(a == b)
