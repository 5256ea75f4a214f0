import sys

import pytest
import torch
from messages import refused, tells

from kfgs.teachers.load import load_teacher, teacher_names
from kfgs.teachers.protocol import Teacher, identify

CLASS = """
import torch

class Scaled:
    name = 'scaled'

    def __init__(self, weights=None, factor=1.0):
        self.factor, self.given = factor, weights

    def encode_image(self, image):
        return image * self.factor

    def encode_text(self, prompts):
        return torch.eye(3)[: len(prompts)]

"""


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Writes the module `mine` into the folder in which the command runs, and forgets the one that was imported."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # two texts of one second and size would share a .pyc
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])

    def to(text):
        (tmp_path / "mine.py").write_text(text)
        sys.modules.pop("mine", None)

    yield to
    sys.modules.pop("mine", None)


def test_identity_holds_version_source_weights_and_options(write):
    write(CLASS + "    version = '2'\n")
    teacher = load_teacher("mine:Scaled", "w.pt", factor=2.0)
    assert isinstance(teacher, Teacher)
    assert str(teacher.given) == "w.pt"
    assert float(teacher.encode_image(torch.ones(3, 1, 1)).sum()) == 6
    assert identify(teacher) == {
        "name": "scaled", "version": "2", "source": "mine:Scaled", "weights": "w.pt", "options": {"factor": 2.0}
    }  # fmt: skip
    write("def one(image):\n    return image[:, ::2]\n")
    function = load_teacher("mine:one")  # a function is a teacher, too
    assert isinstance(function, Teacher)
    assert function.encode_image(torch.zeros(3, 4, 8)).shape == (3, 2, 8)
    assert identify(function)["source"] == "mine:one"
    write(CLASS.replace("    name = 'scaled'\n", "    name, identity = 'scaled', {'version': 3}\n"))
    assert identify(load_teacher("mine:Scaled")) == {"name": "scaled", "version": 3}  # as the folder of its maps has it


def test_modules_are_found_beside_the_command_but_the_path_stays(write):
    write("import sys\nsys.path.append('/mine')\n" + CLASS)
    before = list(sys.path)
    load_teacher("mine:Scaled")
    assert sys.path == [*before, "/mine"]
    write("raise KeyError('x')")
    refused(lambda: load_teacher("mine:Scaled"), "teacher:", "KeyError", "got 'mine:Scaled'")
    assert sys.path == [*before, "/mine"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("def f(:\n", ("teacher:", "got 'mine:f'", "(SyntaxError: ", "mine.py, line 1")),
        ("raise RuntimeError('no GPU\\nat all')\n", ("teacher:", "got 'mine:f'", "(RuntimeError: no GPU)")),
        ("import sys\nsys.exit(3)\n", ("teacher:", "got 'mine:f'", "(SystemExit: 3)")),
        ("import absent_package\n", ("teacher:", "got 'mine:f'", "'absent_package'")),
        ("f = 3\n", ("mine:f:", "got int", "encode_image", "encode_text", "kfgs.teachers.Teacher")),
    ],
)
def test_a_module_that_does_not_work_is_named_in_one_line(write, text, words):
    write(text)
    with pytest.raises(ValueError, match=tells(*words)) as error:
        load_teacher("mine:f")
    assert "\n" not in str(error.value)


def test_what_cannot_be_loaded_is_refused(write):
    write("def one(image):\n    return image\n")
    for name in ("nowhere:x", ":x", ".mine:one", "mine:", "mine:a:b"):
        refused(lambda name=name: load_teacher(name), "teacher:", "package.module:name", f"got '{name}'")
    refused(lambda: load_teacher("mine:absent"), "teacher:", "got 'mine:absent'")
    refused(lambda: load_teacher("mine:one", "w.pt"), "weights:", "got w.pt")
    refused(lambda: load_teacher("LSeg2"), "teacher:", "'lseg'", "got 'LSeg2'")  # the nearest name
    assert {"lseg", "clip", "siglip", "dinov2", "sam"} <= set(teacher_names())
    refused(lambda: load_teacher("lseg"), "weights:", "'lseg'", "got none")
    refused(lambda: load_teacher("clip"), "weights:", "save_pretrained", "'clip'", "got none")
