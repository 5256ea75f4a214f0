"""CLIP's tokenizer: that of transformers with OpenAI's vocabulary, which is part of kfgs."""

from __future__ import annotations

import bz2
import html
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import torch
from torch import Tensor

from .transformers_package import require_transformers

CONTEXT = 77  # tokens per prompt of CLIP's text tower


@cache
def clip_tokenizer() -> Any:
    """The tokenizer of all CLIPs of OpenAI, and of most OpenCLIPs; it unescapes no HTML and repairs no text."""
    packed = files("kfgs.teachers").joinpath("data", "clip_bpe_merges.txt.bz2").read_bytes()
    merges = [tuple(line.split(" ")) for line in bz2.decompress(packed).decode("utf-8").splitlines()]
    printable = [*range(ord("!"), ord("~") + 1), *range(ord("¡"), ord("¬") + 1), *range(ord("®"), ord("ÿ") + 1)]
    single = [*map(chr, printable), *(chr(256 + i) for i in range(256 - len(printable)))]  # a character for each byte
    symbols = [*single, *(symbol + "</w>" for symbol in single), *map("".join, merges)]
    vocabulary = {symbol: index for index, symbol in enumerate([*symbols, "<|startoftext|>", "<|endoftext|>"])}
    return require_transformers().CLIPTokenizer(vocab=vocabulary, merges=merges)


def tokenize(prompts: Sequence[str], context: int = CONTEXT) -> Tensor:  # [n, context] int64
    """The ids of each prompt: `<|startoftext|>`, its tokens, `<|endoftext|>`, zeros. HTML is unescaped, as in OpenAI's.

    Raises:
        ImportError: if transformers is missing.
        ValueError: if a prompt has more tokens than fit (it is not cut); it is named.

    Example:
        >>> tokenize(["a photo of a cat"])[0, :8].tolist()
        [49406, 320, 1125, 539, 320, 2368, 49407, 0]
    """
    rows = torch.zeros(len(prompts), context, dtype=torch.int64)
    for row, prompt in zip(rows, prompts, strict=True):
        ids = clip_tokenizer()(html.unescape(html.unescape(prompt)))["input_ids"]
        if len(ids) > context:
            raise ValueError(
                f"prompts: expected at most {context - 2} tokens each, got {len(ids) - 2} in {prompt[:60]!r}; shorten it"
            )
        row[: len(ids)] = torch.tensor(ids)
    return rows
