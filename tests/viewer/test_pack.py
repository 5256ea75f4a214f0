import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from cases_explorer import classes as few_classes
from cases_explorer import cloud, field, grid, line
from cases_web import room_state
from messages import tells
from small_room import make_room

from kfgs.viewer import Exploration, FieldMeaning, SplatMeaning, pack
from kfgs.viewer.pack import pack_scene, rounded_far
from kfgs.viewer.page import inline_script, read_text


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    state = room_state(make_room(tmp_path_factory.mktemp("room") / "room"))
    return state, pack_scene(state)


def buffer(packed, name):
    entry = packed.header["buffers"][name]
    content = packed.data[entry["offset"] : entry["offset"] + entry["length"]]
    return np.frombuffer(content, entry["type"]).reshape(entry["shape"])


def decoded(packed, side):
    """Means, quaternions, scales and opacities, bit by bit."""
    meta = packed.header["sides"][side]
    means, quats, scales, opacities = [], [], [], []
    for a, b, c, d in buffer(packed, f"{side}/splats").tolist():
        bits = a | b << 32
        place = []
        for axis in range(3):
            v = ((bits >> 21 * axis) & (2**21 - 1)) / (2**21 - 1) * 4 - 2
            u = v if abs(v) <= 1 else np.sign(v) / (2 - abs(v))
            place.append(meta["center"][axis] + u * meta["half"][axis])
        means.append(place)
        quat = [((c >> 10 * k & 1023) / 1023 - 0.5) * 2**0.5 for k in range(3)]
        quat.insert(c >> 30, max(0, 1 - sum(q * q for q in quat)) ** 0.5)
        quats.append(quat)
        scales.append([np.exp(meta["scale"][0] + meta["scale"][1] * (d >> 8 * k & 255)) for k in range(3)])
        opacities.append((d >> 24) / 255)
    return np.array(means), np.array(quats), np.array(scales), np.array(opacities)


def test_splats_are_within_half_a_step(room):
    state, packed = room
    for side in state.sides:
        own, meta = state.cloud(side), packed.header["sides"][side]
        means, quats, scales, opacities = decoded(packed, side)
        true = own.means.double().numpy()
        inside = (np.abs(true - meta["center"]) <= meta["half"]).all(axis=1)
        step = 4 * np.array(meta["half"]) / (2**21 - 1)
        assert inside.mean() > 0.97
        assert (np.abs(means - true)[inside] <= 0.51 * step).all()
        unit = torch.nn.functional.normalize(own.quats.double(), dim=1).numpy()
        assert np.abs((quats * unit).sum(axis=1)).min() > 1 - 3e-6  # a turn of less than 0.3 degrees
        assert np.abs(np.log(scales / own.scales.double().numpy())).max() <= 0.51 * meta["scale"][1]
        assert np.abs(opacities - own.opacities.numpy()).max() <= 0.51 / 255


def test_colours_are_within_half_a_step(room):
    state, packed = room
    meta, sh = packed.header["sides"]["color"], state.cloud("color").sh.double().numpy()
    words = buffer(packed, "color/dc")
    base = np.stack([(words >> shift) & 1023 for shift in (0, 10, 20)], axis=1) * meta["dc"][1] + meta["dc"][0]
    assert np.abs(base - (sh[:, 0] * 0.28209479177387814 + 0.5)).max() <= 0.51 * meta["dc"][1]
    planes = np.ascontiguousarray(buffer(packed, "color/sh").transpose(1, 0, 2)).view(np.int8).reshape(len(sh), -1)
    assert np.abs(planes[:, :45].reshape(-1, 15, 3) * meta["sh_step"] - sh[:, 1:]).max() <= 0.51 * meta["sh_step"]
    assert not planes[:, 45:].any()


def test_every_buffer_is_aligned_and_inside(room):
    _, packed = room
    end = 0
    for entry in packed.header["buffers"].values():
        assert entry["offset"] % 16 == 0
        assert entry["offset"] >= end
        end = entry["offset"] + entry["length"]
        assert entry["length"] == np.prod(entry["shape"]) * np.dtype(entry["type"]).itemsize
    assert end <= len(packed.data)
    json.dumps(packed.header, allow_nan=False)


def test_labels_and_distances_are_exact(room):
    state, packed = room
    labels, source, far = (buffer(packed, name) for name in ("semantic/labels", "color/source", "color/far"))
    assert labels.tolist() == state.labels("semantic").tolist()
    distances = np.unique(state.far)
    assert far.dtype == np.float32
    # at the start: a distance, a number next to one that no float32 tells from it, any
    for given in (float(distances[7]), float(distances[9]) * (1 - 1e-9), 0.2):
        far = rounded_far(state.far, given)
        # those that the viewer sets, a distance itself and its neighbours among them, and the one given at the start
        for distance in (*far[np.argsort(far)][::500], *np.nextafter(far[:20], np.float32(9)), np.float32(0.05), given):
            state.set_distance(max(float(distance), 1e-9))
            carried = np.where(far < state.distance, labels[source], -1)
            assert carried.tolist() == state.labels("color").tolist()


@pytest.mark.parametrize("meaning", [lambda: FieldMeaning(field("fused"), few_classes()), lambda: grid().meaning])
def test_scores_select_what_python_selects(meaning):
    state = Exploration(meaning())
    packed = pack_scene(state)
    assert list(packed.header["query"]) == list(dict.fromkeys(state.meaning.names))
    for words, entry in packed.header["query"].items():
        scores = buffer(packed, entry["buffer"])
        assert state.ask(words) is not None
        assert entry["gamma"] == state.gamma
        assert (entry["low"], entry["high"]) == state.gamma_range
        middle = float(np.nanmedian(scores)) if np.isfinite(scores).any() else 0.5  # a score itself: it is not above
        for gamma in (state.gamma, min(max(middle, entry["low"]), entry["high"])):
            state.set_gamma(gamma)
            assert (scores > np.float32(gamma)).tolist() == state.selected("semantic").tolist()


def test_no_source_and_no_harmonics():
    own = cloud([[0.0, 0, 5]], [-1])
    packed = pack_scene(Exploration(SplatMeaning(own.replace(names=("wall",))), cloud([[1.0, 0, 5]])))
    assert buffer(packed, "color/source").tolist() == [-1]
    assert np.isinf(buffer(packed, "color/far")).all()
    assert packed.header["sides"]["color"]["sh_degree"] is None
    assert packed.header["up"] == [0, 0, 1]
    assert packed.header["default_view"] is None


def test_the_page_knows_where_a_far_scene_lies():
    """What is picked there is told in the world."""
    own, colors = cloud([[0.0, 0, 5]], [0]), cloud([[500001.0, 7, 5]])
    far = SplatMeaning(own.replace(origin=(5e5, 0, 0)).replace(names=("wall",)))
    packed = pack_scene(Exploration(far, colors))
    assert packed.header["origin"] == [5e5, 0, 0]
    assert packed.header["sides"]["color"]["center"][0] == pytest.approx(1)


def test_cameras_and_thumbnails(monkeypatch):
    from cases_explorer import cameras

    monkeypatch.setattr(pack, "show_photos", lambda scene: lambda camera: np.full((*camera.size, 3), 200, np.uint8))
    scene = SimpleNamespace(cameras=cameras(2), image_paths=[Path(__file__), Path("missing.png")])
    packed = pack_scene(line(cameras=cameras(3)), scene=scene)
    first, second, third = packed.header["cameras"]
    assert first["K"] == [40, 44, 21, 13]
    assert first["viewmat"][3] == pytest.approx(-0.3)
    assert bytes(buffer(packed, first["thumbnail"])).startswith(b"\xff\xd8\xff")
    assert second["thumbnail"] is None
    assert third["thumbnail"] is None
    assert packed.header["up"] == [0, -1, 0]


def test_the_script_has_no_module_syntax_left():
    script = inline_script()
    assert "\nexport " not in script
    assert "\nimport " not in script
    assert script.startswith("const kfgs = ")
    assert "sorterMain" in read_text("sorter.js")


@pytest.mark.parametrize("name", ["quats", "scales", "opacities", "sh"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused(name, value):
    own = cloud([[0.0, 0, 5], [1, 0, 5], [2, 0, 5]], [0, 0, 0])
    own = own.replace(sh=torch.zeros(3, 1, 3))
    values = getattr(own, name).clone()
    values[1].fill_(value)
    state = Exploration(SplatMeaning(own.replace(**{name: values}).replace(names=("wall",))))
    with pytest.raises(ValueError, match=tells(f"semantic.{name}", "finite", "row 1")):
        pack_scene(state)
