import gzip
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
from kfgs.teachers.bpe import Tokenizer, _words, load_tokenizer

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


@pytest.fixture(scope="module")
def tokenizer() -> Tokenizer:
    return load_tokenizer()


@pytest.fixture(scope="module")
def oracle():
    return hugging_face(read_merges(SHIPPED))


def test_shipped_merges_are_openais(tokenizer: Tokenizer) -> None:
    """The digest of OpenAI's lines 1 to 48,895, computed from the file whose SHA-256 the NOTICE gives."""
    text = "\n".join([HEADER, *read_merges(SHIPPED), ""]).encode()
    assert hashlib.sha256(text).hexdigest() == "685491abbdad36159d094ecdc23bebc0dd53f8d1df35c4d74ef6036db2ba7572"
    assert text.split(b"\n")[:2] == [b'"bpe_simple_vocab_16e6.txt#version: 0.2', b"i n"]
    assert len(tokenizer.ids) == 49408
    assert tokenizer.ids == vocabulary(read_merges(SHIPPED))
    assert (tokenizer.ids["<|startoftext|>"], tokenizer.ids["<|endoftext|>"]) == (49406, 49407)
    notice = (SHIPPED.parent / "NOTICE").read_text()
    assert "Copyright (c) 2021 OpenAI" in notice
    assert "924691ac288e54409236115652ad4aa250f48203de50a9e4722a6ecd48d6804a" in notice


def test_published_ids(tokenizer: Tokenizer) -> None:
    found = tokenizer(["a diagram", "a photo of a cat", "a photo of a dog", "hello world"])
    assert found.dtype == torch.int64
    assert found.shape == (4, 77)
    assert [[i for i in row.tolist() if i] for row in found] == [
        [49406, 320, 22697, 49407],
        [49406, 320, 1125, 539, 320, 2368, 49407],
        [49406, 320, 1125, 539, 320, 1929, 49407],
        [49406, 3306, 1002, 49407],
    ]


def test_no_prompts(tokenizer: Tokenizer) -> None:
    assert tokenizer([]).shape == (0, 77)


@pytest.mark.parametrize("prompt", ODD)
def test_odd_text_as_transformers(tokenizer: Tokenizer, oracle, prompt: str) -> None:
    assert [49406, *tokenizer.encode(prompt), 49407] == oracle(prompt)["input_ids"]


def test_random_text_as_transformers(tokenizer: Tokenizer, oracle) -> None:
    generator = np.random.default_rng(1)
    alphabet = "aaeehint stroscABC  '.,-!?0129²ßéñ日本🙂_\u2019\u0301\u00a0"
    prompts = ["".join(generator.choice(list(alphabet), generator.integers(1, 40))) for _ in range(1500)]
    expected = oracle(prompts)["input_ids"]
    wrong = [p for p, ids in zip(prompts, expected, strict=True) if [49406, *tokenizer.encode(p), 49407] != ids]
    assert wrong == []


@pytest.mark.skipif(not NAMES.is_file(), reason=f"no class names at {NAMES}")
def test_class_names_as_transformers(tokenizer: Tokenizer, oracle) -> None:
    lists = json.loads(NAMES.read_text())
    names = sorted({name for found in lists.values() for name in found})
    assert len(names) > 1000
    prompts = names + [f"a photo of the large {name.replace('_', ' ')}." for name in names]
    expected = torch.zeros(len(prompts), 77, dtype=torch.int64)
    for row, ids in zip(expected, oracle(prompts)["input_ids"], strict=True):
        row[: len(ids)] = torch.tensor(ids)
    assert torch.equal(tokenizer(prompts), expected)


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


def test_html_is_unescaped_twice(tokenizer: Tokenizer) -> None:
    assert tokenizer.encode("salt &amp;amp; pepper &lt;3") == tokenizer.encode("salt & pepper <3")


def test_special_tokens_in_a_prompt(tokenizer: Tokenizer) -> None:
    assert tokenizer.encode("a<|endoftext|>b") == [320, 49407, *tokenizer.encode("b")]


def test_ties_merge_from_the_left() -> None:
    tokenizer = Tokenizer([("a", "a"), ("aa", "a</w>")])
    assert tokenizer.encode("aaa") == [513]  # aa, a</w> -> aaa</w>
    assert tokenizer.encode("aaaaa") == [512, 513]
    assert tokenizer(["aaa"])[0, :4].tolist() == [514, 513, 515, 0]


def test_too_long_a_prompt_is_named_not_cut(tokenizer: Tokenizer) -> None:
    assert (tokenizer(["cat " * 75])[0] > 0).all()  # 75 tokens fit
    with pytest.raises(ValueError, match=tells("prompts:", "75", "got 76", "'cat cat ")):
        tokenizer(["dog", "cat " * 76])


@pytest.mark.parametrize(
    ("prompts", "error", "match"),
    [
        ("a cat", TypeError, ("prompts:", "list", "'a cat'")),
        (["a", 3], TypeError, ("prompts:", "got int 3")),
        (["a\ud800"], ValueError, ("prompts:", "'a\\ud800'", "UTF-8")),
    ],
)
def test_wrong_prompts(tokenizer: Tokenizer, prompts, error, match: str) -> None:
    with pytest.raises(error, match=tells(*match)):
        tokenizer(prompts)


def test_other_sources_give_the_same_ids(tokenizer: Tokenizer, oracle, tmp_path: Path) -> None:
    text = (
        "\n".join([HEADER, *read_merges(SHIPPED), ""]).encode() + b"extra merge\n" * 1000
    )  # OpenAI's file has 213,250 more
    (tmp_path / "bpe.txt").write_bytes(text)
    (tmp_path / "bpe.txt.gz").write_bytes(gzip.compress(text, 1))
    old = tmp_path / "old"
    old.mkdir()
    merges = read_merges(SHIPPED)
    (old / "merges.txt").write_text("#version: 0.2\n" + "\n".join(merges) + "\n", encoding="utf-8")
    (old / "vocab.json").write_text(json.dumps(vocabulary(merges)))
    oracle.save_pretrained(tmp_path / "new")
    for name in ("bpe.txt", "bpe.txt.gz", "old", "new"):
        found = load_tokenizer(tmp_path / name)
        assert found.ids == tokenizer.ids, name
        assert found.encode(ODD[2]) == tokenizer.encode(ODD[2]), name


def test_wrong_sources(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=tells("none.txt.gz:", "vocabulary", "no such file")):
        load_tokenizer(tmp_path / "none.txt.gz")
    with pytest.raises(FileNotFoundError, match=tells("tokenizer.json", "merges.txt")):
        load_tokenizer(tmp_path)
    (tmp_path / "short.txt").write_text("#version: 0.2\na b\nc d\n")
    with pytest.raises(ValueError, match=tells("short.txt:", "48,894", "got 2")):
        load_tokenizer(tmp_path / "short.txt")
    (tmp_path / "cut.txt.gz").write_bytes(gzip.compress(SHIPPED.read_bytes())[:5000])
    with pytest.raises(ValueError, match=tells("cut.txt.gz:", "vocabulary", "read")):
        load_tokenizer(tmp_path / "cut.txt.gz")
    (tmp_path / "noise.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=tells("noise.txt:", "vocabulary", "read")):
        load_tokenizer(tmp_path / "noise.txt")
    (tmp_path / "tokenizer.json").write_text("{not json")
    with pytest.raises(ValueError, match=tells("tokenizer.json:", "JSON")):
        load_tokenizer(tmp_path)


def test_another_models_tokenizer_is_refused(tmp_path: Path) -> None:
    merges = read_merges(SHIPPED)
    ids = vocabulary(merges)
    ids["<|endoftext|>"], ids["!"] = 0, 49407
    model = {"vocab": ids, "merges": [merge.split(" ") for merge in merges]}
    (tmp_path / "tokenizer.json").write_text(json.dumps({"model": model}))
    with pytest.raises(ValueError, match=tells("(49,408)", "got others")):
        load_tokenizer(tmp_path)
