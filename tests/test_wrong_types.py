"""Every public function and class refuses arguments of wrong kinds by TypeError, ValueError or OSError, by no other error."""

import importlib
import inspect
import warnings
from contextlib import suppress

import pytest
import torch
from cases_blobs import scene
from messages import tells
from test_public import PACKAGES

import kfgs
from kfgs import Camera
from kfgs.scenes import pictures_of

FIELD = scene([("chair", 0.0)])
GOOD = {
    "Gaussians": FIELD.gaussians,
    "SemanticField": FIELD,
    "Camera": Camera.look_at((0, -4, 0), (0, 0, 0)),
    "LabelSet": FIELD.classes,
}
"""What is passed for a first parameter of this type, so that the second one is looked at, too."""
WRONG = (None, "x", 1.5, [], torch.zeros(0), object())
RIGHT = {("make_toy_room", "x")}  # a name for a folder: it makes a room there


def public():
    """All callables of kfgs and its packages, each once; without errors, protocols and aliases of types."""
    found = {}
    for package in ("kfgs", *PACKAGES):
        module = importlib.import_module(package)
        for name in module.__all__:
            value = getattr(module, name)
            odd = inspect.isclass(value) and (issubclass(value, BaseException) or getattr(value, "_is_protocol", False))
            if (inspect.isfunction(value) or inspect.isclass(value)) and not odd:
                found.setdefault(id(value), pytest.param(value, id=f"{package}.{name}"))
    return list(found.values())


def calls(function, wrong):
    """Arguments that are all wrong, and those after a right first one."""
    parameters = inspect.signature(function).parameters.values()
    plain = [one for one in parameters if one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD)]
    needed = sum(one.default is one.empty for one in plain)
    named = {one.name: wrong for one in parameters if one.kind is one.KEYWORD_ONLY and one.default is one.empty}
    if plain:
        yield [wrong] * max(1, needed), named
        kinds = str(plain[0].annotation).split(" | ")
        for good in (value for kind, value in GOOD.items() if kind in kinds and len(plain) > 1):
            yield [good, *[wrong] * max(1, needed - 1)], named


@pytest.mark.parametrize("function", public())
def test_wrong_kinds_are_refused_in_words(function, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for wrong in WRONG:
        if isinstance(wrong, str) and (function.__name__, wrong) in RIGHT:
            continue
        for arguments, named in calls(function, wrong):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                with suppress(TypeError, ValueError, OSError, ImportError):  # of a library that is not installed
                    function(*arguments, **named)


def test_every_public_name_is_called():
    called = {one.values[0] for one in public()}
    left = [name for name in kfgs.__all__ if getattr(kfgs, name) not in called]
    assert left == ["SceneError", "Teacher"]
    assert len(called) > 300


@pytest.mark.parametrize(
    ("call", "parts"),
    [
        (lambda: kfgs.label_set_from_examples(FIELD, [1]), ("examples: expected", "dict", "list")),
        (lambda: kfgs.evaluate_segmentation(len, [1], "ab"), ("truth: expected", "dict", "list")),
        (lambda: kfgs.evaluate_segmentation(len, torch.zeros(2), ["a"]), ("truth: expected", "dict", "Tensor")),
        (
            lambda: kfgs.evaluate_segmentation(lambda stem: None, {"a": torch.zeros(2, 2).long()}, ["a"]),
            ("predict", "'a'", "NoneType"),
        ),
        (lambda: Camera.look_at(None, (0, 0, 0)), ("eye: expected", "NoneType")),
        (lambda: Camera(torch.eye(4), torch.eye(3), True, 4), ("width: expected", "whole number", "True")),
        (
            lambda: Camera(torch.eye(4), torch.eye(3), 4, 4, distortion=True),
            ("distortion: expected a Distortion or None", "bool"),
        ),
        (lambda: kfgs.load_teacher([]), ("teacher: expected a name", "list")),
        (lambda: kfgs.score_views(None, None), ("gaussians: expected", "NoneType")),
    ],
)
def test_the_argument_is_named(call, parts):
    with pytest.raises((TypeError, ValueError), match=tells(*parts)):
        call()


def test_the_maps_of_no_scene(tmp_path):
    with pytest.raises((TypeError, ValueError), match=tells("scene: expected a Scene", "NoneType")):
        pictures_of(None)
    with pytest.raises(TypeError, match=tells("scene: expected a Scene", "str", "load_scene")):
        pictures_of("S")
