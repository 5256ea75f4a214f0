import builtins
import importlib
import inspect
import pkgutil
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from cases_quant import made_autoencoder
from torch import Tensor

import kfgs
from kfgs import Camera, Gaussians, SemanticField, rasterize
from kfgs._card import LONGEST, html_card, short_repr, short_value
from kfgs.fields import Autoencoded, Identity
from kfgs.labels import EditList, LabelSet, Remove, Selection
from kfgs.quant import Codebook, LinearLatents
from kfgs.quant.codebook import CodebookReport, Nearest
from kfgs.splat.engines.contract import Cloud, Composited, Pinhole, Splats


def test_a_card_escapes_everything_and_leaves_out_what_is_none():
    card = html_card("<b>Scene</b>", {"<i>name": "a & <script>", "points": 12345, "missing": None})
    assert "<script>" not in card
    assert "<i>" not in card
    assert "<b>" not in card
    assert "a &amp; &lt;script&gt;" in card
    assert "12,345" in card
    assert "missing" not in card
    assert card.count("<tr>") == 2


def test_a_card_cuts_long_values():
    assert len(html_card("x", {"words": "word " * 10_000})) < 600


def test_a_line_shows_tensors_by_shape_and_type():
    @dataclass
    class Thing:
        rows: Tensor
        names: tuple[str, ...]
        hidden: int = field(default=3, repr=False)
        nothing: float | None = None

        __repr__ = short_repr

    assert repr(Thing(torch.zeros(4, 2), ("a", "b"))) == "Thing(rows=[4, 2] float32, names=('a', 'b'))"
    assert repr(Thing(torch.zeros(0, 2, dtype=torch.float64), ("a",) * 9)).endswith("[0, 2] float64, names=9 of str)")


def test_a_line_of_a_named_tuple():
    class Pair(NamedTuple):
        left: np.ndarray
        right: object

        def __repr__(self) -> str:
            return short_repr(self)

    inner = Pair(np.zeros(2), 1)
    assert repr(Pair(np.zeros((3, 1), dtype=np.int64), inner)) == (
        "Pair(left=[3, 1] int64, right=Pair(left=[2] float64, right=1))"
    )


def test_no_value_is_long():
    for value in ("x\n" * 1000, {str(i): i for i in range(9)}, [torch.zeros(3)] * 5, {"a": "b" * 500}, [], {}):
        shown = short_value(value)
        assert len(shown) <= LONGEST
        assert "\n" not in shown


def test_paths_and_rows_say_what_they_are():
    assert short_value([Path("/a/room.ply"), Path("/a/b.json")]) == "[room.ply, b.json]"
    assert short_value([{"step": 1, "loss": 2.0}] * 3) == "3 of dict"
    assert short_value(["word " * 40] * 2).endswith(" word...")


def test_long_content_makes_no_long_line():
    long = "a long name " * 40
    splats = Gaussians(torch.rand(50, 3), torch.rand(50, 4), torch.rand(50, 3), torch.rand(50))
    engine = [
        Cloud(torch.rand(50, 3), torch.rand(50, 4), torch.rand(50, 3), torch.rand(50)),
        Pinhole(torch.eye(4), torch.eye(3), 4, 3, 0.2, 0.3),
        Splats(torch.rand(50, 2), torch.rand(50, 3), torch.rand(50), torch.rand(50, 9), torch.rand(9), None),
        Composited(torch.rand(9, 9, 9), torch.rand(9, 9), torch.zeros(900, dtype=torch.int32)),
    ]
    for thing in (
        *engine,
        LabelSet((long, long + "2"), torch.eye(2)),
        Camera(torch.eye(4), torch.eye(3), 4, 3, name=long + "\n"),
        splats.replace(names=(long,), extra={long: np.zeros(50)}),
        EditList([Remove("chair")] * 300),
        Selection.of(torch.tensor([True, False]), f"two\nlines {long}"),
    ):
        line = repr(thing)
        assert line.startswith(type(thing).__name__)
        assert len(line) < 200, line
        assert "\n" not in line
        assert "tensor(" not in line
    assert repr(EditList([Remove("chair")] * 300)).startswith("EditList(300 edits: Remove(")
    assert repr(EditList([Remove("chair")]).undo()) == "EditList(0 edits: )"


PACKAGES = ["kfgs.quant", "kfgs.fields", "kfgs.splat", "kfgs.viz", "kfgs.gaussians", "kfgs.metrics"]


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_class_with_tensors_has_a_line_of_its_own(package):
    """The generated lines of dataclasses and named tuples print thousands of numbers."""
    module = importlib.import_module(package)
    for name in getattr(module, "__all__", vars(module)):
        kind = getattr(module, name)
        if isinstance(kind, type) and any(
            "Tensor" in str(one) for one in vars(kind).get("__annotations__", {}).values()
        ):
            from_namedtuple = kind.__repr__.__module__ == "collections"
            from_dataclass = hasattr(kind.__repr__, "__wrapped__")
            assert not from_namedtuple, name
            assert not from_dataclass, name


def test_lines_stay_short_and_cards_are_tables():
    book = Codebook(torch.rand(300, 512))
    widths = [(512, 64), (64, 9), (9, 64), (64, 512)]
    layers = [(torch.rand(out, width), torch.rand(out)) for width, out in widths]
    autoencoder = made_autoencoder(tuple(layers[:2]), tuple(layers[2:]), 0.0, 1.0)
    cloud = Gaussians(torch.rand(50, 3), torch.rand(50, 4), torch.rand(50, 3), torch.rand(50), torch.rand(50, 9))
    field = SemanticField(cloud, Autoencoded(book, autoencoder), info={"teacher": {"name": "<lseg>"}})
    viewmat = torch.eye(4)
    viewmat[2, 3] = 3.0
    camera = Camera(viewmat, torch.tensor([[30.0, 0, 15], [0, 30, 10], [0, 0, 1]]), 30, 20)
    rendering = rasterize(cloud, camera, engine="reference")
    results = [
        Nearest(torch.rand(900), torch.rand(900)),
        CodebookReport([{"a": 1.0}] * 99, torch.rand(9), 1, 1, 1, None),
    ]
    for thing in (
        book,
        autoencoder,
        field,
        rendering,
        rendering.projected,
        cloud,
        LinearLatents(torch.eye(9)),
        *results,
    ):
        assert len(repr(thing)) < 200
        assert "tensor(" not in repr(thing)
        assert "\n" not in repr(thing)
    assert repr(autoencoder) == "Autoencoder(512 channels to 9 latents and back, widths [512, 64, 9, 64, 512])"
    for card, facts in (
        (field._repr_html_(), ("&lt;lseg&gt;", "decouple+ADC+SC", " for 512 of the teacher")),
        (book._repr_html_(), (">300<", "[300, 512] float32")),
        (rendering._repr_html_(), ("30 x 20", "9")),
    ):
        assert card.startswith("<table>")
        assert all(fact in card for fact in facts)
        assert len(card) < 2_000


class Anything(type):
    """What stands for names that are imported for type checkers alone: it has every attribute."""

    def __getattr__(cls, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return cls


class Nothing(metaclass=Anything):
    pass


class Names(dict):
    """The names that the annotations of a module are read with."""

    def __missing__(self, name):
        return getattr(builtins, name, Nothing)


BOX = kfgs.labels.OrientedBox(torch.zeros(3), torch.eye(3), torch.ones(3))
FLAT = torch.ones(40, 3)
KNOWN = {
    SemanticField: SemanticField(Gaussians(FLAT, torch.ones(40, 4), FLAT, FLAT[:, 0] / 2, FLAT), Identity(3)),
    Camera: Camera(torch.eye(4), torch.eye(3), 4, 3, name="view.png"),
    kfgs.cameras.Similarity: kfgs.cameras.Similarity.identity(),
    kfgs.labels.Part: kfgs.labels.Part(torch.arange(40), 1.0, torch.ones(3), BOX, (torch.ones(3),) * 2, None, "name"),
    str: "name",
    Path: Path("/a/folder/name"),
}


def field_names(kind):
    return [one.name for one in fields(kind)] if is_dataclass(kind) else list(getattr(kind, "_fields", ()))


def made_up(kind):
    """A value of an annotated type. Tensors and arrays have 120 numbers; objects are not checked, but filled in."""
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if kind in KNOWN:
        return KNOWN[kind]
    if Tensor in (kind, origin) or np.ndarray in (kind, origin):
        return torch.rand(40, 3) if kind is Tensor else np.random.default_rng(0).random((40, 3))
    if origin in (typing.Annotated, typing.Union, types.UnionType):
        return made_up(Tensor if Tensor in inside else inside[0])
    if origin is typing.Literal:
        return inside[0]
    if origin is tuple:
        return tuple(made_up(one) for one in (inside[:1] * 3 if inside[-1] is Ellipsis else inside))
    if inspect.isclass(origin) and issubclass(origin, Mapping):
        return {f"name {i}": made_up(inside[1]) for i in range(3)}
    if inspect.isclass(origin) and issubclass(origin, Sequence):
        return [made_up(inside[0])] * 3
    if kind in (int, float, bool):
        return kind(1)
    return filled(kind) if inspect.isclass(kind) and kind.__module__.startswith("kfgs") and field_names(kind) else None


def filled(kind):
    hints = typing.get_type_hints(kind, {}, Names(vars(importlib.import_module(kind.__module__))))
    values = {
        name: None if kind in typing.get_args(hints[name]) else made_up(hints[name]) for name in field_names(kind)
    }
    if hasattr(kind, "_make"):
        return kind._make(values.values())
    thing = object.__new__(kind)
    for name, value in values.items():
        object.__setattr__(thing, name, value)
    return thing


def holds_numbers(value):
    """Whether a tensor or an array lies in it, at any depth."""
    if isinstance(value, Mapping):
        return any(map(holds_numbers, value.values()))
    if isinstance(value, list | tuple):
        return any(map(holds_numbers, value))
    inside = is_dataclass(value) and any(holds_numbers(getattr(value, name)) for name in field_names(value))
    return inside or isinstance(value, Tensor | np.ndarray)


def kinds():
    """The public dataclasses and named tuples, without options, which show all that was chosen."""
    for package in pkgutil.iter_modules(kfgs.__path__, "kfgs."):
        names = getattr(importlib.import_module(package.name), "__all__", ()) if package.ispkg else ()
        for kind in (getattr(importlib.import_module(package.name), name) for name in names):
            own = inspect.isclass(kind) and kind.__module__.startswith("kfgs") and not inspect.isabstract(kind)
            if own and field_names(kind) and kind.__name__ not in ("Uplift", "BatchOptions"):
                yield kind


def test_every_object_with_tensors_shows_itself_in_a_short_line():
    seen, long = 0, []
    for kind in kinds():
        thing = KNOWN.get(kind) or filled(kind)
        if holds_numbers(thing):
            seen += 1
            line = repr(thing)
            if len(line) >= 200 or "\n" in line:
                long.append(f"{kind.__module__}.{kind.__name__}: {line[:80]}")
    assert seen > 25
    assert long == [], "\n".join(long)
