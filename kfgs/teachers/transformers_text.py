"""Prompts to token ids, by the tokenizer that lies beside a model's weights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .transformers_table import TextRule

Tokenize = Callable[[list[str]], tuple[Tensor, Tensor]]  # n prompts -> ids [n, T], mask [n, T] (0: padding)

CLIP_VOCABULARY = 49408  # entries of CLIP's own, which kfgs brings along
_TOKENIZER_FILES = ("tokenizer.json", "vocab.json", "tokenizer.model", "spiece.model")


def has_tokenizer(folder: Path) -> bool:
    """Does a folder hold the files of a tokenizer?"""
    return any((folder / name).is_file() for name in _TOKENIZER_FILES)


def hub_tokenize(kind: str, source: Path | str, rule: TextRule, longest: int, load: Callable[[], Any]) -> Tokenize:
    """A tokenizer of transformers that `load` reads at the first prompt, so that pictures alone need none.

    Args:
        kind: the teacher's name, for messages.
        source: the folder or hub id that `load` reads from.
        rule: what the text tower was trained with.
        longest: tokens that the text tower takes; a longer prompt is refused, not cut.
        load: reads the tokenizer.
    """
    loaded: list[Any] = []

    def tokenize(prompts: list[str]) -> tuple[Tensor, Tensor]:
        if isinstance(source, Path) and not has_tokenizer(source):
            raise ValueError(
                f"{source}: expected a tokenizer beside the weights of teacher {kind!r} ({', '.join(_TOKENIZER_FILES[:2])}, "
                "...), got none; download those files too, or use a text table made elsewhere"
            )
        if not loaded:
            loaded.append(load())
        found = loaded[0](
            [prompt.lower() for prompt in prompts] if rule.lower else prompts,
            **({"padding": "max_length", "max_length": longest} if rule.pad else {"padding": True}),
            padding_side="right",  # siglip pools at the last position, and the tokenizer of siglip2 would pad in front
            return_attention_mask=True,
        )
        for prompt, mask in zip(prompts, found["attention_mask"], strict=True):
            if sum(mask) > longest:
                raise ValueError(
                    f"prompts: expected at most {longest} tokens for teacher {kind!r}, got {sum(mask)} in "
                    f"{prompt[:40]!r}; shorten it"
                )
        return torch.tensor(found["input_ids"]), torch.tensor(found["attention_mask"])

    return tokenize


def bpe_tokenize() -> Tokenize:
    """CLIP's own vocabulary, for weights that come without a tokenizer."""
    loaded: list[Any] = []

    def tokenize(prompts: list[str]) -> tuple[Tensor, Tensor]:
        from .bpe import load_tokenizer

        if not loaded:
            loaded.append(load_tokenizer())
        ids = loaded[0](prompts)
        return ids, torch.ones_like(ids)  # never used: CLIP is causal and pools at the end of the text

    return tokenize
