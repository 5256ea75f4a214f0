import importlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch
from cases_quant import made_autoencoder
from torch import Tensor

from kfgs import Camera, Gaussians, SemanticField, rasterize
from kfgs._card import LONGEST, html_card, short_repr, short_value
from kfgs.fields import Autoencoded
from kfgs.labels import EditList, LabelSet, Remove, Selection
from kfgs.quant import Codebook, LinearLatents
from kfgs.quant.codebook import CodebookReport, Nearest


def test_a_card_escapes_everything_and_leaves_out_what_is_none():
    card = html_card("<b>Scene</b>", {"<i>name": "a & <script>", "points": 12345, "missing": None})
    assert "<script>" not in card
    assert "<i>" not in card
    assert "<b>" not in card
    assert "a &amp; &lt;script&gt;" in card
    assert "12,345" in card
    assert "missing" not in card
    assert card.count("<tr>") == 2
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
    for thing in (
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
    camera = Camera.look_at((0, -3, 0), (0, 0, 0), width=30, height=20)
    rendering = rasterize(cloud, camera, engine="reference")
    nearest = Nearest(torch.rand(900), torch.rand(900))
    report = CodebookReport([{"a": 1.0}] * 99, torch.rand(9), 1, 1)
    things = [book, autoencoder, field, rendering, rendering.projected, cloud, LinearLatents(torch.eye(9)), nearest]
    for thing in (*things, report):
        assert len(repr(thing)) < 200
        assert "tensor(" not in repr(thing)
        assert "\n" not in repr(thing)
    assert repr(autoencoder) == "Autoencoder(512 channels to 9 latents and back, widths [512, 64, 9, 64, 512])"
    for card, facts in (
        (field._repr_html_(), ("&lt;lseg&gt;", "decouple+ADC+SC", " for 512)")),
        (rendering._repr_html_(), ("30 x 20", "9")),
    ):
        assert card.startswith("<table>")
        assert all(fact in card for fact in facts)
        assert len(card) < 2_000
