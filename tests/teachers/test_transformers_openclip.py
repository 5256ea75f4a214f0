"""CLIP in OpenCLIP's layout, against a small CLIP written with OpenCLIP's structure."""

import json

import pytest
import torch

transformers = pytest.importorskip("transformers")

from messages import refused, tells  # noqa: E402
from oracles_transformers import OpenClip  # noqa: E402
from safetensors.torch import save_file  # noqa: E402

from kfgs.teachers.tokenizer import tokenize  # noqa: E402
from kfgs.teachers.transformers_teacher import load_transformers_teacher  # noqa: E402

SETTINGS = {"model_cfg": {"vision_cfg": {"head_width": 16}, "text_cfg": {"heads": 2}}}


@pytest.fixture(scope="module")
def clip():
    torch.manual_seed(0)
    return OpenClip(
        width=48, heads=3, layers=2, patch=8, cells=4, text_width=32, text_heads=2, length=16, vocabulary=64, dim=20
    ).eval()


def write(folder, state, *, bin=True, settings=SETTINGS):
    folder.mkdir(exist_ok=True)
    if bin:
        torch.save(state, folder / "open_clip_pytorch_model.bin")
    else:
        save_file({name: tensor.contiguous() for name, tensor in state.items()}, folder / "open_clip_model.safetensors")
    if settings:
        (folder / "open_clip_config.json").write_text(json.dumps(settings))
    return folder


@pytest.mark.parametrize("bin", [True, False])
def test_both_towers_equal_openclip(clip, tmp_path, bin):
    teacher = load_transformers_teacher("openclip", write(tmp_path / "model", clip.state_dict(), bin=bin))
    pixels = torch.randn(2, 3, 32, 32)
    ids = torch.tensor([[62, 5, 9, 63, 0, 0], [62, 30, 7, 12, 8, 63]])
    with torch.no_grad():
        image = teacher.model.get_image_features(pixels).pooler_output
        text = teacher.model.get_text_features(ids).pooler_output
        torch.testing.assert_close(image, clip.image(pixels), rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(text, clip.text(ids), rtol=1e-4, atol=1e-4)
    assert teacher.encode_image(torch.rand(3, 40, 56)).shape == (20, 5, 7)
    assert teacher.name == "openclip"


def test_vocabulary_of_clip_stands_in_for_a_missing_tokenizer(clip, tmp_path):
    with pytest.raises(ValueError, match=tells("small:", "'openclip'", "got none")):
        load_transformers_teacher("openclip", write(tmp_path / "small", clip.state_dict())).encode_text(["wall"])
    torch.manual_seed(1)
    full = OpenClip(
        width=16, heads=1, layers=1, patch=8, cells=2, text_width=16, text_heads=2, length=77, vocabulary=49408, dim=8
    ).eval()
    teacher = load_transformers_teacher("openclip", write(tmp_path / "full", full.state_dict()))
    rows = teacher.encode_text(["wall", "a red chair"])
    with torch.no_grad():
        expected = full.text(tokenize(["wall", "a red chair"]))
    torch.testing.assert_close(rows, torch.nn.functional.normalize(expected, dim=1), rtol=1e-4, atol=1e-5)


def test_hub_repository_in_openclip_layout(clip, tmp_path, monkeypatch):
    commit = "0123456789abcdef0123456789abcdef01234567"
    repository = tmp_path / "models--owner--tiny-clip"
    for folder in ("snapshots", "refs"):
        (repository / folder).mkdir(parents=True)
    folder = write(repository / "snapshots" / commit, clip.state_dict(), bin=False)
    (repository / "refs" / "main").write_text(commit)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    teacher = load_transformers_teacher("openclip", "owner/tiny-clip", local_only=True)
    assert (teacher.identity["weights"], teacher.identity["source"]) == (f"commit {commit}", "owner/tiny-clip")
    picture, local = torch.rand(3, 32, 32), load_transformers_teacher("openclip", folder)
    torch.testing.assert_close(teacher.encode_image(picture), local.encode_image(picture))


def test_activation_and_heads_come_from_the_settings(clip, tmp_path):
    quick = {"model_cfg": {**SETTINGS["model_cfg"], "quick_gelu": True}}
    model = load_transformers_teacher("openclip", write(tmp_path / "quick", clip.state_dict(), settings=quick)).model
    assert model.config.vision_config.hidden_act == "quick_gelu"
    assert model.config.vision_config.num_attention_heads == 3
    model = load_transformers_teacher("openclip", write(tmp_path / "bare", clip.state_dict(), settings=None)).model
    assert model.config.vision_config.hidden_act == "gelu"
    assert model.config.vision_config.num_attention_heads == 1  # 48 channels: less than a head of 64
    model = load_transformers_teacher("clip", tmp_path / "bare").model  # OpenAI's own
    assert model.config.vision_config.hidden_act == model.config.text_config.hidden_act == "quick_gelu"


@pytest.mark.parametrize("key", ["visual.trunk.blocks.0.attn.qkv", "visual.layer1.0.conv1.weight", "vision_model.x"])
def test_other_models_are_named(tmp_path, key):
    folder = write(tmp_path / "model", {key: torch.zeros(2)})
    words = ("open_clip_pytorch_model.bin:", "OpenCLIP", key, "'visual.conv1.weight'", "save_pretrained")
    refused(lambda: load_transformers_teacher("openclip", folder), *words)
