import json

import numpy as np
import pytest
import torch
from cases_explorer import cloud
from cases_web import room_state
from messages import refused

from kfgs.viewer import Exploration, SplatMeaning
from kfgs.viewer.pack import pack_scene, rounded_far


def buffer(packed, name):
    entry = packed.header["buffers"][name]
    content = packed.data[entry["offset"] : entry["offset"] + entry["length"]]
    return np.frombuffer(content, entry["type"]).reshape(entry["shape"])


def test_labels_and_distances_are_exact(room):
    state = room_state(room)
    packed = pack_scene(state)
    labels, source, far = (buffer(packed, name) for name in ("semantic/labels", "color/source", "color/far"))
    assert labels.tolist() == state.labels("semantic").tolist()
    assert all(entry["offset"] % 16 == 0 for entry in packed.header["buffers"].values())
    json.dumps(packed.header, allow_nan=False)
    distances = np.unique(state.far)
    assert far.dtype == np.float32
    # at the start: a distance, a number next to one that no float32 tells from it, any
    rounded = distances[distances.astype(np.float32) < distances]
    for given in (float(distances[7]), float(rounded[3]), float(distances[9]) * (1 - 1e-9), 0.2):
        far = rounded_far(state.far, given)
        # those that the viewer sets, a distance itself and its neighbours among them, and the one given at the start
        for distance in (*far[np.argsort(far)][::500], *np.nextafter(far[:20], np.float32(9)), np.float32(0.05), given):
            state.set_distance(max(float(distance), 1e-9))
            carried = np.where(far.astype(np.float64) < state.distance, labels[source], -1)  # as JavaScript compares
            assert carried.tolist() == state.labels("color").tolist()


def test_no_source_and_no_harmonics():
    own = cloud([[0.0, 0, 5]], [-1])
    there = {"names": ("wall",), "origin": (5e5, 0, 0)}  # what is picked in a far scene is told in the world
    packed = pack_scene(Exploration(SplatMeaning(own.replace(**there)), cloud([[500001.0, 0, 5]])))
    assert packed.header["origin"] == [5e5, 0, 0]
    assert packed.header["sides"]["color"]["center"][0] == pytest.approx(1)
    assert buffer(packed, "color/source").tolist() == [-1]
    assert np.isinf(buffer(packed, "color/far")).all()
    assert packed.header["sides"]["color"]["sh_degree"] is None
    assert packed.header["up"] == [0, -1, 0]
    assert packed.header["default_view"] is None


@pytest.mark.parametrize("name", ["quats", "scales", "opacities", "sh"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused(name, value):
    own = cloud([[0.0, 0, 5], [1, 0, 5], [2, 0, 5]], [0, 0, 0])
    own = own.replace(sh=torch.zeros(3, 1, 3))
    values = getattr(own, name).clone()
    values[1].fill_(value)
    state = Exploration(SplatMeaning(own.replace(**{name: values}).replace(names=("wall",))))
    refused(lambda: pack_scene(state), f"semantic.{name}", "finite", "row 1")
