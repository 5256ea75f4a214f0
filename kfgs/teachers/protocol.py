"""What kfgs asks of a 2-D encoder that is distilled into a field."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor


@runtime_checkable
class Teacher(Protocol):
    """An image encoder whose pixels live in the same space as its text, such as LSeg or a dense CLIP.

    Any object with these three members is a teacher; nothing needs to be inherited. `isinstance` checks that the
    members exist, not their signatures.

    Example:
        >>> import torch
        >>> class Colour:
        ...     name = "colour"
        ...
        ...     def encode_image(self, image):
        ...         return image[::2, ::2]
        ...
        ...     def encode_text(self, prompts):
        ...         return torch.eye(3)[: len(prompts)]
        >>> isinstance(Colour(), Teacher)
        True
    """

    @property
    def name(self) -> str:
        """A short name that goes into file names and reports."""
        ...

    def encode_image(self, image: Tensor) -> Tensor:  # image: [H, W, 3] in [0, 1] -> [h, w, D]
        """One feature per cell of a grid over the image; rows need not be unit, and h, w may be smaller than H, W."""
        ...

    def encode_text(self, prompts: list[str]) -> Tensor:  # -> [n, D]
        """One unit row per prompt, comparable by cosine with the rows of `encode_image`."""
        ...
