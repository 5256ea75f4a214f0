"""Names of pictures and views, as file systems and tools respell them."""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable
from functools import cached_property
from pathlib import PurePosixPath

_ENDING = re.compile(r"(?<=[^/])\.[A-Za-z][A-Za-z0-9]{1,4}$")  # .png, not the .5 of `shot.5`, which may be a stem


def file_stem(name: str) -> str:
    """A view's name without its suffix, folders kept. Feature and label files of the view carry this name.

    Example:
        >>> file_stem("rgb_5.png"), file_stem("train/r_0.png")
        ('rgb_5', 'train/r_0')
    """
    path = PurePosixPath(name)
    return str(path.with_suffix("")) if path.name else name  # "/" and "." have no suffix to take


def folded_name(name: str) -> str:
    r"""A name with slashes, composed letters (a Mac's zip has them in two parts) and no upper case.

    Example:
        >>> folded_name("left\\A.JPG"), folded_name("./Ku\u0308che.png") == folded_name("K\u00fcche.png")
        ('left/a.jpg', True)
    """
    plain = unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())
    return str(PurePosixPath(plain.replace("\\", "/")))


class Names:
    r"""Names of files or views, which may be asked for in other spellings. Every reader of names in kfgs uses this rule.

    A name is looked up as it is, then folded (`folded_name`), then without its ending, then without its first folders, and
    if `bare` without all of them. The first way that fits anything decides; if it fits several names, none is found.

    Example:
        >>> names = Names(["images/A.jpg", "images/b.png"])
        >>> names.find("images/a.JPG"), names.find(r"D:\room\images\b.tif"), names.find("c"), names.advice("image/b")
        ('images/A.jpg', 'images/b.png', None, "did you mean 'images/b.png'?")
    """

    def __init__(self, names: Iterable[str], *, bare: bool = False) -> None:
        self.names, self.bare = dict.fromkeys(names), bare

    def find(self, name: str) -> str | None:
        """The one of the names that is meant; None if there is none, or it is not clear which."""
        if name in self.names:
            return name
        stems, folded, folded_stems, bare = self._tables
        parts = folded_name(name).split("/")
        ways = [(stems, name)]
        for i in range(len(parts)):
            tail = "/".join(parts[i:])
            ways += [(folded, tail), (folded_stems, tail), (folded_stems, _ENDING.sub("", tail))]
        if self.bare and len(parts) == 1:
            ways += [(bare, parts[0]), (bare, _ENDING.sub("", parts[0]))]
        fits = next((table[word] for table, word in ways if word in table), [])
        return fits[0] if len(fits) == 1 else None

    def find_each(self, names: Iterable[str]) -> list[str | None]:
        """`find` for names of different things: what several of them find is only for one that is spelled so."""
        pairs = [(name, self.find(name)) for name in names]
        counts = Counter(fit for _, fit in pairs)
        return [
            fit if fit is None or counts[fit] == 1 or name in (fit, file_stem(fit)) else None for name, fit in pairs
        ]

    def advice(self, name: str) -> str:
        """What to say about a name that is not found: the nearest one."""
        keys = {folded_name(known): known for known in self.names}
        near = difflib.get_close_matches(folded_name(name), keys, n=1, cutoff=0)
        return f"did you mean {keys[near[0]]!r}?" if near else "there are no names to choose from"

    @cached_property
    def _tables(self) -> tuple[dict[str, list[str]], ...]:
        """The names by their stems, folded, by folded stems, and by folded names and stems without folders."""
        tables: tuple[dict[str, list[str]], ...] = ({}, {}, {}, {})
        for name in self.names:
            stem, plain = file_stem(name), folded_name(name)
            folded_stem = folded_name(stem)
            bare = {plain.rpartition("/")[2], folded_stem.rpartition("/")[2]}
            for table, words in zip(tables, ({stem}, {plain}, {folded_stem}, bare), strict=True):
                for word in words:
                    table.setdefault(word, []).append(name)
        return tables
