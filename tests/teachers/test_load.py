import sys

import pytest
import torch
from messages import tells

from kfgs.teachers.load import load_teacher, teacher_names
from kfgs.teachers.protocol import Teacher, identify

CLASS = (
    "import torch\n"
    "class Scaled:\n"
    "    name = 'scaled'\n"
    "    def __init__(self, weights=None, factor=1.0):\n"
    "        self.factor = factor\n"
    "    def encode_image(self, image):\n"
    "        return image * self.factor\n"
    "    def encode_text(self, prompts):\n"
    "        return torch.eye(3)[: len(prompts)]\n"
)


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
    assert identify(teacher) == {
        "name": "scaled", "version": "2", "source": "mine:Scaled", "weights": "w.pt", "options": {"factor": 2.0}
    }  # fmt: skip
    write("def one(image):\n    return image[:, ::2]\n")
    assert identify(load_teacher("mine:one"))["source"] == "mine:one"


def test_identity_that_an_object_brings_is_its_own(write):
    write(CLASS.replace("    name = 'scaled'\n", "    name, identity = 'scaled', {'version': 3}\n"))
    teacher = load_teacher("mine:Scaled")
    assert identify(teacher) == {"version": 3}
    assert type(teacher).__name__ == "Scaled"


def test_modules_are_found_beside_the_command_but_the_path_stays(write):
    write("import sys\nsys.path.append('/mine')\n" + CLASS)
    before = list(sys.path)
    load_teacher("mine:Scaled")
    assert sys.path == [*before, "/mine"]
    write("raise KeyError('x')")
    with pytest.raises(ValueError, match=tells("teacher:", "KeyError", "got 'mine:Scaled'")):
        load_teacher("mine:Scaled")
    assert sys.path == [*before, "/mine"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("def f(:\n", ("teacher:", "got 'mine:f'", "(SyntaxError: ", "mine.py, line 1")),
        ("raise RuntimeError('no GPU\\nat all')\n", ("teacher:", "got 'mine:f'", "(RuntimeError: no GPU)")),
        ("import sys\nsys.exit(3)\n", ("teacher:", "got 'mine:f'", "(SystemExit: 3)")),
        ("import absent_package\n", ("teacher:", "got 'mine:f'", "'absent_package'")),
        (
            "f = 3\n",
            ("mine:f:", "got int", "encode_image", "encode_text", "kfgs.teachers.Teacher"),
        ),
    ],
)
def test_a_module_that_does_not_work_is_named_in_one_line(write, text, words):
    write(text)
    with pytest.raises(ValueError, match=tells(*words)) as error:
        load_teacher("mine:f")
    assert "\n" not in str(error.value)


def test_what_cannot_be_imported_is_refused(own):
    for name in ("nowhere:x", ":x", ".own_teachers:thumbnail", "own_teachers:", "own_teachers:a:b"):
        with pytest.raises(ValueError, match=tells("teacher:", "package.module:name", f"got '{name}'")):
            load_teacher(name)
    with pytest.raises(ValueError, match=tells("teacher:", "got 'own_teachers:absent'")):
        load_teacher("own_teachers:absent")
    with pytest.raises(ValueError, match=tells("weights:", "got w.pt")):
        load_teacher("own_teachers:thumbnail", "w.pt")


def test_an_unknown_name_is_answered_with_the_nearest():
    with pytest.raises(ValueError, match=tells("teacher:", "'lseg'", "got 'LSeg2'")):
        load_teacher("LSeg2")
    assert {"lseg", "clip", "siglip", "dinov2", "sam"} <= set(teacher_names())


def test_weights_are_asked_for():
    with pytest.raises(ValueError, match=tells("weights:", "'lseg'", "got none")):
        load_teacher("lseg")
    with pytest.raises(ValueError, match=tells("weights:", "save_pretrained", "'clip'", "got none")):
        load_teacher("clip")
