import hashlib
from pathlib import Path

import pytest
import torch

pytest.importorskip("transformers")

from messages import refused
from oracles_bpe import read_merges, vocabulary

import kfgs
from kfgs.teachers.tokenizer import clip_tokenizer, tokenize

HEADER = '"bpe_simple_vocab_16e6.txt#version: 0.2'
SHIPPED = Path(kfgs.__file__).parent / "teachers" / "data" / "clip_bpe_merges.txt.bz2"


def encode(prompt):
    row = tokenize([prompt])[0].tolist()
    return row[1 : len(row) - 1 - row[::-1].index(49407)]


def test_shipped_merges_are_openais() -> None:
    """The digest of OpenAI's lines 1 to 48,895, computed from the file whose SHA-256 the NOTICE gives."""
    text = "\n".join([HEADER, *read_merges(SHIPPED), ""]).encode()
    assert hashlib.sha256(text).hexdigest() == "685491abbdad36159d094ecdc23bebc0dd53f8d1df35c4d74ef6036db2ba7572"
    assert clip_tokenizer().get_vocab() == vocabulary(read_merges(SHIPPED))
    notice = (SHIPPED.parent / "NOTICE").read_text()
    assert "Copyright (c) 2021 OpenAI" in notice
    assert "924691ac288e54409236115652ad4aa250f48203de50a9e4722a6ecd48d6804a" in notice


def test_published_ids() -> None:
    found = tokenize(["a diagram", "a photo of a cat", "a photo of a dog", "hello world"])
    assert found.dtype == torch.int64
    assert found.shape == (4, 77)
    assert [[i for i in row.tolist() if i] for row in found] == [
        [49406, 320, 22697, 49407],
        [49406, 320, 1125, 539, 320, 2368, 49407],
        [49406, 320, 1125, 539, 320, 1929, 49407],
        [49406, 3306, 1002, 49407],
    ]


def test_spaces_capitals_and_accents() -> None:
    assert encode("A  Photo\tof\na CAT.") == encode("a photo of a cat.")
    assert encode("cafe\u0301") == encode("caf\u00e9")
    assert encode("salt &amp;amp; pepper &lt;3") == encode("salt & pepper <3")  # HTML is unescaped twice
    assert encode("") == []


def test_too_long_a_prompt_is_named_not_cut() -> None:
    assert (tokenize(["cat " * 75])[0] > 0).all()  # 75 tokens fit
    refused(lambda: tokenize(["dog", "cat " * 76]), "prompts:", "75", "got 76", "'cat cat ")
