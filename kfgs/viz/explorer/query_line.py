"""A line of text that a question is typed into: no window, only keys and what they make of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

Verdict = Literal["ask", "drop", "typing"]
LONGEST = 200  # characters


class QueryLine:
    """What has been typed, and what Tab would make of it. Keys have the names that X and VTK give them ("keysyms")."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.text = ""
        self._stem: str | None = None  # what was typed before the first of several Tabs
        self._turn = 0

    @property
    def hint(self) -> str:
        """What Tab would add; "" where no class begins like this."""
        found = self._matches(self.text)
        return found[0][len(self.text) :] if self.text and found else ""

    def press(self, key: str, character: str) -> Verdict:
        """Take a key, and say whether the line is to be asked, dropped, or goes on.

        Args:
            key: its name, such as "Return" or "a".
            character: what it types, or "" or a control character.
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
        """The next class that begins with what was typed; after the last, the first again."""
        if self._stem is None:
            self._stem, self._turn = self.text, -1 if step > 0 else 0
        found = self._matches(self._stem)
        if found:
            self._turn = (self._turn + step) % len(found)
            self.text = found[self._turn]

    def _matches(self, stem: str) -> list[str]:
        return [name for name in self.names if name.casefold().startswith(stem.casefold())]
