"""The table of the teachers from transformers. To add one, add a row.

Nothing here imports transformers, so the table can be read without it.
"""

from __future__ import annotations

from dataclasses import dataclass

from .transformers_patches import (
    Patches,
    clip_patches,
    last_patches,
    naflex_patches,
    radio_patches,
    siglip_patches,
    tips_patches,
)

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

    models: dict[str, tuple[str, Patches]]  # model_type in config.json -> class of transformers, extraction of patches
    normalisation: tuple[Triple, Triple]  # mean and standard deviation of RGB in [0, 1]
    text: TextRule | None = None  # None: no text tower in the space of the patches
    templates: str = "bare"  # the templates that suit it, by name in `prompts.TEMPLATES`
    residual: bool = False  # whether it takes `residual=True`
    activation: str | None = None  # of files in OpenCLIP's layout that name none; None: that layout is not read


TRANSFORMERS: dict[str, TeacherRow] = {
    "clip": TeacherRow(
        {"clip": ("CLIPModel", clip_patches)}, _CLIP, TextRule(), "clip7", residual=True, activation="quick_gelu"
    ),
    "openclip": TeacherRow(
        {"clip": ("CLIPModel", clip_patches)}, _CLIP, TextRule(), "clip7", residual=True, activation="gelu"
    ),
    "siglip": TeacherRow({"siglip": ("SiglipModel", siglip_patches)}, _HALF, TextRule(lower=True, pad=True), "siglip"),
    "siglip2": TeacherRow(  # those of fixed size are SigLIP models; the others are called NaFlex
        {"siglip": ("SiglipModel", siglip_patches), "siglip2": ("Siglip2Model", naflex_patches)},
        _HALF,
        TextRule(lower=True, pad=True),
        "siglip",
    ),
    "tipsv2": TeacherRow(
        {"tipsv2": ("Tipsv2Model", tips_patches)},
        _NONE,
        TextRule(lower=True, pad=True, mask=True),
        "tcl9",
        residual=True,
    ),
    "dinov2": TeacherRow(
        {
            "dinov2": ("Dinov2Model", last_patches),
            "dinov2_with_registers": ("Dinov2WithRegistersModel", last_patches),
        },
        _IMAGENET,
    ),
    "dinov3": TeacherRow({"dinov3_vit": ("DINOv3ViTModel", last_patches)}, _IMAGENET),
    "radio": TeacherRow({"radio": ("RadioModel", radio_patches)}, _NONE),  # normalises inside
}
