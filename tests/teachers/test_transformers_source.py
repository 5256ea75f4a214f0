"""Where a model comes from: what is wrong with a folder, a hub id, a file or the environment, in one line."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

transformers = pytest.importorskip("transformers")

from messages import refused, tells  # noqa: E402
from safetensors.torch import load_file, save_file  # noqa: E402
from tiny_transformers import write_teacher  # noqa: E402

import kfgs  # noqa: E402
from kfgs.teachers.transformers_teacher import load_transformers_teacher  # noqa: E402


@pytest.fixture
def folder(tmp_path):
    return write_teacher(tmp_path / "clip", "clip")


def one_line(error: pytest.ExceptionInfo) -> bool:
    return "\n" not in str(error.value)


def test_model_of_another_type_is_named(folder):
    with pytest.raises(ValueError, match=tells("clip:", "'siglip'", "got 'clip'", "'clip' or 'openclip'")):
        load_transformers_teacher("siglip", folder)
    (folder / "config.json").write_text(json.dumps({"model_type": "bert"}))
    refused(lambda: load_transformers_teacher("clip", folder), "clip:", "'clip'", "got 'bert'")


def test_folder_without_config_and_files_are_refused(folder, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=tells("empty:", "save_pretrained", "config.json")):
        load_transformers_teacher("dinov2", tmp_path / "empty")
    with pytest.raises(FileNotFoundError, match=tells("empty:", "config.json")):
        load_transformers_teacher("clip", tmp_path / "empty")
    with pytest.raises(FileNotFoundError, match=tells("'dinov2'", "got a file")):
        load_transformers_teacher("dinov2", folder / "model.safetensors")
    (folder / "config.json").write_text("{")
    refused(lambda: load_transformers_teacher("clip", folder), "config.json:", "JSON")


def test_path_where_nothing_lies_is_not_looked_up_on_the_hub(tmp_path):
    for source in (tmp_path / "none", str(tmp_path / "none"), Path("owner/name"), "./clip", "clip-vit", "a/b/c"):
        with pytest.raises(FileNotFoundError, match=tells("'clip'", "owner/name", "got a path")):
            load_transformers_teacher("clip", source)


def test_hub_id_out_of_reach_is_one_line(monkeypatch):
    with pytest.raises(ValueError, match=tells("owner/name:", "hub", "download", "folder")) as error:
        load_transformers_teacher("clip", "owner/name", local_only=True)
    assert one_line(error)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(ValueError, match=tells("owner/name:", "'dinov2'", "hub")) as error:
        load_transformers_teacher("dinov2", "owner/name")
    assert one_line(error)


def test_hub_id_is_read_from_the_local_cache(tmp_path, monkeypatch):
    commit = "0123456789abcdef0123456789abcdef01234567"
    repository = tmp_path / "models--owner--tiny-dino"
    write_teacher(repository / "snapshots" / commit, "dinov2")
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(commit)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    teacher = load_transformers_teacher("dinov2", "owner/tiny-dino", local_only=True)
    assert teacher.encode_image(torch.rand(3, 16, 24)).shape == (32, 2, 3)
    assert teacher.identity["source"] == "owner/tiny-dino"
    assert teacher.identity["weights"] == f"commit {commit}"


def test_missing_and_damaged_weights_are_refused(folder):
    weights = folder / "model.safetensors"
    state = load_file(weights)
    name = "vision_model.encoder.layers.1.self_attn.v_proj.weight"
    save_file({key: tensor for key, tensor in state.items() if key != name}, weights, {"format": "pt"})
    with pytest.raises(ValueError, match=tells("CLIPModel", "1 missing", f"'{name}'")) as error:
        load_transformers_teacher("clip", folder)
    assert one_line(error)
    save_file({**state, name: torch.zeros(32, 5)}, weights, {"format": "pt"})
    with pytest.raises(ValueError, match=tells("clip:", "weights", "'clip'")) as error:
        load_transformers_teacher("clip", folder)
    assert one_line(error)
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(ValueError, match=tells("clip:", "weights", "'clip'", "read")) as error:
        load_transformers_teacher("clip", folder)
    assert one_line(error)
    weights.unlink()
    with pytest.raises(ValueError, match=tells("clip:", "weights", "'clip'", "read", "model.safetensors")):
        load_transformers_teacher("clip", folder)


def test_pictures_need_no_tokenizer_but_words_do(tmp_path):
    folder = write_teacher(tmp_path / "siglip", "siglip")
    for file in folder.glob("tokenizer*"):
        file.unlink()
    teacher = load_transformers_teacher("siglip", folder)
    assert teacher.encode_image(torch.rand(3, 16, 24)).shape == (32, 2, 3)
    refused(lambda: teacher.encode_text(["wall"]), "tokenizer", "'siglip'", "got none", "download")
    (folder / "tokenizer.json").write_text("{}")
    refused(lambda: teacher.encode_text(["wall"]), "tokenizer", "'siglip'", "read")


def test_missing_package_names_the_line_to_install_it(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    refused(lambda: load_transformers_teacher("clip", folder), "transformers:", "kfgs[hf]", error=ImportError)


def test_package_that_does_not_import_is_named(folder, tmp_path, monkeypatch):
    (tmp_path / "site" / "transformers").mkdir(parents=True)
    (tmp_path / "site" / "transformers" / "__init__.py").write_text("raise RuntimeError('operator is\\nnot there')\n")
    for name in [name for name in sys.modules if name.partition(".")[0] == "transformers"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    with pytest.raises(ImportError, match=tells("transformers:", "import", "(RuntimeError: ", "--upgrade")) as got:
        load_transformers_teacher("clip", folder)
    assert one_line(got)


def test_torchvision_that_does_not_import_is_reported_as_what_it_is(folder, tmp_path):
    package = tmp_path / "site" / "torchvision"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('operator torchvision::nms does not exist')")
    code = f"from kfgs.teachers.transformers_teacher import load_transformers_teacher as load; load('clip', {str(folder)!r})"
    root = str(Path(kfgs.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path / "site"), root])}
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=600)
    assert found.returncode == 1
    last = found.stderr.strip().splitlines()[-1]
    assert last.startswith("ImportError: torchvision: expected none, or the build that belongs to torch")
    assert "RuntimeError: operator torchvision::nms does not exist" in last
    assert "`pip uninstall torchvision`" in last
