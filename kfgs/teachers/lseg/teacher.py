"""LSeg as a teacher: a picture to features at its own resolution, and prompts into the same space, out of one checkpoint."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from kornia.geometry.transform import resize
from torch import Tensor, nn
from torch.nn import functional

from ..._check import check_choice, check_range, check_size
from ..._files import digest_file
from ..checkpoint import read_checkpoint
from ..protocol import PROMPTS_AT_ONCE, check_picture, check_prompts
from ..tokenizer import tokenize
from .keys import network_from_state, text_from_state
from .network import LSegConfig, LSegNetwork
from .windows import BASE_OVER_CROP, multi_scale_features

PAPER_SCALES = (0.75, 1.0, 1.25, 1.75)
Size = Literal["auto"] | tuple[int, int] | None


@dataclass(frozen=True)
class LSegOptions:
    """How LSeg looks at a picture. The defaults are the paper's, except that pictures that are not 4:3 keep their aspect."""

    scales: tuple[float, ...] = PAPER_SCALES
    """Scales whose features are summed; 1 is a long side of 520 pixels."""
    flip: bool = True
    """Average with the features of the mirrored picture."""
    size: Size = "auto"
    """Size of the map, and of the resized picture. "auto": long side 480 pixels, or the picture's if that is smaller, aspect
    kept, rounded half up. (height, width): this size if the picture is wider than `width`, else the picture's, as in the
    paper's script, with any aspect; the paper's is (360, 480). None: the picture's size."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Arithmetic of the network; the features are float32 in any case."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "scales", tuple(float(scale) for scale in self.scales))
        if not self.scales:
            raise ValueError("scales: expected at least one scale, got none; pass (1.0,)")
        for scale in self.scales:
            check_range("scales", scale, 0.0, 16.0, closed=(False, True))  # 8320 pixels; more is a slip
        check_choice("precision", self.precision, ("float32", "bfloat16"))
        if self.size is not None and self.size != "auto":
            check_size(self.size)
            object.__setattr__(self, "size", tuple(map(int, self.size)))

    @staticmethod
    def fast() -> LSegOptions:
        """One scale, one window, no mirroring: the network runs once for a picture, whatever its shape, not 26 times."""
        return LSegOptions(scales=(1 / BASE_OVER_CROP,), flip=False)

    def map_size(self, height: int, width: int, *, window: int = 480) -> tuple[int, int]:
        """Size (h, w) of the map of a picture of that size.

        Example:
            >>> LSegOptions().map_size(480, 640), LSegOptions().map_size(479, 639), LSegOptions().map_size(640, 360)
            ((360, 480), (360, 480), (480, 270))
        """
        if self.size is None or (self.size == "auto" and max(height, width) <= window):
            return height, width
        if self.size == "auto":
            ratio = window / max(height, width)
            h, w = (max(1, math.floor(side * ratio + 0.5)) for side in (height, width))
            return h, w
        assert not isinstance(self.size, str)
        return self.size if width > self.size[1] else (height, width)


class LSeg(nn.Module):
    """The LSeg encoder (Li et al., ICLR 2022): 512 features per pixel in the space of CLIP ViT-B/32's text; see `load_lseg`.

    Features are the *sum* over scales, not normalised, as the paper's script writes them: kfgs compares by cosine.

    `load_text` is called at the first prompt, `weights` (their SHA-256) when `identity` is first read.
    """

    name = "lseg"

    def __init__(
        self,
        network: LSegNetwork,
        options: LSegOptions | None = None,
        *,
        load_text: Callable[[], Any] | None = None,
        weights: Callable[[], str | None] = lambda: None,
    ) -> None:
        super().__init__()
        self.network = network
        self.options = LSegOptions() if options is None else options
        self.text: Any = None
        self._load_text, self._digest = load_text, weights
        self._weights: str | None = None
        self.eval()

    def __repr__(self) -> str:
        return f"LSeg({self.options}, device={self._device()})"

    def train(self, mode: bool = True) -> LSeg:
        """Stay in evaluation mode: a teacher is not trained, and its normalisation must not follow the pictures."""
        return super().train(False)

    @property
    def identity(self) -> dict[str, Any]:
        """JSON of what decides the features: options, SHA-256 of the checkpoint (taken once), sizes if not LSeg's own."""
        self._weights = self._weights or self._digest()
        config = self.network.config
        parts = {"options": self.options} | ({} if config == LSegConfig() else {"config": config})
        known = {name: asdict(part) for name, part in parts.items()}
        # as JSON has it, lists for tuples, so that a manifest read again is equal
        return json.loads(json.dumps({"name": self.name, "weights": self._weights} | known))  # type: ignore[no-any-return]

    @torch.no_grad()
    def encode_image(self, image: Tensor) -> Tensor:  # [3, H, W] RGB in [0, 1] -> [D, h, w] float32
        """Features of one picture, resized to `options.map_size` as in the paper's script (bilinear, corners aligned)."""
        check_picture(image)
        window = self.network.config.window
        size = self.options.map_size(image.shape[1], image.shape[2], window=window)
        picture = image.to(self._device(), torch.float32) * 2 - 1
        if size != tuple(image.shape[1:]):
            picture = resize(picture, size, align_corners=True)
        return multi_scale_features(
            picture, self._head, window=window, scales=self.options.scales, flip=self.options.flip
        )

    @torch.no_grad()
    def encode_text(self, prompts: Sequence[str]) -> Tensor:  # -> [n, D] float32
        """One unit row per prompt, as it stands: LSeg is given bare labels, without a sentence around them."""
        check_prompts(prompts)
        if self.text is None:
            if self._load_text is None:
                raise NotImplementedError(
                    "teacher 'lseg': expected one with a text tower, got one made without; load it with load_lseg"
                )
            self.text = self._load_text().to(self._device()).eval()
        ids = tokenize(prompts, self.network.config.context).to(self._device())
        rows = torch.cat([self.text(input_ids=part).text_embeds for part in ids.split(PROMPTS_AT_ONCE)])
        return functional.normalize(rows.float(), dim=1)

    def _device(self) -> torch.device:
        return next(self.network.parameters()).device

    def _head(self, x: Tensor) -> Tensor:  # [1, 3, S, S] -> [1, D, S/2, S/2] float32
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.options.precision == "bfloat16"):
            features: Tensor = self.network(x)
        return features.float()


def load_lseg(
    weights: str | Path,
    *,
    fast: bool = False,
    size: Size = "auto",
    scales: Sequence[float] | None = None,
    flip: bool | None = None,
    precision: Literal["float32", "bfloat16"] = "float32",
    config: LSegConfig | None = None,
) -> LSeg:
    """Load LSeg from the checkpoint its authors published, `demo_e200.ckpt` (backbone clip_vitl16_384).

    The file is mapped into memory where it can be; its text tower is read at the first prompt.

    Args:
        weights: the checkpoint, or its tensors in a .pt or .safetensors file.
        fast: one run of the network per picture (`LSegOptions.fast`) instead of the paper's 26.
        size, scales, flip, precision: see `LSegOptions`; None: the paper's, or those of `fast`.
        config: sizes of the network, LSeg's own if None.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged or of another network.
    """
    config, base = config or LSegConfig(), LSegOptions.fast() if fast else LSegOptions()
    scales, flip = base.scales if scales is None else tuple(scales), base.flip if flip is None else flip
    options, source = LSegOptions(scales, flip, size, precision), str(weights)

    def load_text() -> Any:
        return text_from_state(read_checkpoint(weights), config, source=source)

    network = network_from_state(read_checkpoint(weights), config, source=source)
    return LSeg(network, options, load_text=load_text, weights=partial(digest_file, weights))
