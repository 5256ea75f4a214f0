import hashlib
import json
import sys
import unicodedata
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import tells
from oracles_bpe import hugging_face, read_merges, vocabulary

import kfgs
from kfgs.teachers.tokenizer import _vocabulary, _words, tokenize

HEADER = '"bpe_simple_vocab_16e6.txt#version: 0.2'
SHIPPED = Path(kfgs.__file__).parent / "teachers" / "data" / "clip_bpe_symbols.txt.bz2"
NAMES = Path(__file__).resolve().parents[3] / "shared" / "data" / "text" / "names.json"

ODD = [
    "",
    "A  Photo\tof\na CAT.",
    "don't you're I'M we'll they've he'd it's 'tis rock'n'roll 's",
    "x² ½ Ⅷ ①② 3.14159 2026 1st",
    "naïve café Tür Straße İstanbul ŒUVRE ǅ",
    "cafe\u0301 e\u0301\u0302",  # composed to é first
    "日本語 한국어 中文字 العربية हिन्दी ไทย",
    "🙂👍🏽 👨‍👩‍👧 ❤️",
    "under_score __init__ a-b\u2013c\u2014d\u2026e ''quoted'' “curly”",
    "\u00a0non\u2003breaking\u3000spaces\u202f",
    "!!! ?! ;-) <html> & © ® ™ # $%^&*()",
    "supercalifragilisticexpialidocious antidisestablishmentarianism",
    "aaaaaaaaaaaaaaa hahahahahaha ....... -------",
    "\u200bzero\u200dwidth \ufeffbom",
]


def encode(prompt):
    row = tokenize([prompt])[0].tolist()
    return row[1 : len(row) - 1 - row[::-1].index(49407)]


@pytest.fixture(scope="module")
def oracle():
    return hugging_face(read_merges(SHIPPED))


def test_shipped_merges_are_openais() -> None:
    """The digest of OpenAI's lines 1 to 48,895, computed from the file whose SHA-256 the NOTICE gives."""
    text = "\n".join([HEADER, *read_merges(SHIPPED), ""]).encode()
    assert hashlib.sha256(text).hexdigest() == "685491abbdad36159d094ecdc23bebc0dd53f8d1df35c4d74ef6036db2ba7572"
    assert text.split(b"\n")[:2] == [b'"bpe_simple_vocab_16e6.txt#version: 0.2', b"i n"]
    _, ids = _vocabulary()
    assert len(ids) == 49408
    assert ids == vocabulary(read_merges(SHIPPED))
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


@pytest.mark.parametrize("prompt", ODD)
def test_odd_text_as_transformers(oracle, prompt: str) -> None:
    assert [49406, *encode(prompt), 49407] == oracle(prompt)["input_ids"]


def test_random_text_as_transformers(oracle) -> None:
    generator = np.random.default_rng(1)
    alphabet = "aaeehint stroscABC  '.,-!?0129²ßéñ日本🙂_\u2019\u0301\u00a0"
    prompts = ["".join(generator.choice(list(alphabet), generator.integers(1, 40))) for _ in range(1500)]
    expected = oracle(prompts)["input_ids"]
    wrong = [p for p, ids in zip(prompts, expected, strict=True) if [49406, *encode(p), 49407] != ids]
    assert wrong == []


@pytest.mark.skipif(not NAMES.is_file(), reason=f"no class names at {NAMES}")
def test_class_names_as_transformers(oracle) -> None:
    lists = json.loads(NAMES.read_text())
    names = sorted({name for found in lists.values() for name in found})
    assert len(names) > 1000
    prompts = names + [f"a photo of the large {name.replace('_', ' ')}." for name in names]
    expected = torch.zeros(len(prompts), 77, dtype=torch.int64)
    for row, ids in zip(expected, oracle(prompts)["input_ids"], strict=True):
        row[: len(ids)] = torch.tensor(ids)
    assert torch.equal(tokenize(prompts), expected)


def test_words_are_cut_as_the_regex_package_cuts_them_for_every_character() -> None:
    """U+0345 alone differs: without regard to case that package takes it for the letter iota."""
    regex = pytest.importorskip("regex", reason="needs regex, which transformers brings")
    expression = regex.compile(
        r"<\|startoftext\|>|<\|endoftext\|>|'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+", regex.IGNORECASE
    )
    different = []
    for code in range(0, sys.maxunicode + 1):
        if unicodedata.category(chr(code)) not in ("Cn", "Cs", "Co") and not (0x3500 < code < 0xD700):
            text = f"a{chr(code)}{chr(code)}1'{chr(code)}"
            if list(_words(text)) != expression.findall(text):
                different.append(code)
    assert different == [0x345]


def test_html_is_unescaped_twice() -> None:
    assert encode("salt &amp;amp; pepper &lt;3") == encode("salt & pepper <3")


def test_special_tokens_and_half_a_surrogate_pair() -> None:
    assert encode("a<|endoftext|>b") == [320, 49407, *encode("b")]
    with pytest.raises(ValueError, match=tells("prompts:", "UTF-8")):
        tokenize(["a\ud800"])


def test_too_long_a_prompt_is_named_not_cut() -> None:
    assert (tokenize(["cat " * 75])[0] > 0).all()  # 75 tokens fit
    with pytest.raises(ValueError, match=tells("prompts:", "75", "got 76", "'cat cat ")):
        tokenize(["dog", "cat " * 76])
