"""The interface of a teacher, a 2-D encoder that is distilled into a field; any function can become one."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from .._check import check_shapes
from .identity import code_identity

_ROUNDING = 1e-4  # a resampled picture may exceed [0, 1] by this much

PROMPTS_AT_ONCE = 64  # 60 MB of activations in CLIP ViT-L's text tower


@runtime_checkable
class Teacher(Protocol):
    """An image encoder, usually with a text encoder into the same space: LSeg, or a dense CLIP.

    Any object with these three members is a teacher; there is no base class. `isinstance` checks that the members exist,
    not their signatures. Two more are used if they exist: `to(device)` and `identity`, JSON of everything that the features
    depend on (see `identify`). Without `identity` a cache does not notice other weights; teachers from `load_teacher`
    always have one.

    **Convention**: here, pictures and features have the channels first, as in encoders; kfgs's maps, in memory and on disk,
    have them last ([h, w, D]).

    Example:
        >>> import torch
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
        identity: JSON of everything except the name that the features depend on, for example a digest of the weights: if
            it changes, a cache is made again. None: the place of `images` and a digest of its code, which notices neither
            globals and closures nor a model's weights; see `identity.code_identity`.

    Example:
        >>> import torch
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
        identity: dict[str, Any] | None = None,
    ) -> None:
        if not callable(images):
            raise TypeError(
                f"images: expected a function from [3, H, W] to [D, h, w], got {type(images).__name__}; pass a callable"
            )
        self._images, self._text = images, text
        self.name = name or getattr(images, "__name__", type(images).__name__).strip("<>")
        self._identity = code_identity(images) if identity is None else dict(identity)

    def __repr__(self) -> str:
        return f"CallableTeacher({self.name!r}, text={self._text is not None})"

    @property
    def identity(self) -> dict[str, Any]:
        """JSON of what the features depend on, as far as it is known."""
        return {"name": self.name, **self._identity}

    def encode_image(self, image: Tensor) -> Tensor:  # [3, H, W] -> [D, h, w]
        """Call the function, and check the result with `check_features`."""
        return check_features(self.name, self._images(image))

    def encode_text(self, prompts: Sequence[str]) -> Tensor:  # [n, D]
        """Call the function for text.

        Raises:
            NotImplementedError: if there is none.
            TypeError: if `prompts` is one text, or holds something else than texts.
            ValueError: if there are no prompts, or it does not return one row per prompt.
        """
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
    """Return a teacher unchanged; wrap a function from [3, H, W] to [D, h, w] as a teacher without text.

    Raises:
        TypeError: if it is neither, or a class instead of an object.
    """
    if inspect.isclass(source):
        raise TypeError(
            f"teacher: expected an object or a function, got the class {source.__name__}; make one: {source.__name__}(...)"
        )
    if isinstance(source, Teacher):
        return source
    if callable(source):
        return CallableTeacher(source)
    raise TypeError(
        f"teacher: expected an object with name, encode_image and encode_text, or a function from [3, H, W] to [D, h, w], "
        f"got {type(source).__name__}; see kfgs.teachers.Teacher"
    )


def identify(teacher: Teacher) -> dict[str, Any]:
    """JSON of what a teacher's features depend on: its `identity`, or its name if it has none."""
    found = getattr(teacher, "identity", None)
    if isinstance(found, dict):
        return dict(found)
    if not hasattr(teacher, "name"):
        raise TypeError(f"teacher: expected a teacher, got {type(teacher).__name__}; load_teacher(name) loads one")
    return {"name": teacher.name}


def check_features(name: str, features: Any) -> Tensor:  # -> [D, h, w]
    """Check that a teacher returned a map of floats for a picture, and return it.

    Raises:
        TypeError: if it is no tensor, or one without values in memory (sparse, nested, on the meta device).
        ValueError: if it has other axes, no cell, or no floats.
    """
    if not isinstance(features, Tensor):
        hint = "torch.from_numpy(...)" if hasattr(features, "__array__") else "the features alone"
        raise TypeError(
            f"teacher {name!r}: expected a tensor [D, h, w], got a {type(features).__name__}; return {hint}"
        )
    _check_dense(f"teacher {name!r}", features, "[D, h, w]")
    if features.ndim != 3 or 0 in features.shape or not features.is_floating_point():
        raise ValueError(
            f"teacher {name!r}: expected floats [D, h, w] for one picture, got {features.dtype} "
            f"{tuple(features.shape)}; leave out the batch axis"
        )
    return features


def check_picture(image: Any) -> None:
    """Raise unless `image` is a picture: [3, H, W], at least one pixel, finite floats in [0, 1]; reads the values.

    Raises:
        TypeError: if it is no tensor with values in memory, or holds no floats.
        ValueError: if it has another shape, or a value is not finite or not in [0, 1] (1e-4 of rounding is allowed).
    """
    if not isinstance(image, Tensor):
        hint = "torch.from_numpy" if hasattr(image, "__array__") else "torch.as_tensor"
        raise TypeError(f"image: expected a tensor [3, H, W], got {type(image).__name__}; use {hint}")
    _check_dense("image", image, "[3, H, W]")
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
    """Raise unless `prompts` is a list of texts, at least one.

    Raises:
        TypeError: if it is one text or no list, or holds something else than texts.
        ValueError: if there are none.
    """
    if isinstance(prompts, str):
        raise TypeError(f"prompts: expected a list of texts, got the text {prompts!r}; put it into a list")
    if not isinstance(prompts, Sequence):
        raise TypeError(f"prompts: expected a list of texts, got {type(prompts).__name__}; put them into a list")
    if not all(isinstance(prompt, str) for prompt in prompts):
        other = next(prompt for prompt in prompts if not isinstance(prompt, str))
        raise TypeError(f"prompts: expected texts, got {type(other).__name__} {other!r:.80}; use str")
    if len(prompts) == 0:
        raise ValueError("prompts: expected at least one text, got none; name what to look for")


def _check_dense(name: str, tensor: Tensor, shape: str) -> None:
    """Raise a TypeError for sparse and nested tensors, and for those without values in memory."""
    nested, meta = tensor.is_nested, tensor.device.type == "meta"
    if nested or meta or tensor.layout != torch.strided:
        kind = "nested tensor" if nested else "tensor on the meta device" if meta else f"tensor of {tensor.layout}"
        hint = "give it a device with memory" if meta else "bring it to the ordinary layout, as to_dense() does"
        raise TypeError(f"{name}: expected a dense tensor {shape}, got a {kind}; {hint}")
