"""Read CLIP in OpenCLIP's layout, which is OpenAI's and that of LSeg's text tower, as a model of transformers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._files import read_json
from .checkpoint import read_checkpoint
from .transformers_package import explained, load_complete, require_transformers

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


def load_openclip(kind: str, file: Path, *, activation: str) -> Any:
    """A CLIPModel with the weights of an OpenCLIP file.

    Sizes come from the weights' shapes, heads and activation from `open_clip_config.json` in the same folder. Without that
    file, a head has 64 channels (more in ViT-H, g and bigG), and `activation` is used: gelu, or OpenAI's quick_gelu.

    Raises:
        ValueError: if the file is not a CLIP of plain vision and text transformers, or is damaged.
    """
    state = {name.removeprefix("module."): value for name, value in read_checkpoint(file).items()}
    known = read_json(file.with_name(_CONFIG)) if file.with_name(_CONFIG).is_file() else {}
    settings = known.get("model_cfg", {}) if isinstance(known, dict) else {}
    missing = [name for name in _NEEDED if name not in state]
    if missing:
        raise ValueError(
            f"{file}: expected a CLIP of two plain transformers in OpenCLIP's layout, got {len(state)} tensors, the first "
            f"{next(iter(state), 'none')!r} (no {missing[0]!r}); use a ViT model like ViT-B-16, or a folder of "
            "save_pretrained"
        )
    with explained(kind, file):  # shapes that do not fit, sizes of no model
        act = ("quick_gelu" if settings.get("quick_gelu") else "gelu") if settings else activation
        width, _, patch, _ = state["visual.conv1.weight"].shape
        cells = round((state["visual.positional_embedding"].shape[0] - 1) ** 0.5)
        head_width = int(settings.get("vision_cfg", {}).get("head_width", _HEAD_WIDTHS.get(width, 64)))
        text_width = state["ln_final.weight"].shape[0]
        config = require_transformers().CLIPConfig(
            projection_dim=state["text_projection"].shape[1],
            vision_config={
                **_sizes(state, "visual.", max(1, width // head_width), act),
                "image_size": cells * patch,
                "patch_size": patch,
                "projection_dim": state["visual.proj"].shape[1],
            },
            text_config=_text_config(state, settings.get("text_cfg", {}).get("heads", max(1, text_width // 64)), act),
        )
        return load_complete("CLIPModel", file, None, config=config, state_dict=_mapped(state))


def load_text_tower(source: str, state: dict[str, Tensor], heads: int) -> Any:
    """The text tower of a CLIP of OpenAI in OpenCLIP's names, as a CLIPTextModelWithProjection."""
    with explained("lseg", Path(source), "a text tower"):
        config = require_transformers().CLIPTextConfig(**_text_config(state, heads, "quick_gelu"))
        mapped = {name: value for name, value in _mapped(state).items() if name.startswith("text_")}
        return load_complete("CLIPTextModelWithProjection", Path(source), None, config=config, state_dict=mapped)


def _sizes(state: dict[str, Tensor], tower: str, heads: int, activation: str) -> dict[str, Any]:
    """The sizes of a tower by the shapes of its weights."""
    layers = [re.match(re.escape(tower) + r"transformer\.resblocks\.(\d+)\.", name) for name in state]
    hidden, width = state[f"{tower}transformer.resblocks.0.mlp.c_fc.weight"].shape
    return {
        "hidden_size": width,
        "intermediate_size": hidden,
        "num_hidden_layers": 1 + max(int(match[1]) for match in layers if match),
        "num_attention_heads": heads,
        "hidden_act": activation,
    }


def _text_config(state: dict[str, Tensor], heads: int, activation: str) -> dict[str, Any]:
    vocabulary = state["token_embedding.weight"].shape[0]
    return {
        **_sizes(state, "", int(heads), activation),
        "max_position_embeddings": state["positional_embedding"].shape[0],
        "vocab_size": vocabulary,
        "projection_dim": state["text_projection"].shape[1],
        "bos_token_id": vocabulary - 2,
        "eos_token_id": vocabulary - 1,  # the text is pooled here
        "pad_token_id": 0,
    }


def _mapped(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """OpenCLIP's names and layouts as those of transformers, in float32; masks of attention are left out."""
    mapped: dict[str, Tensor] = {"logit_scale": torch.tensor(0.0)}
    for name, value in state.items():
        if not value.is_floating_point() or name in ("logit_bias", "attn_mask"):
            continue
        tensor = value.float()
        if name == "logit_scale":
            mapped[name] = tensor.reshape(())
        elif name in ("visual.proj", "text_projection"):
            mapped[name.replace(".proj", "_projection") + ".weight"] = tensor.T.contiguous()
        else:
            inner = name.removeprefix("visual.")
            for pattern, replacement in _TOWER:
                inner = re.sub(pattern, replacement, inner)
            inner = ("vision_model." if name.startswith("visual.") else "text_model.") + inner
            block, fused, kind = inner.partition(".attn.in_proj_")  # kind: weight or bias
            if not fused:
                mapped[inner] = tensor
                continue
            for letter, part in zip("qkv", tensor.chunk(3), strict=True):
                mapped[f"{block}.self_attn.{letter}_proj.{kind}"] = part.contiguous()
    return mapped
