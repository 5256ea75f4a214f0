import sys

import pytest
import torch

from kfgs.teachers import Teacher
from kfgs.teachers.load import load_teacher, teacher_names


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A module of a user's own, importable for one test."""
    (tmp_path / "own_teachers.py").write_text(
        "import torch\n"
        "def thumbnail(image):\n"
        "    return image[:, ::2, ::2]\n"
        "class Scaled:\n"
        "    def __init__(self, weights, factor=1.0):\n"
        "        self.name, self.factor, self.weights = 'scaled', factor, str(weights)\n"
        "    def encode_image(self, image):\n"
        "        return image * self.factor\n"
        "    def encode_text(self, prompts):\n"
        "        return torch.eye(3)[: len(prompts)]\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("own_teachers", None)


def test_a_function_of_a_module_is_a_teacher(own):
    teacher = load_teacher("own_teachers:thumbnail")
    assert isinstance(teacher, Teacher)
    assert teacher.encode_image(torch.zeros(3, 4, 8)).shape == (3, 2, 4)


def test_a_class_is_called_with_weights_and_options(own):
    teacher = load_teacher("own_teachers:Scaled", "w.pt", factor=2.0)
    assert teacher.weights == "w.pt"
    assert float(teacher.encode_image(torch.ones(3, 1, 1)).sum()) == 6


def test_what_cannot_be_imported_is_refused(own):
    with pytest.raises(ValueError, match="expected package.module:name that can be imported, got 'nowhere:x'"):
        load_teacher("nowhere:x")
    with pytest.raises(ValueError, match="own_teachers:absent"):
        load_teacher("own_teachers:absent")
    with pytest.raises(ValueError, match="which is made already, got w.pt"):
        load_teacher("own_teachers:thumbnail", "w.pt")


def test_an_unknown_name_is_answered_with_the_nearest():
    with pytest.raises(ValueError, match="did you mean 'lseg'"):
        load_teacher("LSeg2")
    assert {"lseg", "clip", "siglip", "dinov2", "sam"} <= set(teacher_names())


def test_weights_are_asked_for():
    with pytest.raises(ValueError, match="weights: expected a checkpoint file for teacher 'lseg', got none"):
        load_teacher("lseg")
    with pytest.raises(ValueError, match="a folder of save_pretrained, or a hub id for teacher 'clip'"):
        load_teacher("clip")
