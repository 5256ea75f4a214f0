import json

import pytest
from messages import tells

from kfgs.features import FeatureFolder, read_manifest
from kfgs.features.manifest import Manifest, MapRecord

RECORD = MapRecord("sub/a.npy", (3, 4, 5), 248, 17, "d" * 64, "a.png", "e" * 64, 0.25)


@pytest.fixture
def folder(tmp_path):
    Manifest({"name": "t", "options": {"size": [3, 4]}}, {"sub/a": RECORD}, discarded=True).save(tmp_path)
    return tmp_path


WAY_OUT = (
    "delete it to use the maps without it, or delete it and the maps and run `kfgs features`, which makes them again"
)


def nested(levels: int) -> dict:
    found: dict = {}
    for _ in range(levels):
        found = {"a": found}
    return found


def change(folder, **values) -> None:
    """Put other values into the one record, or into the manifest."""
    about = json.loads((folder / "features.json").read_text())
    for name, value in values.items():
        (about if name in about else about["maps"]["sub/a"])[name] = value
    (folder / "features.json").write_text(json.dumps(about))


def test_what_is_saved_comes_back(folder):
    found = read_manifest(folder)
    assert found == Manifest({"name": "t", "options": {"size": [3, 4]}}, {"sub/a": RECORD}, discarded=True)
    (folder / "sub").mkdir()
    assert read_manifest(folder / "sub") is None
    change(folder, seconds=1)  # a whole number is a number
    assert read_manifest(folder).maps["sub/a"].seconds == 1


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"file": 5}, ["sub/a", "file", "5"]),
        ({"file": "../../etc/passwd"}, ["sub/a", "file", "../../etc/passwd"]),
        ({"file": "/etc/passwd"}, ["sub/a", "file", "/etc/passwd"]),
        ({"file": ""}, ["sub/a", "file"]),
        ({"file": "a\0b"}, ["sub/a", "file", r"a\x00b"]),
        ({"shape": [1]}, ["sub/a", "shape", "[1]"]),
        ({"shape": ["a", 2, 3]}, ["sub/a", "shape", "2, 3]"]),
        ({"shape": [True, 2, 3]}, ["sub/a", "shape", "[True, 2, 3]"]),
        ({"shape": [1, 0, 3]}, ["sub/a", "shape", "[1, 0, 3]"]),
        ({"shape": [1.0, 2, 3]}, ["sub/a", "shape", "[1.0, 2, 3]"]),
        ({"shape": "abc"}, ["sub/a", "shape", "abc"]),
        ({"bytes": "x"}, ["sub/a", "bytes", "x"]),
        ({"bytes": True}, ["sub/a", "bytes", "True"]),
        ({"bytes": -1}, ["sub/a", "bytes", "-1"]),
        ({"mtime_ns": None}, ["sub/a", "mtime_ns", "None"]),
        ({"digest": 7}, ["sub/a", "digest", "7"]),
        ({"image": []}, ["sub/a", "image", "[]"]),
        ({"image_digest": 7}, ["sub/a", "image_digest", "7"]),
        ({"seconds": float("nan")}, ["sub/a", "seconds", "nan"]),
        ({"maps": {"a": []}}, ["a", "missing"]),
        ({"maps": {"a": {}}}, ["a", "file", "missing"]),
        ({"maps": []}, ["maps"]),
        ({"teacher": [["a", 1]]}, ["teacher"]),
        ({"discarded": 1}, ["discarded"]),
        ({"seconds": 10**400}, ["a number has 401 digits"]),
        ({"bytes": 10**30}, ["sub/a", "bytes", "100000"]),
        ({"shape": [10**30, 2, 3]}, ["sub/a", "shape", "[100000"]),
        ({"maps": {"a\n\x1b[31m": []}}, [r"a\n\x1b[31m"]),
        ({"teacher": {"name": "t", "options": {"scale": float("inf")}}}, ["teacher", "infinity"]),
        ({"teacher": nested(100)}, ["teacher", "nested"]),
    ],
)
def test_what_kfgs_never_wrote_is_refused_in_a_line_that_names_the_file(folder, values, words):
    change(folder, **values)
    for read in (read_manifest, FeatureFolder):
        with pytest.raises(ValueError, match=tells(*words)) as caught:
            read(folder)
        text = str(caught.value)
        assert text.startswith(f"{folder / 'features.json'}: expected a manifest of kfgs, but it is damaged (")
        assert text.endswith(f"; {WAY_OUT}")
        assert text.isprintable()  # no line ends, no control characters
        assert len(text) < 500 + len(str(folder))


@pytest.mark.parametrize("text", ["[]", "{}", '{"format": "kfgs-features/9"}'])
def test_another_format_is_named(tmp_path, text):
    (tmp_path / "features.json").write_text(text)
    with pytest.raises(ValueError, match=tells("features.json", "format 'kfgs-features/1'", WAY_OUT)):
        read_manifest(tmp_path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", ("JSON", "(Expecting")),
        ("[" * 100_000 + "]" * 100_000, ("nest more than",)),
        ('{"seconds": ' + "1" * 5000 + "}", ("JSON", "(a number has 5000 digits")),
    ],
)
def test_what_is_no_json_says_the_way_out(tmp_path, text, words):
    (tmp_path / "features.json").write_text(text)
    with pytest.raises(ValueError, match=tells(*words)) as caught:
        read_manifest(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path / 'features.json'}: expected a ")
    assert str(caught.value).endswith(f"; {WAY_OUT}")


def test_an_identity_that_is_deep_but_sane_is_kept(folder):
    change(folder, teacher=nested(99))
    found = read_manifest(folder)
    assert found.teacher == nested(99)
    found.save(folder)
    assert read_manifest(folder) == found
