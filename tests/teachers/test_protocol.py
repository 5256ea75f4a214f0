import torch

from kfgs.teachers import Teacher


class Colour:
    name = "colour"

    def encode_image(self, image: torch.Tensor) -> torch.Tensor:
        return image[::2, ::2]

    def encode_text(self, prompts: list[str]) -> torch.Tensor:
        return torch.eye(3)[: len(prompts)]


def test_any_object_with_the_members_is_a_teacher():
    teacher: Teacher = Colour()
    assert isinstance(teacher, Teacher)
    assert teacher.encode_image(torch.zeros(4, 6, 3)).shape == (2, 3, 3)


def test_an_object_that_lacks_text_is_not():
    assert not isinstance(torch.nn.Linear(3, 3), Teacher)
