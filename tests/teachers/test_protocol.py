import numpy as np
import pytest
import torch
from messages import tells

from kfgs.teachers.protocol import CallableTeacher, Teacher, as_teacher, check_picture, check_prompts, identify


class Colour:
    name = "colour"

    def encode_image(self, image: torch.Tensor) -> torch.Tensor:
        return image[:, ::2, ::2]

    def encode_text(self, prompts: list[str]) -> torch.Tensor:
        return torch.eye(3)[: len(prompts)]


def halve(image: torch.Tensor) -> torch.Tensor:
    return image[:, ::2, ::2]


def test_any_object_with_the_members_is_a_teacher():
    teacher: Teacher = Colour()
    assert isinstance(teacher, Teacher)
    assert teacher.encode_image(torch.zeros(3, 4, 6)).shape == (3, 2, 3)
    assert as_teacher(teacher) is teacher


def test_a_function_becomes_a_teacher_of_its_name():
    teacher = as_teacher(halve)
    image = torch.rand(3, 4, 6, generator=torch.Generator().manual_seed(0))
    assert teacher.name == "halve"
    assert torch.equal(teacher.encode_image(image), image[:, ::2, ::2])
    with pytest.raises(NotImplementedError, match=tells("teacher 'halve':", "text encoder")):
        teacher.encode_text(["chair"])


def test_text_of_a_function_comes_as_unit_rows():
    teacher = CallableTeacher(halve, lambda prompts: torch.tensor([[3.0, 0, 4]] * len(prompts)))
    assert torch.allclose(teacher.encode_text(["a", "b"]), torch.tensor([[0.6, 0, 0.8]] * 2))
    few = CallableTeacher(halve, lambda prompts: torch.ones(1, 3))
    with pytest.raises(ValueError, match=tells("text of halve:", "[2, D]", "got (1, 3)")):
        few.encode_text(["a", "b"])


def test_what_is_neither_object_nor_function_is_refused():
    with pytest.raises(TypeError, match=tells("teacher:", "got int")):
        as_teacher(3)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=tells("teacher:", "the class Colour")):
        as_teacher(Colour)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=tells("images:", "got str")):
        CallableTeacher("lseg")  # type: ignore[arg-type]


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
    with pytest.raises(error, match=tells(*words)):
        check_picture(image)


@pytest.mark.parametrize(
    ("prompts", "error", "words"),
    [
        ("wall", TypeError, ("prompts:", "'wall'")),
        ([], ValueError, ("prompts:", "got none")),
        (["wall", 3], TypeError, ("prompts:", "got list")),
        ({"wall"}, TypeError, ("prompts:", "got set")),
        ((word for word in ["wall"]), TypeError, ("prompts:", "got generator")),
    ],
)
def test_what_are_no_prompts_is_refused(prompts, error, words):
    with pytest.raises(error, match=tells(*words)):
        check_prompts(prompts)


def test_identity_is_the_name_and_the_version():
    assert identify(Colour()) == {"name": "colour"}
    assert identify(CallableTeacher(halve, version="2")) == {"name": "halve", "version": "2"}
