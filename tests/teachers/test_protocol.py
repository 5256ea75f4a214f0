import pytest
import torch

from kfgs.teachers import CallableTeacher, Teacher, as_teacher, identify


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


def test_an_object_that_lacks_text_is_not():
    assert not isinstance(torch.nn.Linear(3, 3), Teacher)


def test_a_function_becomes_a_teacher_of_its_name():
    teacher = as_teacher(halve)
    image = torch.rand(3, 4, 6, generator=torch.Generator().manual_seed(0))
    assert teacher.name == "halve"
    assert torch.equal(teacher.encode_image(image), image[:, ::2, ::2])
    with pytest.raises(NotImplementedError, match="expected one with a text encoder"):
        teacher.encode_text(["chair"])


def test_text_of_a_function_comes_as_unit_rows():
    teacher = CallableTeacher(halve, lambda prompts: torch.tensor([[3.0, 0, 4]] * len(prompts)))
    assert torch.allclose(teacher.encode_text(["a", "b"]), torch.tensor([[0.6, 0, 0.8]] * 2))
    few = CallableTeacher(halve, lambda prompts: torch.ones(1, 3))
    with pytest.raises(ValueError, match=r"text of halve: expected \[2, D\]"):
        few.encode_text(["a", "b"])


@pytest.mark.parametrize(
    ("returned", "error", "words"),
    [
        ([1.0], TypeError, "got a list"),
        (torch.zeros(1, 3, 2, 2), ValueError, "leave out the batch axis"),
        (torch.zeros(3, 2, 0), ValueError, "expected floats"),
        (torch.zeros(3, 2, 2, dtype=torch.int64), ValueError, "got torch.int64"),
    ],
)
def test_what_is_no_map_is_refused(returned, error, words):
    with pytest.raises(error, match=words):
        as_teacher(lambda image: returned).encode_image(torch.zeros(3, 4, 4))


def test_what_is_neither_object_nor_function_is_refused():
    with pytest.raises(TypeError, match="got int"):
        as_teacher(3)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="images: expected a function"):
        CallableTeacher("lseg")  # type: ignore[arg-type]


def test_identity_is_the_name_and_what_is_known_beside_it():
    assert identify(Colour()) == {"name": "colour"}
    assert identify(CallableTeacher(halve, identity={"weights": "abc"})) == {"name": "halve", "weights": "abc"}
