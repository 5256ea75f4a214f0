"""CLIP's tokenizer as Hugging Face's `tokenizers` computes it, over a vocabulary that is put together here."""

import bz2
import itertools
from pathlib import Path
from typing import Any


def read_merges(path: Path) -> list[str]:
    """The lines "a b" behind a packed list of joined symbols: each is taken apart by the merges before it."""
    ranks: dict[tuple[str, str], int] = {}
    for symbol in bz2.decompress(path.read_bytes()).replace(b"\r", b"</w>\n").decode("utf-8").split("\n"):
        ended = symbol.endswith("</w>")
        parts = list(symbol[:-4] if ended else symbol)
        if ended:
            parts[-1] += "</w>"
        while len(parts) > 2:
            known = [(ranks[pair], i) for i, pair in enumerate(itertools.pairwise(parts)) if pair in ranks]
            pair = tuple(parts[min(known)[1] : min(known)[1] + 2])
            i = 0
            while i < len(parts) - 1:
                if (parts[i], parts[i + 1]) == pair:
                    parts[i : i + 2] = [parts[i] + parts[i + 1]]
                i += 1
        ranks[parts[0], parts[1]] = len(ranks)
    return [" ".join(pair) for pair in ranks]


def vocabulary(merges: list[str]) -> dict[str, int]:
    """256 byte symbols in GPT-2's order, the same at a word's end, one symbol per merge, start and end of text."""
    symbols = []
    for byte in list(range(33, 127)) + list(range(161, 173)) + list(range(174, 256)):
        symbols.append(chr(byte))
    for number in range(256 - len(symbols)):  # the bytes that do not print: moved behind Latin-1, in order
        symbols.append(chr(256 + number))
    for symbol in list(symbols):
        symbols.append(symbol + "</w>")
    for merge in merges:
        symbols.append(merge.replace(" ", ""))
    symbols.append("<|startoftext|>")
    symbols.append("<|endoftext|>")
    ids = {}
    for symbol in symbols:
        ids[symbol] = len(ids)
    return ids


def hugging_face(merges: list[str]) -> Any:
    """`transformers.CLIPTokenizer` of that vocabulary."""
    from transformers import CLIPTokenizer

    return CLIPTokenizer(vocab=vocabulary(merges), merges=[tuple(merge.split(" ")) for merge in merges])
