import numpy as np
import pytest
import torch
from messages import refused

from kfgs.teachers.protocol import CallableTeacher, Teacher, as_teacher, check_picture, check_prompts, identify


class Colour:
    name = "colour"

    def encode_image(self, image: torch.Tensor) -> torch.Tensor:
        return image[:, ::2, ::2]

    def encode_text(self, prompts: list[str]) -> torch.Tensor:
        return torch.eye(3)[: len(prompts)]


def halve(image: torch.Tensor) -> torch.Tensor:
    return image[:, ::2, ::2]


def test_an_object_with_the_members_or_a_function_is_a_teacher():
    teacher, image = Colour(), torch.rand(3, 4, 6, generator=torch.Generator().manual_seed(0))
    assert isinstance(teacher, Teacher)
    assert as_teacher(teacher) is teacher
    function = as_teacher(halve)
    assert function.name == "halve"
    assert torch.equal(function.encode_image(image), image[:, ::2, ::2])
    refused(lambda: function.encode_text(["a"]), "teacher 'halve':", "text encoder", error=NotImplementedError)
    words = CallableTeacher(halve, lambda prompts: torch.tensor([[3.0, 0, 4]] * len(prompts)), version="2")
    assert torch.allclose(words.encode_text(["a", "b"]), torch.tensor([[0.6, 0, 0.8]] * 2))  # unit rows
    few = CallableTeacher(halve, lambda prompts: torch.ones(1, 3))
    refused(lambda: few.encode_text(["a", "b"]), "text of halve:", "[2, D]", "got (1, 3)")
    assert identify(teacher) == {"name": "colour"}
    assert identify(words) == {"name": "halve", "version": "2"}


def test_what_is_neither_object_nor_function_is_refused():
    refused(lambda: as_teacher(3), "teacher:", "got int", error=TypeError)
    refused(lambda: as_teacher(Colour), "teacher:", "the class Colour", error=TypeError)
    refused(lambda: CallableTeacher("lseg"), "images:", "got str", error=TypeError)


@pytest.mark.parametrize(
    ("image", "error", "words"),
    [
        (np.zeros((8, 9)), ValueError, ("image:", "[3, H, W]", "got (8, 9)")),
        (torch.zeros(8, 9, 3), ValueError, ("image:", "[3, H, W]", "got (8, 9, 3)")),
        (torch.zeros(3, 8, 9, dtype=torch.uint8), TypeError, ("image:", "[0, 1]", "got torch.uint8")),
        (torch.zeros(3, 8, 9, dtype=torch.complex64), TypeError, ("image:", "got torch.complex64")),
        (torch.zeros(3, 0, 9), ValueError, ("image:", "pixel", "got (3, 0, 9)")),
        (torch.full((3, 8, 9), 1.001), ValueError, ("image:", "[0, 1]", "got 1.001 to 1.001")),
        (torch.tensor([0.0, torch.nan] * 3).reshape(3, 1, 2), ValueError, ("image:", "got nan to nan")),
    ],
)
def test_what_is_no_picture_is_refused(image, error, words):
    refused(lambda: check_picture(image), *words, error=error)


def test_what_are_no_prompts_is_refused():
    refused(lambda: check_prompts("wall"), "prompts:", "'wall'", error=TypeError)
    refused(lambda: check_prompts([]), "prompts:", "got none")
    refused(lambda: check_prompts(["wall", 3]), "prompts:", "got list", error=TypeError)
    refused(lambda: check_prompts({"wall"}), "prompts:", "got set", error=TypeError)
    refused(lambda: check_prompts(word for word in ["wall"]), "prompts:", "got generator", error=TypeError)
