from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kfgs._card import LONGEST, html_card, short_repr, short_value


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
