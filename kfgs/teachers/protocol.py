"""The interface of a teacher, a 2-D encoder that is distilled into a field; any function can become one."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from .._check import as_tensor, check_shapes
from ..scenes.extract import as_encoder

_ROUNDING = 1e-4  # a resampled picture may exceed [0, 1] by this much

PROMPTS_AT_ONCE = 64  # 60 MB of activations in CLIP ViT-L's text tower


@runtime_checkable
class Teacher(Protocol):
    """An image encoder, usually with a text encoder into the same space: LSeg, or a dense CLIP.

    Any object with these three members is a teacher. Three more are used if they exist: `to(device)`; `templates`, the
    prompts that suit its texts; and `identity`, JSON of what the features depend on, so that maps of other weights are not
    mixed. Without `identity`, its `name` and its `version` (a text) stand for it.

    **Convention**: here, pictures and features have the channels first; kfgs's maps have them last ([h, w, D]).

    Example:
        >>> class Colour:
        ...     name = "colour"
        ...
        ...     def encode_image(self, image):
        ...         return image[:, ::2, ::2]
        ...
        ...     def encode_text(self, prompts):
        ...         return torch.eye(3)[: len(prompts)]
        >>> isinstance(Colour(), Teacher)
        True
    """

    @property
    def name(self) -> str:
        """A short name for file names and reports."""
        ...

    def encode_image(self, image: Tensor) -> Tensor:  # image: [3, H, W] RGB in [0, 1] -> [D, h, w]
        """One feature per cell of a grid over the image, of any length; h, w may be smaller than H, W."""
        ...

    def encode_text(self, prompts: Sequence[str]) -> Tensor:  # -> [n, D]
        """One unit row per prompt, comparable by cosine with the features of `encode_image`.

        Raises:
            NotImplementedError: if the teacher has no text encoder.
        """
        ...


class CallableTeacher:
    """A function from pictures to features as a teacher.

    Args:
        images: [3, H, W] RGB in [0, 1] -> [D, h, w].
        text: n prompts -> [n, D]; rows are normalised. None: the teacher has no text encoder.
        name: a short name; None: the function's name.
        version: change it when the features change, so that maps of two versions are not mixed.

    Example:
        >>> teacher = CallableTeacher(lambda image: image[:, ::4, ::4], name="thumbnail")
        >>> teacher.encode_image(torch.zeros(3, 8, 8)).shape
        torch.Size([3, 2, 2])
    """

    def __init__(
        self,
        images: Callable[[Tensor], Tensor],
        text: Callable[[Sequence[str]], Tensor] | None = None,
        *,
        name: str | None = None,
        version: str = "",
    ) -> None:
        if not callable(images):
            raise TypeError(
                f"images: expected a function from [3, H, W] to [D, h, w], got {type(images).__name__}; pass a callable"
            )
        self._images, self._text, self.version = images, text, version
        self.name = name or getattr(images, "__name__", type(images).__name__).strip("<>")

    def __repr__(self) -> str:
        return f"CallableTeacher({self.name!r}, text={self._text is not None})"

    def encode_image(self, image: Tensor) -> Tensor:  # [3, H, W] -> [D, h, w]
        """Call the function."""
        return self._images(image)

    def encode_text(self, prompts: Sequence[str]) -> Tensor:  # [n, D]
        """Call the function for text; a NotImplementedError if there is none."""
        if self._text is None:
            raise NotImplementedError(
                f"teacher {self.name!r}: expected one with a text encoder, got one without; pass text=..., or embed the "
                "prompts elsewhere and give the rows to LabelSet"
            )
        check_prompts(prompts)
        rows = self._text(list(prompts))
        check_shapes((f"text of {self.name}", rows, (len(prompts), "D")))
        return torch.nn.functional.normalize(rows.float(), dim=1)


def as_teacher(source: Teacher | Callable[[Tensor], Tensor]) -> Teacher:
    """A teacher as it is; a function from [3, H, W] to [D, h, w] as a teacher without text. Else a TypeError."""
    if isinstance(source, Teacher) and not inspect.isclass(source):
        return source
    if callable(source) and not inspect.isclass(source):
        return CallableTeacher(source)
    got = f"the class {source.__name__}; make an object of it" if inspect.isclass(source) else type(source).__name__
    raise TypeError(
        f"teacher: expected an object with name, encode_image and encode_text, or a function from [3, H, W] to [D, h, w], "
        f"got {got}; see kfgs.teachers.Teacher"
    )


def identify(teacher: Teacher) -> dict[str, Any]:
    """JSON of what a teacher's features depend on, as their folder has it: its name, and its `identity` or version."""
    return as_encoder(teacher)[1]


def check_picture(image: Any) -> None:
    """Raise unless `image` is a picture: [3, H, W], at least one pixel, finite floats in [0, 1]; reads the values."""
    image = as_tensor("image", image)
    check_shapes(("image", image, "3 H W"))
    if not image.is_floating_point():
        raise TypeError(f"image: expected floats in [0, 1], got {image.dtype}; divide bytes by 255")
    if 0 in image.shape:
        raise ValueError(f"image: expected at least one pixel, got {tuple(image.shape)}; leave empty pictures out")
    low, high = (float(value) for value in image.detach().aminmax())  # NaN if there is one
    if not (low >= -_ROUNDING and high <= 1 + _ROUNDING):
        raise ValueError(
            f"image: expected finite values in [0, 1], got {low:g} to {high:g}; divide bytes by 255, and undo any "
            "other normalisation"
        )


def check_prompts(prompts: Any) -> None:
    """Raise a TypeError unless `prompts` is a list of texts, and a ValueError if it is empty."""
    if isinstance(prompts, str) or not isinstance(prompts, Sequence) or not all(isinstance(p, str) for p in prompts):
        raise TypeError(
            f"prompts: expected a list of texts, got {type(prompts).__name__} {prompts!r:.80}; pass a list of str"
        )
    if len(prompts) == 0:
        raise ValueError("prompts: expected at least one text, got none; name what to look for")
