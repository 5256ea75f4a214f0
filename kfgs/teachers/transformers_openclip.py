"""Read CLIP in OpenCLIP's layout (for instance LAION's ViT-B-16 of LERF and LangSplat) as a CLIPModel of transformers."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._card import error_line
from .._files import read_json
from .checkpoint import read_checkpoint
from .transformers_source import explained, find_class, quiet, refuse_gaps, require_transformers

_CONFIG = "open_clip_config.json"
_WEIGHTS = ("open_clip_model.safetensors", "open_clip_pytorch_model.safetensors", "open_clip_pytorch_model.bin")
_NEEDED = ("visual.conv1.weight", "visual.proj", "visual.positional_embedding", "text_projection", "ln_final.weight")
_HEAD_WIDTHS = {1280: 80, 1408: 88, 1664: 104}  # image towers of ViT-H, g and bigG by their width; all others have 64

_TOWER = [  # OpenCLIP's names within a tower -> those of transformers; attention's input projection is split apart
    (r"^transformer\.resblocks\.(\d+)\.", r"encoder.layers.\1."),
    (r"\.attn\.out_proj\.", ".self_attn.out_proj."),
    (r"\.ln_1\.", ".layer_norm1."),
    (r"\.ln_2\.", ".layer_norm2."),
    (r"\.mlp\.c_fc\.", ".mlp.fc1."),
    (r"\.mlp\.c_proj\.", ".mlp.fc2."),
    (r"^conv1\.", "embeddings.patch_embedding."),
    (r"^class_embedding$", "embeddings.class_embedding"),
    (r"^positional_embedding$", "embeddings.position_embedding.weight"),
    (r"^token_embedding\.", "embeddings.token_embedding."),
    (r"^ln_pre\.", "pre_layrnorm."),  # spelt so in transformers
    (r"^ln_post\.", "post_layernorm."),
    (r"^ln_final\.", "final_layer_norm."),
]


def find_openclip(kind: str, source: Path | str, *, local_only: bool) -> Path | None:
    """The file with weights in OpenCLIP's layout in `source`; None if there is none, or `source` does not need it."""
    if isinstance(source, str):
        return _fetch(kind, source, local_only=local_only) if kind == "openclip" else None
    if source.is_file():
        return source
    if (source / "config.json").is_file() and any(source.glob("model*.safetensors")):
        return None
    return next((source / name for name in _WEIGHTS if (source / name).is_file()), None)


def _fetch(kind: str, source: str, *, local_only: bool) -> Path | None:
    """Download the weights of a hub repository in OpenCLIP's layout; None if it has another layout."""
    require_transformers()
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError

    def fetch(name: str) -> Path | None:
        try:
            return Path(hf_hub_download(source, name, local_files_only=local_only))
        except EntryNotFoundError as error:
            if isinstance(error, LocalEntryNotFoundError) and not local_only:  # the hub was not reached
                raise
            return None

    with explained(kind, source):
        if fetch(_CONFIG) is None:
            return None
        return next((file for name in _WEIGHTS if (file := fetch(name)) is not None), None)


def load_openclip(file: Path, *, activation: str) -> Any:
    """A CLIPModel with the weights of an OpenCLIP file.

    Sizes come from the weights' shapes, heads and activation from `open_clip_config.json` in the same folder. Without that
    file, a head has 64 channels (more in ViT-H, g and bigG), and `activation` is used: gelu, or OpenAI's quick_gelu.

    Raises:
        ValueError: if the file is not a CLIP of plain vision and text transformers, is OpenAI's TorchScript archive, or is
            damaged.
    """
    transformers = require_transformers()
    config_class, model_class = (find_class(transformers, name, "clip") for name in ("CLIPConfig", "CLIPModel"))
    if _is_torchscript(file):
        raise ValueError(
            f"{file}: expected the tensors of a CLIP, got a TorchScript archive as OpenAI publishes it, which is a "
            "program and is not run; use the hub id openai/clip-vit-base-patch16 (the weights of ViT-B-16.pt) or its like, "
            "a folder of that, or a file of OpenCLIP"
        )
    state = _unwrapped(read_checkpoint(file))
    known = read_json(file.with_name(_CONFIG)) if file.with_name(_CONFIG).is_file() else {}
    settings = known.get("model_cfg", {}) if isinstance(known, dict) else {}
    missing = [name for name in _NEEDED if name not in state]
    if missing:
        raise ValueError(
            f"{file}: expected a CLIP of two plain transformers in OpenCLIP's layout, got {len(state)} tensors, the first "
            f"{next(iter(state), 'none')!r} (no {missing[0]!r}); use a ViT model like ViT-B-16, or a folder of "
            "save_pretrained"
        )
    try:
        config = _config_of(config_class, state, settings, activation)
        mapped = _mapped(state)
        with quiet(transformers):
            model, info = model_class.from_pretrained(
                None, config=config, state_dict=mapped, dtype=torch.float32, output_loading_info=True
            )
    except Exception as error:  # shapes that do not fit, sizes of no model: transformers has its own errors for those
        raise ValueError(
            f"{file}: expected a CLIP in OpenCLIP's layout, but its weights do not fit together ({error_line(error)}); use "
            "the file and the config of one model"
        ) from error
    refuse_gaps(file, "CLIPModel", info)
    return model.eval()


def _is_torchscript(file: Path) -> bool:
    """Whether the file is OpenAI's TorchScript archive of CLIP."""
    try:
        with zipfile.ZipFile(file) as archive:
            return any(re.fullmatch(r"[^/]+/(constants\.pkl|code/.*)", name) for name in archive.namelist())
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError):
        return False  # not a zip archive; a damaged one is explained by `read_checkpoint`


def _unwrapped(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Remove the prefix of training on several devices, and convert to single precision."""
    floats = {name: tensor.float() for name, tensor in state.items() if tensor.is_floating_point()}  # no masks
    return {name.removeprefix("module."): tensor for name, tensor in floats.items()}


def _config_of(config_class: Any, state: dict[str, Tensor], settings: dict[str, Any], activation: str) -> Any:
    vision, text = settings.get("vision_cfg", {}), settings.get("text_cfg", {})
    width, _, patch, _ = state["visual.conv1.weight"].shape
    cells = round((state["visual.positional_embedding"].shape[0] - 1) ** 0.5)
    length, text_width = state["positional_embedding"].shape
    vocabulary = state["token_embedding.weight"].shape[0]
    act = ("quick_gelu" if settings.get("quick_gelu") else "gelu") if settings else activation
    image_heads = width // int(vision.get("head_width", _HEAD_WIDTHS.get(width, 64)))
    return config_class(
        projection_dim=state["text_projection"].shape[1],
        vision_config={
            "hidden_size": width,
            "intermediate_size": state["visual.transformer.resblocks.0.mlp.c_fc.weight"].shape[0],
            "num_hidden_layers": _layers(state, "visual.transformer."),
            "num_attention_heads": max(1, image_heads),
            "image_size": cells * patch,
            "patch_size": patch,
            "hidden_act": act,
            "projection_dim": state["visual.proj"].shape[1],
        },
        text_config={
            "hidden_size": text_width,
            "intermediate_size": state["transformer.resblocks.0.mlp.c_fc.weight"].shape[0],
            "num_hidden_layers": _layers(state, "transformer."),
            "num_attention_heads": int(text.get("heads", max(1, text_width // 64))),
            "max_position_embeddings": length,
            "vocab_size": vocabulary,
            "hidden_act": act,
            "projection_dim": state["text_projection"].shape[1],
            "bos_token_id": vocabulary - 2,
            "eos_token_id": vocabulary - 1,  # the text is pooled here
            "pad_token_id": 0,
        },
    )


def _layers(state: dict[str, Tensor], prefix: str) -> int:
    pattern = re.compile(re.escape(prefix) + r"resblocks\.(\d+)\.")
    return 1 + max(int(found[1]) for name in state if (found := pattern.match(name)))


def _mapped(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """OpenCLIP's names and layouts as those of transformers."""
    mapped = {
        "visual_projection.weight": state["visual.proj"].T.contiguous(),
        "text_projection.weight": state["text_projection"].T.contiguous(),
        "logit_scale": state.get("logit_scale", torch.tensor(0.0)).reshape(()),
    }
    for name, tensor in state.items():
        if name in ("visual.proj", "text_projection", "logit_scale", "logit_bias", "attn_mask"):
            continue
        tower = "vision_model." if name.startswith("visual.") else "text_model."
        inner = name.removeprefix("visual.")
        for pattern, replacement in _TOWER:
            inner = re.sub(pattern, replacement, inner)
        if ".attn.in_proj_" in inner:
            kind = inner.rpartition("_")[2]  # weight or bias
            stem = inner.partition(".attn.in_proj_")[0]
            for letter, part in zip("qkv", tensor.chunk(3), strict=True):
                mapped[f"{tower}{stem}.self_attn.{letter}_proj.{kind}"] = part.contiguous()
        else:
            mapped[tower + inner] = tensor
    return mapped
