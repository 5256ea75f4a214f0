import numpy as np
import pytest
import torch
from cases_text import DIM, MUTE, TEACHER, letters
from messages import refused, tells
from oracles_words import ensemble

from kfgs.labels import LabelSet, load_label_set
from kfgs.labels.scores import CANONICAL
from kfgs.teachers import CallableTeacher
from kfgs.teachers.prompts import TEMPLATES, make_label_set
from kfgs.teachers.protocol import PROMPTS_AT_ONCE


def embed_labels(teacher, names, **options):
    return make_label_set(teacher, names, negatives=None, **options).embeddings


def one(prompt):
    return letters([prompt])[0].double().numpy()


@pytest.mark.parametrize("templates", ["bare", "clip7", "tcl9", "siglip", "a {} of mine", ("{}!", "the {}")])
def test_rows_are_the_mean_direction_of_words_in_templates(templates):
    names = ["chair;armchair;seat", "potted_plant", "Wall"]
    found = embed_labels(TEACHER, names, templates=templates, synonyms={"Wall": ["brick wall"]})
    written = TEMPLATES.get(templates, (templates,)) if isinstance(templates, str) else templates
    words = [["chair", "armchair", "seat"], ["potted plant"], ["Wall", "brick wall"]]
    expected = np.stack([ensemble(one, group, written) for group in words])
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6)
    assert found.dtype == torch.float32


def test_a_teacher_may_say_which_templates_suit_it():
    teacher = CallableTeacher(lambda image: image, letters)
    teacher.templates = "siglip"
    torch.testing.assert_close(embed_labels(teacher, ["wall"]), embed_labels(TEACHER, ["wall"], templates="siglip"))
    assert make_label_set(teacher, ["wall"]).info["templates"] == ["This is a photo of {}."]
    assert make_label_set(teacher, ["wall"], templates="bare").info["templates"] == ["{}"]


def test_a_synonym_that_is_the_word_itself_counts_once():
    same = embed_labels(TEACHER, ["potted_plant;potted plant;pot"])
    torch.testing.assert_close(same, embed_labels(TEACHER, ["potted plant;pot"]))
    assert (same - embed_labels(TEACHER, ["pot;potted plant"])).abs().max() < 1e-6  # their order does not count
    assert (same - embed_labels(TEACHER, ["potted plant"])).abs().max() > 0.01


def test_prompts_go_to_the_teacher_in_chunks_each_once():
    seen = []

    def text(prompts):
        seen.append(list(prompts))
        return letters(prompts)

    names = [f"thing {i}" for i in range(PROMPTS_AT_ONCE + 10)]
    synonyms = {name: ["shared word"] for name in names}
    found = embed_labels(CallableTeacher(lambda image: image, text), names, synonyms=synonyms)
    asked = [prompt for part in seen for prompt in part]
    assert max(map(len, seen)) == PROMPTS_AT_ONCE
    assert len(asked) == len(set(asked)) == len(names) + 1
    np.testing.assert_allclose(found[70], ensemble(one, ["thing 70", "shared word"], ["{}"]), rtol=0, atol=2e-6)


def test_a_label_set_knows_what_made_it(tmp_path):
    made = make_label_set(TEACHER, ["chair;seat", "wall"], templates="siglip", synonyms={"wall": ["side"]})
    assert isinstance(made, LabelSet)
    assert made.names == ("chair", "wall")
    assert made.negative_names == CANONICAL == ("object", "things", "stuff", "texture")
    torch.testing.assert_close(made.negatives, embed_labels(TEACHER, CANONICAL, templates="siglip"))
    assert made.info == {
        "teacher": {"name": "letters", "weights": "abc"},
        "templates": ["This is a photo of {}."],
        "synonyms": {"chair": ["seat"], "wall": ["side"]},
    }
    made.save(tmp_path / "t.safetensors")
    assert load_label_set(tmp_path / "t.safetensors").info == made.info
    assert make_label_set(TEACHER, ["wall"], negatives=None).negatives is None
    assert make_label_set(TEACHER, ["wall"], negatives=["air"]).negatives.shape == (1, DIM)


@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        ([], {}, ("names:", "got []")),
        (["wall", " "], {}, ("names:", "got ['wall', ' ']")),
        (["wall;_"], {}, ("names:", "got ['wall;_']")),
        (["wall", "wall;side"], {}, ("names:", "got 'wall'")),
        (["wall"], {"synonyms": {"wal": ["side"]}}, ("synonyms:", "'wal'")),
        (["wall"], {"synonyms": {"wall": "side"}}, ("synonyms:", "'wall'", "'side'")),
        (["wall"], {"templates": "clip8"}, ("templates:", "got 'clip8'", "'clip7'")),
        (["wall"], {"templates": ("{}", "a photo")}, ("templates:", "{}", "got 'a photo'")),
        (["wall"], {"templates": ()}, ("templates:", "bare, clip7, tcl9, siglip", "got 'none'")),
    ],
)
def test_wrong_words_and_templates_are_named(names, options, message):
    refused(lambda: embed_labels(TEACHER, names, **options), *message)


def test_wrong_rows_are_named():
    def teacher(rows):
        return CallableTeacher(lambda image: image, rows, name="odd")

    with pytest.raises(ValueError, match=tells("text of odd:", "direction", "'b'")):
        embed_labels(teacher(lambda prompts: torch.eye(3)[: len(prompts)] * torch.tensor([[1.0], [0.0]])), ["a", "b"])
    opposite = {"up": [1.0, 0.0], "down": [-1.0, 0.0]}
    with pytest.raises(ValueError, match=tells("names:", "got none", "'up'")):
        embed_labels(teacher(lambda prompts: torch.tensor([opposite[word] for word in prompts])), ["up;down"])
    refused(lambda: embed_labels(MUTE, ["wall"]), "teacher 'mute':", "text encoder", error=NotImplementedError)
    with pytest.raises(NotImplementedError, match=tells("teacher 'lambda':", "text encoder")):
        make_label_set(lambda image: image, ["wall"])  # a mere function of pictures is a teacher, too, but without text
    refused(lambda: make_label_set("lseg", ["wall"]), "teacher:", "encode_image", "got str", error=TypeError)
    refused(lambda: embed_labels(TEACHER, "wall"), "names:", "'wall'", error=TypeError)
