"""CLIP's byte-pair tokenizer (Sennrich et al. 2016; byte symbols as in GPT-2), with the standard library only.

Text is cut into words, each word into the symbols of its UTF-8 bytes, and neighbouring symbols are merged in the order of a
ranked list of merges. The 49,408 ids are 256 byte symbols, the same with `</w>` at the end of a word, one per merge,
`<|startoftext|>`, `<|endoftext|>`.

It is our own because LSeg must understand words offline and without the extra `hf`: transformers' `CLIPTokenizer` has no
vocabulary in its package (it downloads one), and open_clip comes with torchvision and timm.
"""

from __future__ import annotations

import bz2
import html
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.resources import files
from itertools import pairwise

import torch
from torch import Tensor

CONTEXT = 77  # tokens per prompt of CLIP's text tower
_END = "</w>"
_SPECIAL = ("<|startoftext|>", "<|endoftext|>")
_FIXED = re.compile(r"<\|startoftext\|>|<\|endoftext\|>|'(?:s|t|re|ve|m|ll|d)", re.IGNORECASE)
_RUN = re.compile(r"L+|N|O+")  # on character kinds: runs of letters, single numbers, runs of others
_SPACES = "\t\n\v\f\r \x85\xa0\u1680\u2028\u2029\u202f\u205f\u3000" + "".join(map(chr, range(0x2000, 0x200B)))
_SPACE = re.compile(f"[{_SPACES}]+")  # Unicode's White_Space; Python's \s has four control characters more


def tokenize(prompts: Sequence[str], context: int = CONTEXT) -> Tensor:  # [n, context] int64
    """The ids of each prompt: `<|startoftext|>`, its tokens, `<|endoftext|>`, zeros.

    Prompts are unescaped twice as HTML, composed (Unicode NFC) and put into lower case, and runs of white space become
    single blanks. OpenAI's tokenizer also repairs text with `ftfy`, which only changes text with encoding errors,
    typographic quotes, ligatures and full-width letters.

    Raises:
        ValueError: if a prompt has more tokens than fit (it is not cut), or is not valid Unicode; it is named.

    Example:
        >>> tokenize(["a photo of a cat"])[0, :8].tolist()
        [49406, 320, 1125, 539, 320, 2368, 49407, 0]
    """
    rows = torch.zeros(len(prompts), context, dtype=torch.int64)
    _, ids = _vocabulary()
    for row, prompt in zip(rows, prompts, strict=True):
        text = unicodedata.normalize("NFC", html.unescape(html.unescape(prompt)).strip())
        try:
            tokens = [i for word in _words(_SPACE.sub(" ", text).strip().lower()) for i in _word_ids(word)]
        except UnicodeEncodeError as error:
            raise ValueError(
                f"prompts: expected valid Unicode, got half of a surrogate pair in {prompt!r}; read the text as UTF-8"
            ) from error
        if len(tokens) > context - 2:
            raise ValueError(
                f"prompts: expected at most {context - 2} tokens each, got {len(tokens)} in "
                f"{prompt[:60]!r}{'...' if len(prompt) > 60 else ''}; shorten it"
            )
        row[: len(tokens) + 2] = torch.tensor([ids[_SPECIAL[0]], *tokens, ids[_SPECIAL[1]]])
    return rows


def _words(text: str) -> Iterator[str]:
    """Split like OpenAI's expression: special tokens and contractions, runs of letters, single numbers, runs of others.

    Letters and numbers are Unicode's categories L* and N*, for which `re` has no names.
    """
    kinds = {"L": "L", "N": "N"}
    line = "".join(" " if char in _SPACES else kinds.get(unicodedata.category(char)[0], "O") for char in text)
    start = 0
    while start < len(text):
        word = _FIXED.match(text, start) or _RUN.match(line, start)
        if word is None:
            start += 1  # white space
            continue
        yield text[start : word.end()]
        start = word.end()


@cache
def _word_ids(word: str) -> tuple[int, ...]:
    ranks, ids = _vocabulary()
    if word in _SPECIAL:
        return (ids[word],)
    parts = [_byte_symbols()[byte] for byte in word.encode("utf-8")]
    return tuple(ids[part] for part in _merge([*parts[:-1], parts[-1] + _END], ranks))


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


@cache
def _vocabulary() -> tuple[dict[tuple[str, str], int], dict[str, int]]:
    """The ranks of the merges, and the id of each symbol.

    The file has the symbols that merging makes, in order: the merges before a symbol leave two parts of it, which it joins.
    A carriage return stands for the end of a word and of a line, which saves 3 kB.
    """
    packed = files("kfgs.teachers").joinpath("data", "clip_bpe_symbols.txt.bz2").read_bytes()
    ranks: dict[tuple[str, str], int] = {}
    for symbol in bz2.decompress(packed).decode("utf-8").replace("\r", f"{_END}\n").split("\n"):
        word = symbol.removesuffix(_END)
        first, second = _merge([*word[:-1], word[-1] + symbol[len(word) :]], ranks, least=2)
        ranks[first, second] = len(ranks)
    single = list(_byte_symbols().values())
    symbols = [*single, *(symbol + _END for symbol in single), *(a + b for a, b in ranks), *_SPECIAL]
    return ranks, {symbol: index for index, symbol in enumerate(symbols)}


@cache
def _byte_symbols() -> dict[int, str]:
    """A printable character for each byte, in the order of ids: printable bytes stay, others become 256 and following."""
    printable = [*range(ord("!"), ord("~") + 1), *range(ord("¡"), ord("¬") + 1), *range(ord("®"), ord("ÿ") + 1)]
    others = [byte for byte in range(256) if byte not in printable]
    return {byte: chr(byte) for byte in printable} | {byte: chr(256 + index) for index, byte in enumerate(others)}
