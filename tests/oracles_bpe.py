"""CLIP's tokenizer as Hugging Face's `tokenizers` computes it, over a vocabulary that is put together here."""

import bz2
from pathlib import Path
from typing import Any


def read_merges(path: Path) -> list[str]:
    """The lines "a b"."""
    return bz2.decompress(path.read_bytes()).decode("utf-8").splitlines()


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
