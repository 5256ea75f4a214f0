import hashlib
import json
import math

import pytest
from messages import tells

from kfgs._files import bytes_in_words, digest_file, digest_value, read_json, seconds_in_words, write_json


def test_json_round_trip(tmp_path):
    value = {"Größe": [1, 2.5, None, True], "nested": {"a": "b"}}
    write_json(tmp_path / "deep" / "value.json", value)
    assert read_json(tmp_path / "deep" / "value.json") == value
    assert (tmp_path / "deep" / "value.json").read_text(encoding="utf-8").endswith("}\n")


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_json_refuses_what_json_cannot_hold(tmp_path, number):
    write_json(tmp_path / "value.json", 1)
    with pytest.raises(ValueError, match=tells("JSON")):
        write_json(tmp_path / "value.json", {"loss": number})
    assert read_json(tmp_path / "value.json") == 1


def test_missing_json(tmp_path):
    with pytest.raises(FileNotFoundError, match=tells("split.json:", "no such file", "JSON")):
        read_json(tmp_path / "split.json")
    with pytest.raises(FileNotFoundError, match=tells("no such file")):
        read_json(tmp_path)  # a folder


@pytest.mark.parametrize("content", [b'{"a": 1', b"\xff\xfe{}", b"", b"1" * 5000])
def test_broken_json_names_the_file(tmp_path, content):
    (tmp_path / "split.json").write_bytes(content)
    with pytest.raises(ValueError, match=tells("split.json:", "JSON", "parsed (")):
        read_json(tmp_path / "split.json")


def test_digests_are_sha256(tmp_path):
    (tmp_path / "abc").write_bytes(b"abc")
    # FIPS 180-2, appendix B.1
    assert digest_file(tmp_path / "abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert digest_value({"b": 1, "a": [2]}) == hashlib.sha256(json.dumps({"a": [2], "b": 1}).encode()).hexdigest()


def test_digest_depends_on_the_value_and_not_on_the_order_of_keys():
    assert digest_value({"a": 1, "b": 2}) == digest_value({"b": 2, "a": 1})
    assert digest_value([1, 2]) != digest_value([2, 1])
    assert digest_value(1) != digest_value(1.5)


def test_bytes_and_seconds_in_words():
    assert [bytes_in_words(count) for count in (None, 15_925_248_000, 999e6, 340_000)] == [
        "unknown",
        "15.9 GB",
        "999.0 MB",
        "0.3 MB",
    ]
    times = [seconds_in_words(seconds) for seconds in (None, 40, 89, 720, 11_880)]
    assert times == ["unknown", "40 s", "89 s", "12 min", "3.3 h"]


@pytest.mark.parametrize("pair", ["[]", '{"a":}'], ids=["lists", "objects"])
def test_json_that_nests_too_deep_is_a_clear_error(tmp_path, pair):
    left, right = pair[:-1], pair[-1]
    file = tmp_path / "classes.json"
    for depth in (201, 990, 100_000):
        file.write_text(left * depth + "1" + right * depth)
        with pytest.raises(ValueError, match=tells(file, "JSON", "brackets nest more than 200 deep")):
            read_json(file)
    file.write_text(left * 199 + "1" + right * 199)
    assert read_json(file)
