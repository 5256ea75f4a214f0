"""Tiny models of every teacher of the table, with random weights, written as `save_pretrained` writes the real ones."""

import json
from pathlib import Path

import torch
import transformers
from transformers import CLIPTokenizer, Siglip2Tokenizer, Tipsv2Tokenizer

LETTERS = "abcdefghijklmnopqrstuvwxyz"
TOWER = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
CHANNELS = {
    "clip": 24, "openclip": 24, "siglip": 32, "siglip2": 32, "tipsv2": 32, "dinov2": 32,
    "dinov2-registers": 32, "dinov3": 32, "radio": 32,
}  # fmt: skip
KINDS = {"dinov2-registers": "dinov2"}  # others are named as their kind


def text(**more):
    ids = {"bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 0}
    return {**TOWER, "intermediate_size": 48, "vocab_size": 64, **ids, **more}


def configs() -> dict:
    clip = transformers.CLIPConfig(
        projection_dim=24,
        vision_config={**TOWER, "intermediate_size": 48, "image_size": 32, "patch_size": 8, "projection_dim": 24},
        text_config=text(max_position_embeddings=16, projection_dim=24),
    )
    tower = {**TOWER, "intermediate_size": 48, "patch_size": 8}
    words = text(max_position_embeddings=16, projection_size=32)
    dino = {**TOWER, "image_size": 32, "patch_size": 8}
    return {
        "clip": clip,
        "openclip": clip,
        "siglip": transformers.SiglipConfig(vision_config={**tower, "image_size": 32}, text_config=words),
        "siglip2": transformers.SiglipConfig(vision_config={**tower, "image_size": 32}, text_config=words),
        "tipsv2": transformers.Tipsv2Config(
            vision_config={**dino, "mlp_ratio": 2}, text_config=text(max_position_embeddings=16)
        ),
        "dinov2": transformers.Dinov2Config(**dino, mlp_ratio=2),
        "dinov2-registers": transformers.Dinov2WithRegistersConfig(**dino, mlp_ratio=2, num_register_tokens=4),
        "dinov3": transformers.DINOv3ViTConfig(**dino, intermediate_size=48, num_register_tokens=4),
        "radio": transformers.RadioConfig(**dino, mlp_ratio=2.0, max_img_size=64),
    }


def tokenizer(name: str):
    """A tokenizer of single letters, of the class that the real model has."""
    if name in ("clip", "openclip"):
        words = ["<|startoftext|>", "<|endoftext|>", *LETTERS, *(f"{letter}</w>" for letter in LETTERS)]
        return CLIPTokenizer(vocab={word: i for i, word in enumerate(words)}, merges=[], model_max_length=16)
    if name == "tipsv2":
        words = ["<pad>", "<unk>", "▁", *LETTERS]
        return Tipsv2Tokenizer(vocab={word: i for i, word in enumerate(words)}, merges=[], model_max_length=16)
    words = ["<pad>", "<eos>", "<bos>", "<unk>", "<mask>", "▁", *LETTERS]
    return Siglip2Tokenizer(vocab={word: i for i, word in enumerate(words)}, merges=[], model_max_length=16)


def write_teacher(folder: Path, name: str) -> Path:
    """Write the tiny model `name`, a key of CHANNELS, and its tokenizer if it reads text."""
    config = configs()[name]
    torch.manual_seed(sorted(CHANNELS).index(name))
    model = getattr(transformers, {
        "CLIPConfig": "CLIPModel", "SiglipConfig": "SiglipModel",
        "Tipsv2Config": "Tipsv2Model", "Dinov2Config": "Dinov2Model", "RadioConfig": "RadioModel",
        "Dinov2WithRegistersConfig": "Dinov2WithRegistersModel", "DINOv3ViTConfig": "DINOv3ViTModel",
    }[type(config).__name__])(config)  # fmt: skip
    with torch.no_grad():
        for parameter in model.parameters():  # the drawn ones are so small that everything looks like its bias
            if parameter.ndim:
                parameter.add_(0.1 * torch.randn_like(parameter))
    model.save_pretrained(folder)
    if hasattr(config, "text_config"):
        tokenizer(name).save_pretrained(folder)
    assert json.loads((folder / "config.json").read_text())["model_type"]
    return folder
