"""A teacher of made-up text for tests: words that share letters lie near each other."""

import torch

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
