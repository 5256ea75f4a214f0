"""LSeg as a teacher: a picture to features at its own resolution, and prompts into the same space, out of one checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from ..bpe import load_tokenizer
from ..checkpoint import read_checkpoint, weights_digest
from ..protocol import PROMPTS_AT_ONCE, check_picture, check_prompts
from .keys import network_from_state, text_from_state
from .network import LSegConfig, LSegNetwork
from .options import LSegOptions
from .text import ClipText
from .windows import multi_scale_features

Tokenize = Callable[[list[str]], Tensor]  # n prompts -> [n, 77] int64


class LSeg(nn.Module):
    """The LSeg encoder (Li et al., ICLR 2022): 512 features per pixel in the space of CLIP ViT-B/32's text; see `load_lseg`.

    Features are the *sum* over scales, not normalised, as the paper's script writes them: kfgs compares by cosine.

    Args:
        network: the image network, in evaluation mode.
        options: how pictures are evaluated.
        load_text: loads the text tower and its tokenizer at the first prompt; None: the teacher has no text encoder.
        digest: computes the SHA-256 of the weights; called when `identity` is first read.
    """

    name = "lseg"

    def __init__(
        self,
        network: LSegNetwork,
        options: LSegOptions | None = None,
        *,
        load_text: Callable[[], tuple[ClipText, Tokenize]] | None = None,
        digest: Callable[[], str] | None = None,
    ) -> None:
        super().__init__()
        self.network = network
        self.options = LSegOptions() if options is None else options
        self.text: ClipText | None = None
        self._tokenizer: Tokenize | None = None
        self._load_text = load_text
        self._digest = digest
        self._weights: str | None = None
        self.eval()

    def __repr__(self) -> str:
        return f"LSeg({self.options}, device={self.device})"

    def train(self, mode: bool = True) -> LSeg:
        """Stay in evaluation mode: a teacher is not trained, and its normalisation must not follow the pictures."""
        return super().train(False)

    @property
    def device(self) -> torch.device:
        """The device of the network."""
        return next(self.network.parameters()).device

    @property
    def identity(self) -> dict[str, Any]:
        """JSON of what decides the features: options, SHA-256 of the checkpoint (taken once), sizes if not LSeg's own."""
        if self._weights is None and self._digest is not None:
            self._weights = self._digest()
        found: dict[str, Any] = {"name": self.name, "options": _plain(self.options), "weights": self._weights}
        if self.network.config != LSegConfig():
            found["config"] = _plain(self.network.config)
        return found

    @torch.no_grad()
    def encode_image(self, image: Tensor) -> Tensor:  # [3, H, W] RGB in [0, 1] -> [D, h, w] float32
        """Features of one picture, at the size `options.map_size`.

        The picture is resized to it (bilinear, corners aligned, no antialiasing, as in the paper's script), and
        evaluated in windows; see `windows.multi_scale_features`.

        Raises:
            TypeError: if `image` is no tensor of floats.
            ValueError: if it is not a finite picture [3, H, W] in [0, 1].
        """
        check_picture(image)
        window = self.network.config.window
        size = self.options.map_size(image.shape[1], image.shape[2], window=window)
        picture = image.to(self.device, torch.float32) * 2 - 1
        if size != tuple(image.shape[1:]):
            picture = functional.interpolate(picture[None], size=size, mode="bilinear", align_corners=True)[0]
        return multi_scale_features(
            picture, self._head, window=window, scales=self.options.scales, flip=self.options.flip
        )

    @torch.no_grad()
    def encode_text(self, prompts: Sequence[str]) -> Tensor:  # -> [n, D] float32
        """One unit row per prompt, as it stands: LSeg is given bare labels, without a sentence around them.

        Raises:
            TypeError: if `prompts` is one text, or holds something else than texts.
            ValueError: if there are none, or one is too long.
            NotImplementedError: if the teacher was made without text.
            FileNotFoundError: if the vocabulary of CLIP's tokenizer is not found.
        """
        check_prompts(prompts)
        if self.text is None:
            self._bring_text()
        assert self.text is not None
        assert self._tokenizer is not None
        ids = self._tokenizer(list(prompts)).to(self.device)  # [n, 77]
        rows = torch.cat([self.text(part) for part in ids.split(PROMPTS_AT_ONCE)])
        return functional.normalize(rows.float(), dim=1)

    def _bring_text(self) -> None:
        if self._load_text is None:
            raise NotImplementedError(
                "teacher 'lseg': expected one with a text tower, got one made without; load it with load_lseg"
            )
        text, self._tokenizer = self._load_text()
        self.text = text.to(self.device).eval()

    def _head(self, x: Tensor) -> Tensor:  # [1, 3, S, S] -> [1, D, S/2, S/2] float32
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.options.precision == "bfloat16"):
            features: Tensor = self.network(x)
        return features.float()


def load_lseg(
    weights: str | Path,
    *,
    options: LSegOptions | None = None,
    size: Literal["auto"] | tuple[int, int] | None = "auto",
    scales: Sequence[float] | None = None,
    flip: bool | None = None,
    fast: bool = False,
    bpe: str | Path | None = None,
    config: LSegConfig | None = None,
) -> LSeg:
    """Load LSeg from the checkpoint its authors published, `demo_e200.ckpt` (backbone clip_vitl16_384).

    The file is mapped into memory where it can be; its text tower is read at the first prompt.

    Args:
        weights: the checkpoint, or its tensors in a .pt or .safetensors file.
        options: how pictures are evaluated, as a whole; or by the next four.
        size: see `LSegOptions.size`.
        scales: see `LSegOptions.scales`; those of the paper, or of `fast`, if None.
        flip: see `LSegOptions.flip`; True, or False if `fast`, if None.
        fast: start from `LSegOptions.fast()`, not from the paper's options.
        bpe: the vocabulary of CLIP's tokenizer; see `load_tokenizer` for where it is looked for if None.
        config: sizes of the network, LSeg's own if None.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged or of another network, or options are given twice.
    """
    config = LSegConfig() if config is None else config
    options = _options(options, size, scales, flip, fast)
    network = network_from_state(read_checkpoint(weights), config, source=str(weights))
    return LSeg(
        network,
        options,
        load_text=partial(_load_text, weights, bpe, config),
        digest=partial(weights_digest, weights),
    )


def _options(
    options: LSegOptions | None,
    size: Literal["auto"] | tuple[int, int] | None,
    scales: Sequence[float] | None,
    flip: bool | None,
    fast: bool,
) -> LSegOptions:
    if options is not None:
        if size != "auto" or scales is not None or flip is not None or fast:
            raise ValueError(
                "options: expected either options or size, scales, flip, fast, got both; use dataclasses.replace"
            )
        return options
    base = LSegOptions.fast() if fast else LSegOptions()
    return replace(
        base,
        size=size,
        scales=base.scales if scales is None else tuple(scales),
        flip=base.flip if flip is None else flip,
    )


def _load_text(weights: str | Path, bpe: str | Path | None, config: LSegConfig) -> tuple[ClipText, Tokenize]:
    tokenizer = load_tokenizer(bpe)  # first, it is the one that may be missing
    return text_from_state(read_checkpoint(weights), config, source=str(weights)), tokenizer


def _plain(values: LSegOptions | LSegConfig) -> dict[str, Any]:
    """Fields as JSON has them: lists for tuples, so that a manifest read again is equal."""
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(values).items()}
