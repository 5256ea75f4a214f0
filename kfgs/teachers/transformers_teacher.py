"""Teachers over transformers: CLIP, SigLIP, TIPS, DINO, RADIO, read from a folder or a hub id."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import torch
from kornia.enhance import normalize as normalize_picture
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from .._check import check_choice, check_whole
from .protocol import PROMPTS_AT_ONCE, check_picture, check_prompts
from .tokenizer import clip_tokenizer
from .transformers_openclip import find_openclip, load_openclip
from .transformers_package import explained, load_complete
from .transformers_patches import patch_size
from .transformers_source import find_source, load_tokenizer_of, read_config, weights_of
from .transformers_table import TRANSFORMERS, TeacherRow

_Tokenize = Callable[[list[str]], tuple[Tensor, Tensor]]  # n prompts -> ids [n, T], mask [n, T] (0: padding)

_CLIP_VOCABULARY = 49408  # entries of the vocabulary of CLIP, which kfgs contains
_TOKENIZER_FILES = ("tokenizer.json", "vocab.json", "tokenizer.model", "spiece.model")


def load_transformers_teacher(
    kind: str, source: str | Path, *, size: int | None = None, local_only: bool = False
) -> TransformersTeacher:
    """Load one of the teachers of the table `TRANSFORMERS`.

    Args:
        kind: a name of the table: clip, openclip, siglip, siglip2, tipsv2, dinov2, dinov3, radio.
        source: a folder from `save_pretrained`, or a hub id `owner/name`, which is downloaded. clip and openclip also take
            a file or a folder in OpenCLIP's layout, but not OpenAI's .pt files (ViT-B-16.pt), which are TorchScript
            programs: use `openai/clip-vit-base-patch16` on the hub, which has the same weights.
        size: resize the longer side of pictures to this number of pixels; None: do not resize. A map has one cell per
            patch, so larger pictures give finer maps.
        local_only: use only the local cache for a hub id.

    Raises:
        ImportError: if transformers is missing (`pip install "kfgs[hf]"`), broken or too old.
        ValueError: if the options do not suit the kind, or the weights are of another model, damaged or incomplete.
    """
    check_choice("kind", kind, TRANSFORMERS)
    row = TRANSFORMERS[kind]
    if size is not None:
        check_whole("size", size, 1)
    place = find_source(kind, source)
    openclip = find_openclip(kind, place, local_only=local_only) if row.activation is not None else None
    if openclip is not None:
        model = load_openclip(kind, openclip, activation=str(row.activation))
        commit = openclip.parent.name if isinstance(place, str) else None
    else:
        name, commit = read_config(kind, place, local_only=local_only)
        with explained(kind, place):
            model = load_complete(name, place, place, **_from_hub(commit, local_only))
    weights = weights_of(openclip or place if isinstance(place, Path) else place, commit)
    identity = {"name": kind, "options": {"size": size}, "weights": weights}
    if isinstance(place, str):
        identity["source"] = place
    tokenize = _tokenize_of(kind, place, _from_hub(commit, local_only), model) if row.text is not None else None
    return TransformersTeacher(model, row, identity, tokenize)


def _from_hub(commit: str | None, local_only: bool) -> dict[str, Any]:
    return {"local_files_only": local_only} | ({} if commit is None else {"revision": commit})


def _tokenize_of(kind: str, source: Path | str, options: dict[str, Any], model: Any) -> _Tokenize:
    """The tokenizer next to the weights; if there is none and the kind uses CLIP's vocabulary, that of kfgs.

    It is read at the first prompt; without prompts it is not needed.
    """
    row, words = TRANSFORMERS[kind], model.config.text_config
    folder = source.parent if isinstance(source, Path) and source.is_file() else source
    rule, longest = row.text, int(words.max_position_embeddings)
    assert rule is not None

    @cache
    def load() -> Any:
        if isinstance(folder, str) or any((folder / name).is_file() for name in _TOKENIZER_FILES):
            return load_tokenizer_of(kind, folder, **options)
        if row.activation is not None and words.vocab_size == _CLIP_VOCABULARY:
            return clip_tokenizer()
        raise ValueError(
            f"{folder}: expected a tokenizer next to the weights of teacher {kind!r} ({', '.join(_TOKENIZER_FILES[:2])}, "
            "...), got none; download those files too, or use a text table made elsewhere"
        )

    def tokenize(prompts: list[str]) -> tuple[Tensor, Tensor]:
        tokens = load()(
            [prompt.lower() for prompt in prompts] if rule.lower else prompts,
            **({"padding": "max_length", "max_length": longest} if rule.pad else {"padding": True}),
            padding_side="right",  # siglip pools at the last position, and the tokenizer of siglip2 would pad in front
            return_attention_mask=True,
        )
        for prompt, mask in zip(prompts, tokens["attention_mask"], strict=True):
            if sum(mask) > longest:
                raise ValueError(
                    f"prompts: expected at most {longest} tokens for teacher {kind!r}, got {sum(mask)} in "
                    f"{prompt[:40]!r}; shorten it"
                )
        return torch.tensor(tokens["input_ids"]), torch.tensor(tokens["attention_mask"])

    return tokenize


class TransformersTeacher:
    """A vision transformer of transformers as a teacher; made by `load_transformers_teacher`.

    A picture is resized (bilinear, antialiased) so that both sides are multiples of the patch size, normalised as the
    model was trained, and gives one feature per patch.
    """

    def __init__(self, model: Any, row: TeacherRow, identity: dict[str, Any], tokenize: _Tokenize | None) -> None:
        self.model, self.row, self.identity = model, row, identity
        self.name: str = identity["name"]
        self.templates, self._tokenize = row.templates, tokenize

    def __repr__(self) -> str:
        size, device = self.identity["options"]["size"], next(self.model.parameters()).device
        return f"TransformersTeacher({self.name!r}, size={size}, device={device})"

    def to(self, device: torch.device | str) -> TransformersTeacher:
        """Move the model to a device; features are computed and returned there."""
        self.model.to(device)
        return self

    @torch.inference_mode()
    def encode_image(self, image: Tensor) -> Tensor:  # [3, H, W] RGB in [0, 1] -> [D, h, w]
        """One feature per patch, not normalised."""
        check_picture(image)
        weight = next(self.model.parameters())
        ph, pw = patch_size(self.model)
        height, width = fit_patches(
            (int(image.shape[1]), int(image.shape[2])), (ph, pw), self.identity["options"]["size"]
        )
        pixels = resize_picture(image.to(weight.device, weight.dtype), (height, width))[None]
        mean, std = map(weight.new_tensor, self.row.normalisation)
        pixels = normalize_picture(pixels, mean, std)
        tokens = self.row.patches(self.model, pixels)  # [1, h*w, D]
        return tokens[0].T.reshape(-1, height // ph, width // pw).float().contiguous()

    @torch.inference_mode()
    def encode_text(self, prompts: Sequence[str]) -> Tensor:  # -> [n, D]
        """One unit row per prompt; a NotImplementedError if the model has no text tower in the space of its patches."""
        rule = self.row.text
        if rule is None or self._tokenize is None:
            able = [name for name, row in TRANSFORMERS.items() if row.text]
            raise NotImplementedError(
                f"teacher {self.name!r}: expected one with a text encoder, got one that sees only pictures; use "
                f"{', '.join(able)} or lseg for words, or query it by examples"
            )
        check_prompts(prompts)
        device = next(self.model.parameters()).device
        rows = []
        for start in range(0, len(prompts), PROMPTS_AT_ONCE):
            ids, mask = self._tokenize(list(prompts[start : start + PROMPTS_AT_ONCE]))
            named = {"attention_mask": mask.to(device)} if rule.mask else {}
            rows.append(self.model.get_text_features(input_ids=ids.to(device), **named).pooler_output.float())
        return normalize(torch.cat(rows), dim=1)


def fit_patches(size: tuple[int, int], patch: tuple[int, int], longest: int | None) -> tuple[int, int]:
    """The (height, width) a picture is resized to: longer side `longest`, each side the nearest multiple of its patch.

    Example:
        >>> fit_patches((480, 640), (14, 14), None)  # 34.3 and 45.7 patches
        (476, 644)
    """
    scale = 1.0 if longest is None else longest / max(size)
    height, width = (max(1, int(side * scale / cell + 0.5)) * cell for side, cell in zip(size, patch, strict=True))
    return height, width


def resize_picture(image: Tensor, size: tuple[int, int]) -> Tensor:  # [3, H, W] -> [3, *size]
    """Resize bilinearly, with antialiasing (torch's: kornia's blurs with a wider kernel, and more slowly)."""
    if tuple(image.shape[1:]) == size:
        return image
    return interpolate(image[None], size, mode="bilinear", align_corners=False, antialias=True)[0]
