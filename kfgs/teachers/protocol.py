"""What kfgs asks of a 2-D encoder that is distilled into a field, and how anything callable becomes one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from .._check import check_shapes


@runtime_checkable
class Teacher(Protocol):
    """An image encoder, best with a text encoder into the same space, such as LSeg or a dense CLIP.

    Any object with these three members is a teacher; nothing needs to be inherited. `isinstance` checks that the
    members exist, not their signatures. Two more are used where they exist: `identity`, JSON that tells what decides its
    features (see `identify`), and `to(device)`.

    **Convention**: pictures and features have the channels first here, as encoders have them; kfgs's own maps, and those
    on disk, have them last ([h, w, D]).

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
        """A short name that goes into file names and reports."""
        ...

    def encode_image(self, image: Tensor) -> Tensor:  # image: [3, H, W] RGB in [0, 1] -> [D, h, w]
        """One feature per cell of a grid over the image; features need not be unit, and h, w may be smaller than H, W."""
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
        text: n prompts -> [n, D]; rows are brought to unit length. None: the teacher knows no text.
        name: a short name; the function's own when not given.
        identity: JSON that tells what decides the features beside the name, such as a digest of the weights: a cache is
            made again when it changes.

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
        self._identity = dict(identity or {})

    @property
    def identity(self) -> dict[str, Any]:
        """What decides the features, as far as it is known."""
        return {"name": self.name, **self._identity}

    def encode_image(self, image: Tensor) -> Tensor:  # [3, H, W] -> [D, h, w]
        """Call the function, and check what it returns.

        Raises:
            TypeError: if that is no tensor.
            ValueError: if it is not a map [D, h, w] of floats.
        """
        return check_features(self.name, self._images(image))

    def encode_text(self, prompts: Sequence[str]) -> Tensor:  # [n, D]
        """Call the function for text.

        Raises:
            NotImplementedError: if there is none.
            ValueError: if it does not return one row per prompt.
        """
        if self._text is None:
            raise NotImplementedError(
                f"teacher {self.name!r}: expected one with a text encoder, got one without; pass text=..., or embed the "
                "prompts elsewhere and give the rows to LabelSet"
            )
        rows = self._text(list(prompts))
        check_shapes((f"text of {self.name}", rows, (len(prompts), "D")))
        return torch.nn.functional.normalize(rows.float(), dim=1)


def as_teacher(source: Teacher | Callable[[Tensor], Tensor]) -> Teacher:
    """A teacher as it is, or a function from [3, H, W] to [D, h, w] as a teacher without text.

    Raises:
        TypeError: if it is neither.
    """
    if isinstance(source, Teacher):
        return source
    if callable(source):
        return CallableTeacher(source)
    raise TypeError(
        f"teacher: expected an object with name, encode_image and encode_text, or a function from [3, H, W] to [D, h, w], "
        f"got {type(source).__name__}; see kfgs.teachers.Teacher"
    )


def identify(teacher: Teacher) -> dict[str, Any]:
    """JSON that tells what decides a teacher's features: its own `identity`, or else its name alone."""
    found = getattr(teacher, "identity", None)
    return dict(found) if isinstance(found, dict) else {"name": teacher.name}


def check_features(name: str, features: Any) -> Tensor:  # -> [D, h, w]
    """What a teacher returned for one picture, if it is a map of floats.

    Raises:
        TypeError: if it is no tensor.
        ValueError: if it has other axes, no cell, or no floats.
    """
    if not isinstance(features, Tensor):
        raise TypeError(
            f"teacher {name!r}: expected a tensor [D, h, w], got a {type(features).__name__}; return the features alone"
        )
    if features.ndim != 3 or 0 in features.shape or not features.is_floating_point():
        raise ValueError(
            f"teacher {name!r}: expected floats [D, h, w] for one picture, got {features.dtype} "
            f"{tuple(features.shape)}; leave out the batch axis"
        )
    return features
