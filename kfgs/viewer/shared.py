"""What a person sees and changes in the widget, as values that Python reads, sets and observes (traitlets)."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from traitlets import HasTraits, TraitType

from .._check import ORIGIN, as_array, check_choice, check_shapes, check_whole, class_indices
from .._origin import recounted, to_world
from .._rows import check_finite
from ..cameras import Camera
from ..gaussians import Gaussians
from ..labels import EditList, Selection
from ..labels.edits import Edit
from ..labels.selection import as_selection
from .pack import pack_camera
from .session import EDITS, edit_list, labelled
from .state import Exploration, Picked, Side

USUAL = (("scale", 1), ("fill", False))  # of edits that the browser does
NAMES = ("question", "gamma", "distance", "hidden", "side", "selection", "edits", "picked", "tape", "camera")


class Value(TraitType[Any, Any]):
    """A trait that is set through the wire: what is read and observed is what the wire then says."""

    def set(self, obj: Shared, value: Any) -> None:  # type: ignore[override]
        """Set the value, unless it is the one that is read."""
        if not _same(value, getattr(obj, str(self.name))):
            obj.change(str(self.name), value)

    def show(self, obj: Shared, value: Any) -> None:
        """Give the trait what the wire says, and notify its observers."""
        super().set(obj, value)


class Shared(HasTraits):
    """The values, and `wire`: the same as the browser knows it, in the form of `Model.toJSON` (model.js), with the view.

    What is set here changes the wire, and the other way round; what is set before a browser shows the scene waits for it.
    """

    question = Value(None)
    """What is searched for, a class or a phrase; None: nothing."""
    gamma = Value(None)
    """The score that a selected Gaussian exceeds; None without a question. None sets what the question suggests."""
    distance = Value(None)
    """Lambda, world units: colour Gaussians closer than this to a semantic one take its label."""
    hidden = Value(None)
    """Names of the classes that are not drawn; "no class" is one of them."""
    side = Value(None)
    """The cloud that is shown, and that `selection` and `edits` are of: "semantic" or "color"."""
    selection = Value(None)
    """A `Selection` of the Gaussians as they were given, without those that an edit removed. A class name, a
    rule like `InBox`, a mask [N] or None can be set, too; of another length than the cloud shown, it is of the other one, which
    is shown then."""
    edits = Value(None)
    """The `EditList` of the cloud that is shown: `viewer.edits.apply(splat)`."""
    picked = Value(None)
    """The picked Gaussian (`side, index, name, score, position`), or None. Its index can be set."""
    tape = Value(None)
    """The two ends of the measuring tape, places in the world, or None: `math.dist(*viewer.tape)` is the length."""
    camera = Value(None)
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
            "tape": [], "sides": sides, "view": {},
        }  # fmt: skip
        self._show(self._values(NAMES))

    def hear(self, told: dict[str, Any]) -> None:
        """Take over what a person changed: parts of the wire. What cannot be read changes nothing, and is a ValueError."""
        state, before, kept, wire = self.state, self.wire, vars(self.state).copy(), self.wire | told
        try:
            if wire["lambda"] is not None and np.float32(wire["lambda"]) != np.float32(state.distance):
                state.set_distance(wire["lambda"])
            if wire["words"] != (state.asked and state.asked.words):
                state.ask(wire["words"])
            if state.asked is not None and wire["gamma"] not in (None, state.gamma):
                state.set_gamma(wire["gamma"])
            # JavaScript rounds lambda to float32, and has a gamma without words after "like the selection"
            self.wire = wire | {"lambda": wire["lambda"] and state.distance, "gamma": state.gamma}
            values = self._values(("camera",) if told.keys() == {"view"} else NAMES)
        except Exception as error:  # whatever an unknown form leads to
            self.wire = before
            vars(state).update(kept)
            self.tell()  # the browser shows again what holds
            raise ValueError(f"wire: expected what the viewer's script sends, got something else ({error})") from error
        self._show(values)

    def tell(self) -> None:
        """Show the wire in the browser, if there is one."""

    def change(self, name: str, value: Any) -> None:
        """Write a value that somebody set into the wire; an error if it cannot be set."""
        self.wire = self.wire | self._written(name, value)
        self._show(self._values(NAMES))
        self.tell()

    def _written(self, name: str, value: Any) -> dict[str, Any]:
        """The parts of the wire that say a value."""
        wire, state = self.wire, self.state
        no_hand = {side: own | {"selected": None} for side, own in wire["sides"].items()}
        if name == "question":
            if not isinstance(value, str | None):
                raise TypeError(f"question: expected words, got {value!r:.80}; ask for a class or a phrase")
            state.ask(value)
        if name == "gamma" and value is not None:
            state.set_gamma(value)
        elif name == "gamma" and state.asked is not None:
            state.ask(state.asked.words)
        if name in ("question", "gamma"):
            return {"words": state.asked and state.asked.words, "gamma": state.gamma, "sides": no_hand}
        if name == "distance":
            state.set_distance(value)
            return {"lambda": state.distance}
        if name == "side":
            check_choice("side", value, state.sides)
        if name == "selection":
            value = None if value is None else as_selection(value, labelled(state, self.side))
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
            edits = value if isinstance(value, EditList) else EditList(value or ())
            own = wire["sides"][self.side] | {"edits": _numbered(edits, labelled(state, self.side))}
            return {"sides": wire["sides"] | {self.side: own}}
        if name == "hidden":
            words = [value] if isinstance(value, str) else list(value or ())
            known = state.meaning.names
            labels = [(-1,) if word == state.class_name(-1) else class_indices(word, known) for word in words]
            return {"hidden": sorted({label for own in labels for label in own})}
        if name == "picked" and value is not None:
            side, index = (value.side, value.index) if isinstance(value, Picked) else (self.side, value)
            check_whole("picked", index, 0, len(state.cloud(side)) - 1)
            return {"picked": {"side": side, "index": int(index)}}
        if name == "tape":
            ends = torch.zeros(0, 3) if value is None else torch.from_numpy(as_array(value, "tape").astype(np.float64))
            check_shapes(("tape", ends, ("N" if value is None else 2, 3)))
            check_finite("tape", ends)
            return {"tape": recounted(ends, ORIGIN, state.cloud("semantic").origin).tolist()}
        if name == "camera":
            if not isinstance(value, Camera | None):
                check_choice("camera", value, cameras := {camera.name: camera for camera in state.cameras})
                value = cameras[value]
            return {"view": pack_camera(value.with_origin(state.cloud("semantic").origin)) if value else {}}
        return {name: value}

    def _values(self, names: Iterable[str]) -> dict[str, Any]:
        """What the wire says; an error if it cannot be read."""
        for side in self.state.sides:
            check_choice("count", self.wire["sides"][side]["count"], [len(self.state.cloud(side))])
            edit_list(self.wire["sides"][side]["edits"])
        return {name: self._read(name) for name in names}

    def _show(self, values: dict[str, Any]) -> None:
        with self.hold_trait_notifications():
            for name, value in values.items():
                if not _same(getattr(self, name), value):
                    self.traits()[name].show(self, value)

    def _read(self, name: str) -> Any:
        state, wire = self.state, self.wire
        own = wire["sides"][wire["side"]]
        if name == "distance":
            return wire["lambda"] or state.distance
        if name == "hidden":
            for label in wire["hidden"]:
                check_whole("hidden", label, -1, len(state.meaning.names) - 1)
            return tuple(state.class_name(label) for label in wire["hidden"])
        if name == "edits":
            return edit_list(own["edits"])
        if name == "selection":
            return self._selection(wire["side"], own)
        if name == "tape":
            ends = torch.tensor(wire["tape"], dtype=torch.float64).reshape(-1, 3)
            check_finite("tape", ends)
            world = to_world(ends, state.cloud("semantic").origin).tolist()
            return tuple(map(tuple, world)) if len(world) == 2 else None
        if name == "picked" and (at := wire["picked"]) is not None:
            check_whole("picked", at["index"], 0)
            known = at["index"] < wire["sides"][at["side"]]["count"]  # of a copy, the browser alone knows more
            return state.describe(at["side"], at["index"]) if known else None
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
            bits = np.frombuffer(base64.b64decode(own["selected"] or b"", validate=True), np.uint8)
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


def _numbered(edits: Iterable[Edit], cloud: Gaussians) -> list[dict[str, Any]]:
    """Edits as the browser does them: by index, where a Gaussian keeps its number when others are removed; removals last."""
    numbers, total = torch.arange(len(cloud)), len(cloud)
    made: list[dict[str, Any]] = []
    gone: list[int] = []
    for place, edit in enumerate(edits):
        plain = {key: part for key, part in edit.to_json().items() if key != "pivot"}
        if edit.op not in EDITS or "rotation" in plain or any(plain.get(key, usual) != usual for key, usual in USUAL):
            raise ValueError(
                f"edits[{place}]: expected {', '.join(EDITS)} (without rotation, scale and fill), got {edit!r:.80}; "
                "apply it to the Gaussians, and explore the result"
            )
        mask = as_selection(edit.where, cloud).mask  # type: ignore[attr-defined]
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
    same = type(a) is type(b) and bool(a == b)
    return same or (isinstance(a, Picked) and repr(a) == repr(b))  # an unknown score is NaN
