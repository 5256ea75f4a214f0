"""A teacher of made-up text for tests: words that share letters lie near each other."""

import torch
from cases_color import surface

from kfgs import SemanticField, load_scene, make_label_set
from kfgs._files import read_json
from kfgs.fields import Identity
from kfgs.teachers import CallableTeacher

DIM = 16


def letters(prompts):
    """One row per prompt: how often each letter occurs, mixed by a fixed matrix; case does not count."""
    mix = torch.randn(128, DIM, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    counts = torch.zeros(len(prompts), 128, dtype=torch.float64)
    for row, prompt in zip(counts, prompts, strict=True):
        for letter in prompt.lower():
            row[ord(letter)] += 1
    return (counts @ mix).float()


def pixels(image):
    return image[:1, ::4, ::4].expand(DIM, -1, -1)


TEACHER = CallableTeacher(pixels, letters, name="letters")
TEACHER.identity = {"name": "letters", "weights": "abc"}
MUTE = CallableTeacher(pixels, name="mute")


def save_letters(room, folder):
    """A field of the room's surface, each Gaussian with the teacher's text of its class, and the table of the classes."""
    cloud, truth = surface(room)
    table, scene = make_label_set(TEACHER, read_json(room / "classes.json")), load_scene(room)
    info = {"views": [scene.cameras[i].name for i in scene.views("train")], "teacher": TEACHER.identity}
    field = SemanticField(cloud.replace(features=table.embeddings[truth]), Identity(table.dim), info=info)
    field.save(folder / "field.kfgs")
    table.save(folder / "table.safetensors")
    return folder / "field.kfgs", folder / "table.safetensors"
