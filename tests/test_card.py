import importlib
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
import torch
from cases_quant import made_autoencoder

from kfgs import Camera, Gaussians, SemanticField, rasterize
from kfgs._card import LINE, LONGEST, html_card, short_repr, short_value
from kfgs.fields import Autoencoded
from kfgs.labels import EditList, LabelSet, Remove, Selection
from kfgs.quant import Codebook, LinearLatents
from kfgs.quant.codebook import CodebookReport, Nearest


def test_no_value_and_no_line_is_long_and_none_is_left_out():
    for value in ("x\n" * 1000, {str(i): i for i in range(9)}, [torch.zeros(3)] * 5, {"a": "b" * 500}, [], {}):
        shown = short_value(value)
        assert len(shown) <= LONGEST
        assert "\n" not in shown
    assert short_value({str(i): i for i in range(9)}) == "9 entries"
    assert len(short_repr(namedtuple("Many", "a b c d e f g h")(*["word " * 50] * 8))) <= LINE
    assert "missing" not in html_card("x", {"missing": None})
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
