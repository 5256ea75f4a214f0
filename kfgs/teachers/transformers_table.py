"""The table of the teachers from transformers. To add one, add a row.

Nothing here imports transformers, so the table can be read without it.
"""

from __future__ import annotations

from dataclasses import dataclass

from .transformers_patches import Patches, clip_patches, last_patches, radio_patches, siglip_patches

Triple = tuple[float, float, float]

_CLIP = ((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711))  # mean and std of CLIP's pictures
_IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
_HALF = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
_NONE = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))  # pictures as they are, in [0, 1]


@dataclass(frozen=True)
class TextRule:
    """How prompts become ids, as in the training of the text tower."""

    lower: bool = False  # write prompts in small letters first
    pad: bool = False  # fill up to the tower's length: some towers pool at the last token, or over all tokens
    mask: bool = False  # pass a mask of the padding to the tower


@dataclass(frozen=True)
class TeacherRow:
    """One kind of teacher."""

    models: dict[str, str]  # model_type in config.json -> class of transformers
    patches: Patches
    normalisation: tuple[Triple, Triple]  # mean and standard deviation of RGB in [0, 1]
    text: TextRule | None = None  # None: no text tower in the space of the patches
    templates: str = "bare"  # the templates that suit it, by name in `prompts.TEMPLATES`
    activation: str | None = None  # of files in OpenCLIP's layout that name none; None: that layout is not read


_CLIP_MODEL, _SIGLIP_MODEL = {"clip": "CLIPModel"}, {"siglip": "SiglipModel"}
_DINOV2_MODELS = {"dinov2": "Dinov2Model", "dinov2_with_registers": "Dinov2WithRegistersModel"}
_LOWER, _MASKED = TextRule(lower=True, pad=True), TextRule(lower=True, pad=True, mask=True)

TRANSFORMERS: dict[str, TeacherRow] = {
    "clip": TeacherRow(_CLIP_MODEL, clip_patches, _CLIP, TextRule(), "clip7", activation="quick_gelu"),
    "openclip": TeacherRow(_CLIP_MODEL, clip_patches, _CLIP, TextRule(), "clip7", activation="gelu"),
    "siglip": TeacherRow(_SIGLIP_MODEL, siglip_patches, _HALF, _LOWER, "siglip"),
    "siglip2": TeacherRow(_SIGLIP_MODEL, siglip_patches, _HALF, _LOWER, "siglip"),  # of fixed size (not NaFlex)
    "tipsv2": TeacherRow({"tipsv2": "Tipsv2Model"}, last_patches, _NONE, _MASKED, "tcl9"),
    "dinov2": TeacherRow(_DINOV2_MODELS, last_patches, _IMAGENET),
    "dinov3": TeacherRow({"dinov3_vit": "DINOv3ViTModel"}, last_patches, _IMAGENET),
    "radio": TeacherRow({"radio": "RadioModel"}, radio_patches, _NONE),  # normalises inside
}
