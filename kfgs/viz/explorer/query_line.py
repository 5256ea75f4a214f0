"""The text line for questions: turns key presses into text, with completion. Knows no window."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

Verdict = Literal["ask", "drop", "typing"]
LONGEST = 200  # characters


class QueryLine:
    """The typed text and its completion. Keys have X and VTK names ("keysyms")."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.text = ""
        self._stem: str | None = None  # the text before the first of several Tabs
        self._turn = 0

    @property
    def hint(self) -> str:
        """The text that Tab would add; "" if no class begins like this."""
        found = self._matches(self.text)
        return found[0][len(self.text) :] if self.text and found else ""

    def press(self, key: str, character: str) -> Verdict:
        """Handle a key; returns whether to ask the question, drop it, or go on typing.

        Args:
            key: its name, for instance "Return" or "a".
            character: the character it types; may be "" or a control character.
        """
        if key in ("Return", "KP_Enter"):
            return "ask"
        if key == "Escape":
            return "drop"
        if key in ("Tab", "ISO_Left_Tab"):
            self._complete(-1 if key == "ISO_Left_Tab" else 1)
            return "typing"
        self._stem = None
        if key == "BackSpace":
            self.text = self.text[:-1]
        elif character.isprintable() and character and len(self.text) < LONGEST:
            self.text += character
        return "typing"

    def _complete(self, step: int) -> None:
        """Go to the next class that begins with the typed text; after the last, to the first."""
        if self._stem is None:
            self._stem, self._turn = self.text, -1 if step > 0 else 0
        found = self._matches(self._stem)
        if found:
            self._turn = (self._turn + step) % len(found)
            self.text = found[self._turn]

    def _matches(self, stem: str) -> list[str]:
        return [name for name in self.names if name.casefold().startswith(stem.casefold())]
