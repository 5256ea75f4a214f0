import json

import numpy as np
import pytest
import torch
from messages import refused, tells
from safetensors.torch import save_file

from kfgs.labels import LabelSet, load_label_set
from kfgs.labels.label_set import teacher_mismatch
from kfgs.quant import Codebook


def _write(folder, names, rows):
    (folder / "classes.json").write_text(json.dumps(names))
    np.save(folder / "text.npy", rows)
    return folder / "classes.json", folder / "text.npy"


def test_names_and_rows_are_read(tmp_path):
    labels = load_label_set(*_write(tmp_path, ["wall", "floor"], np.float64([[1, 0, 0], [0, 1, 0]])))
    assert labels.names == ("wall", "floor")
    assert labels.embeddings.dtype == torch.float32
    assert labels.index("floor") == 1
    assert len(labels) == 2


def test_bad_input_is_named(tmp_path):
    with pytest.raises(ValueError, match=tells("text.npy:", "C = 2", "got float32", "(3, 4)")):
        load_label_set(*_write(tmp_path, ["a", "b"], np.zeros((3, 4), np.float32)))
    with pytest.raises(ValueError, match=tells("text.npy:", "finite", "got float32")):
        load_label_set(*_write(tmp_path, ["a"], np.full((1, 4), np.nan, np.float32)))
    with pytest.raises(ValueError, match=tells("classes.json:", "got dict")):
        load_label_set(*_write(tmp_path, {"a": 1}, np.zeros((1, 4), np.float32)))
    (tmp_path / "text.npy").write_bytes(b"not an array")
    (tmp_path / "classes.json").write_text('["a"]')
    refused(lambda: load_label_set(tmp_path / "classes.json", tmp_path / "text.npy"), "text.npy:", ".npy", "read")
    with pytest.raises(FileNotFoundError, match=tells("none.npy:", "embedding", "class")):
        load_label_set(tmp_path / "classes.json", tmp_path / "none.npy")
    refused(lambda: LabelSet(("a", "a"), torch.zeros(2, 3)), "names:", "got ['a', 'a']")
    with pytest.raises(ValueError, match=tells("class:", "wall", "got 'chair'", "add its embedding to the classes")):
        LabelSet(("wall",), torch.zeros(1, 3)).index("chair")


def _words():
    info = {"teacher": {"name": "letters", "weights": "abc"}, "templates": ["{}"], "synonyms": {"chair": ["seat"]}}
    rows = torch.tensor([[1.0, 2, 3], [0, 1, 0], [4, 0, 1]])
    return LabelSet(("wall", "chair", "größe"), rows, torch.eye(3)[:2], ("object", "stuff"), info)


def test_a_table_is_one_file_with_everything_in_it(tmp_path):
    _words().save(tmp_path / "text.safetensors")
    found = load_label_set(tmp_path / "text.safetensors")
    assert found.names == ("wall", "chair", "größe")
    assert found.embeddings.equal(_words().embeddings)
    assert found.negatives.equal(torch.eye(3)[:2])
    assert (found.negative_names, found.info) == (("object", "stuff"), _words().info)
    LabelSet(("a",), torch.ones(1, 2, dtype=torch.float16)).save(tmp_path / "few.safetensors")
    few = load_label_set(tmp_path / "few.safetensors")
    assert (few.negatives, few.negative_names, few.info) == (None, (), {})
    assert few.embeddings.dtype == torch.float32


def test_class_names_choose_and_order_the_rows_of_a_table(tmp_path):
    _words().save(tmp_path / "text.safetensors")
    (tmp_path / "classes.json").write_text('["chair", "wall"]')
    found = load_label_set(tmp_path / "classes.json", tmp_path / "text.safetensors")
    assert found.names == ("chair", "wall")
    assert found.embeddings.equal(_words().embeddings[[1, 0]])
    assert found.info == _words().info


def test_a_table_that_is_none_is_named(tmp_path):
    path = tmp_path / "t.safetensors"
    refused(lambda: load_label_set(path), "t.safetensors:", "no such file", "table of words", error=FileNotFoundError)
    path.write_bytes(b"\x08\0\0\0\0\0\0\0nonsense")
    refused(lambda: load_label_set(path), "t.safetensors:", "label set", "read")
    Codebook(torch.eye(3)).save(path)
    refused(lambda: load_label_set(path), "t.safetensors:", "version 1", "got codebook")
    head = {"kfgs": "label set", "version": "1", "names": '["a"]', "negative_names": "[]", "info": "{}"}
    for changed, words in [
        ({"names": "null"}, ("read",)),
        ({"names": "[1]"}, ("names:", "got [1]")),
        ({"names": '["a'}, ("read",)),
        ({"info": "3"}, ("read",)),
        ({"names": '["a", "b"]'}, ("embeddings:", "[2, D]", "got (1, 3)")),
        ({"negative_names": '["stuff"]'}, ("negatives:", "got None")),
    ]:
        save_file({"embeddings": torch.ones(1, 3)}, path, metadata=head | changed)
        refused(lambda: load_label_set(path), *words)
    save_file({"embeddings": torch.full((1, 3), torch.nan)}, path, metadata=head)
    refused(lambda: load_label_set(path), "t.safetensors:", "finite", "embeddings", "`kfgs features --words`")
    save_file({"others": torch.ones(1, 3)}, path, metadata=head)
    refused(lambda: load_label_set(path), "t.safetensors:", "read", "'embeddings'")


def test_what_cannot_be_a_table_is_refused(tmp_path):
    refused(lambda: _words().save(tmp_path / "text.npy"), "path:", ".safetensors", "text.npy")
    nan = LabelSet(("a",), torch.ones(1, 2), info={"seconds": float("nan")})
    refused(lambda: nan.save(tmp_path / "t.safetensors"), "info:", "got Out")
    refused(lambda: load_label_set(tmp_path / "t.safetensors", tmp_path / "t.npy"), "embeddings:", "none", "t.npy")
    (tmp_path / "classes.json").write_text('["a"]')
    refused(lambda: load_label_set(tmp_path / "classes.json"), "embeddings:", ".npy", "got none")
    assert [path.name for path in tmp_path.iterdir()] == ["classes.json"]
    refused(lambda: LabelSet(("a",), torch.ones(1, 2), torch.ones(1, 3), ("b",)), "negatives:", "[1, 2]", "got (1, 3)")
    refused(lambda: LabelSet("wall", torch.eye(4)), "names", "'wall'", "list", error=TypeError)
    refused(lambda: LabelSet(("wall",), "wall"), "embeddings", "'wall'", error=TypeError)
    assert LabelSet(["wall", "chair"], np.eye(2, dtype=np.float32)).embeddings.equal(torch.eye(2))


def test_select_and_knows():
    words = _words()
    assert words.select(["chair", "wall"]).embeddings.tolist() == [[0, 1, 0], [1, 2, 3]]
    assert (words.knows("Chair"), words.knows("chai")) == (True, False)
    assert "LabelSet(3 classes: wall, chair" in repr(words)
    refused(lambda: words.select(["char"]), "class:", "got 'char'", "'chair'")
    refused(lambda: words.select(["wall", "wall"]), "names:", "got ['wall', 'wall']")
    refused(lambda: words.select("wall"), "names:", "'wall'", error=TypeError)
    for rows, negatives in ((torch.eye(2).long(), None), (torch.eye(2), np.eye(2, dtype=int))):
        with pytest.raises(TypeError, match=tells("expected floating-point numbers", "int64")):
            LabelSet(("a", "b"), rows, negatives, ("x", "y") if negatives is not None else ())


def test_another_teacher_is_noticed_by_name_or_weights_alone():
    words = _words().info
    same = {"name": "letters", "weights": "abc", "options": {"flip": True}}
    for info in ({}, {"teacher": {"name": "letters"}}, {"teacher": same}):
        assert teacher_mismatch(info, words) is None
    assert teacher_mismatch({"teacher": {"name": "lseg"}}, words) == "name 'letters' instead of 'lseg'"
    other = {"teacher": {"name": "letters", "weights": "xyz"}}
    assert teacher_mismatch(other, words) == "weights 'abc' instead of 'xyz'"
