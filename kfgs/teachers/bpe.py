"""CLIP's byte-pair tokenizer, with the standard library only.

Text is cut into words, each word into the symbols of its UTF-8 bytes, and neighbouring symbols are merged in the order of a
ranked list of merges (Sennrich et al. 2016; byte symbols as in GPT-2). The 49,408 ids are 256 byte symbols, the same with
`</w>` at the end of a word, one per merge, `<|startoftext|>`, `<|endoftext|>`.
"""

from __future__ import annotations

import bz2
import gzip
import html
import re
import unicodedata
import zlib
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._files import as_path, parse_json

MERGES = 48_894  # CLIP uses so many of the 262,144 in OpenAI's file
_END = "</w>"
_SPECIAL = ("<|startoftext|>", "<|endoftext|>")
_FIXED = re.compile(r"<\|startoftext\|>|<\|endoftext\|>|'(?:s|t|re|ve|m|ll|d)", re.IGNORECASE)
_RUN = re.compile(r"L+|N|O+")  # on character kinds: runs of letters, single numbers, runs of others
_SPACES = "\t\n\v\f\r \x85\xa0\u1680\u2028\u2029\u202f\u205f\u3000" + "".join(map(chr, range(0x2000, 0x200B)))
_SPACE = re.compile(f"[{_SPACES}]+")  # Unicode's White_Space; Python's \s has four control characters more
_LIMIT = 1 << 24  # bytes of a vocabulary; OpenAI's has 3.2 million


class Tokenizer:
    """Turns prompts into the token ids of CLIP's text tower.

    Prompts are unescaped twice as HTML, composed (Unicode NFC) and put into lower case, and runs of white space become
    single blanks. OpenAI's tokenizer also repairs text with `ftfy`, which only changes text with encoding errors,
    typographic quotes, ligatures and full-width letters.

    Args:
        merges: pairs of symbols, in the order of merging.
        context: tokens per prompt; shorter prompts are filled with 0 after `<|endoftext|>`.

    Example:
        >>> load_tokenizer()(["a photo of a cat"])[0, :8].tolist()
        [49406, 320, 1125, 539, 320, 2368, 49407, 0]
    """

    def __init__(self, merges: Sequence[tuple[str, str]], *, context: int = 77) -> None:
        self.context = context
        self._bytes = _byte_symbols()
        symbols = list(self._bytes.values())
        symbols += [symbol + _END for symbol in symbols] + [a + b for a, b in merges]
        self.ids = {symbol: index for index, symbol in enumerate([*symbols, *_SPECIAL])}
        self._ranks = {pair: rank for rank, pair in enumerate(merges)}
        self._word_ids = lru_cache(maxsize=65536)(self._merge_word)

    def __call__(self, prompts: Sequence[str]) -> Tensor:  # [n, context] int64
        """The ids of each prompt: `<|startoftext|>`, its tokens, `<|endoftext|>`, zeros.

        Raises:
            TypeError: if `prompts` is one text, or holds something else than text.
            ValueError: if a prompt has more tokens than fit (it is not cut), or is not valid Unicode; it is named.
        """
        if isinstance(prompts, str):
            raise TypeError(f"prompts: expected a list of texts, got the text {prompts!r}; put it into a list")
        rows = torch.zeros(len(prompts), self.context, dtype=torch.int64)
        start, end = (self.ids[token] for token in _SPECIAL)
        for row, prompt in zip(rows, prompts, strict=True):
            ids = [start, *self.encode(prompt), end]
            if len(ids) > self.context:
                raise ValueError(
                    f"prompts: expected at most {self.context - 2} tokens each, got {len(ids) - 2} in "
                    f"{prompt[:60]!r}{'...' if len(prompt) > 60 else ''}; shorten it"
                )
            row[: len(ids)] = torch.tensor(ids)
        return rows

    def encode(self, prompt: str) -> list[int]:
        """The ids of one prompt, without start, end and filling.

        Raises:
            TypeError: if it is no text.
            ValueError: if it is not valid Unicode.
        """
        if not isinstance(prompt, str):
            raise TypeError(f"prompts: expected texts, got {type(prompt).__name__} {prompt!r}; convert it with str()")
        try:
            return [index for word in _words(_clean(prompt)) for index in self._word_ids(word)]
        except UnicodeEncodeError as error:
            raise ValueError(
                f"prompts: expected valid Unicode, got half of a surrogate pair in {prompt!r}; read the text as UTF-8"
            ) from error

    def _merge_word(self, word: str) -> tuple[int, ...]:
        if word in _SPECIAL:
            return (self.ids[word],)
        parts = [self._bytes[byte] for byte in word.encode("utf-8")]
        parts[-1] += _END
        parts = _merge(parts, self._ranks)
        return tuple(self.ids[part] for part in parts)


def _merge(parts: list[str], ranks: Mapping[tuple[str, str], int], least: int = 1) -> list[str]:
    """Merge neighbours, the pair of the lowest rank first, until no pair has a rank or `least` parts are left."""
    while len(parts) > least:
        best = min(pairwise(parts), key=lambda pair: ranks.get(pair, len(ranks)))
        if best not in ranks:
            break
        merged, index = [], 0
        while index < len(parts):
            width = 2 if (parts[index], *parts[index + 1 : index + 2]) == best else 1
            merged.append("".join(parts[index : index + width]))
            index += width
        parts = merged
    return parts


def _shipped_merges() -> list[tuple[str, str]]:
    """The merges behind the symbols that kfgs ships: the merges before a symbol leave two parts of it, which it joins.

    In the file a carriage return stands for the end of a word and of a line, which saves 3 kB.
    """
    packed = files("kfgs.teachers").joinpath("data", "clip_bpe_symbols.txt.bz2").read_bytes()
    ranks: dict[tuple[str, str], int] = {}
    for symbol in bz2.decompress(packed).decode("utf-8").replace("\r", f"{_END}\n").split("\n"):
        word = symbol.removesuffix(_END)
        first, second = _merge([*word[:-1], word[-1] + symbol[len(word) :]], ranks, least=2)
        ranks[first, second] = len(ranks)
    return list(ranks)


def load_tokenizer(path: str | Path | None = None) -> Tokenizer:
    """CLIP's tokenizer, with the merges that kfgs ships or those of a file.

    Args:
        path: OpenAI's `bpe_simple_vocab_16e6.txt.gz`, the same unpacked, or the folder of a Hugging Face CLIP tokenizer
            (`tokenizer.json`, or `vocab.json` and `merges.txt`). None: the merges of OpenAI that kfgs ships.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it does not hold CLIP's 48,894 merges, or its ids differ from CLIP's.
    """
    if path is None:
        return Tokenizer(_shipped_merges())
    path = as_path(path)
    if path.is_dir():
        return _from_folder(path)
    return Tokenizer(_parse(_read_text(path).split("\n"), str(path)))


def _from_folder(folder: Path) -> Tokenizer:
    """The tokenizer of a Hugging Face folder, if its ids follow from its merges."""
    if (folder / "tokenizer.json").is_file():
        model: Any = _read_json(folder / "tokenizer.json").get("model")
        model = model if isinstance(model, dict) else {}
        listed, ids = model.get("merges"), model.get("vocab")
        lines = [" ".join(pair) if isinstance(pair, list) else str(pair) for pair in listed or []]
    elif (folder / "merges.txt").is_file():
        lines, ids = _read_text(folder / "merges.txt").split("\n"), _read_json(folder / "vocab.json")
    else:
        raise FileNotFoundError(
            f"{folder}: expected the folder of a CLIP tokenizer, got one without tokenizer.json and merges.txt; name the "
            "folder that tokenizer.save_pretrained wrote, or leave the path out"
        )
    tokenizer = Tokenizer(_parse(lines, str(folder)))
    if ids != tokenizer.ids:
        raise ValueError(
            f"{folder}: expected the ids of CLIP's tokenizer (49,408), got others; use the tokenizer of a CLIP model"
        )
    return tokenizer


def _read_json(path: Path) -> dict[str, Any]:
    try:
        found = parse_json(_read_text(path))
    except ValueError as error:
        raise ValueError(f"{path}: expected JSON of a tokenizer, got something else ({error}); get it again") from error
    return found if isinstance(found, dict) else {}


def _read_text(path: Path) -> str:
    """A text file, packed with gzip or not."""
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: expected CLIP's vocabulary (bpe_simple_vocab_16e6.txt.gz), got no such file; check its name, or leave "
            "the path out"
        )
    try:
        with path.open("rb") as raw:
            packed = raw.read(2) == b"\x1f\x8b"
        with gzip.open(path) if packed else path.open("rb") as file:
            return file.read(_LIMIT).decode("utf-8-sig")
    except (
        OSError,
        EOFError,
        zlib.error,
        UnicodeDecodeError,
    ) as error:  # of damaged or cut gzip files, all but the last
        raise ValueError(
            f"{path}: expected CLIP's vocabulary, but it cannot be read as text ({error}); get it again"
        ) from error


def _parse(lines: Sequence[str], source: str) -> list[tuple[str, str]]:
    """The pairs of a list of merges, whose first line may be a header."""
    header = bool(lines) and (lines[0].startswith("#version") or "#version:" in lines[0])
    pairs = [tuple(line.split()) for line in lines[header : header + MERGES]]
    wrong = next((index for index, pair in enumerate(pairs) if len(pair) != 2), len(pairs))
    if wrong != MERGES:
        raise ValueError(
            f"{source}: expected CLIP's {MERGES:,} merges, two symbols in a line, got {wrong:,}; "
            "get bpe_simple_vocab_16e6.txt.gz again, or leave the path out"
        )
    return pairs  # type: ignore[return-value]  # of two each


def _clean(text: str) -> str:
    text = unicodedata.normalize("NFC", html.unescape(html.unescape(text)).strip())
    return _SPACE.sub(" ", text).strip().lower()


def _words(text: str) -> Iterator[str]:
    """Split like OpenAI's expression: special tokens and contractions, runs of letters, single numbers, runs of others.

    Letters and numbers are Unicode's categories L* and N*. `re` has no names for these: its digits lack the superscript
    two.
    """
    kinds = "".join(" " if char in _SPACES else _KINDS.get(unicodedata.category(char)[0], "O") for char in text)
    start = 0
    while start < len(text):
        found = _FIXED.match(text, start) or _RUN.match(kinds, start)
        if found is None:
            start += 1  # white space
            continue
        yield text[start : found.end()]
        start = found.end()


_KINDS = {"L": "L", "N": "N"}


def _byte_symbols() -> dict[int, str]:
    """A printable character for each byte, in the order of ids: printable bytes stay, others become 256 and following."""
    printable = [*range(ord("!"), ord("~") + 1), *range(ord("¡"), ord("¬") + 1), *range(ord("®"), ord("ÿ") + 1)]
    others = [byte for byte in range(256) if byte not in printable]
    return {byte: chr(byte) for byte in printable} | {byte: chr(256 + index) for index, byte in enumerate(others)}
