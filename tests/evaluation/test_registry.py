import dataclasses
import inspect
from pathlib import Path

import pytest
from messages import tells

from kfgs.evaluation import PROTOCOLS, LerfOvs3D, get_protocol

DOC = Path(__file__).resolve().parents[2] / "docs" / "protocols.md"
NAMES = """kfgs-pooled/1 kfgs-surface/1 kfgs-color/1 kfgs-removal/1 kfgs-recolor/1 feature3dgs-teacher/1 lerf-ovs-2d/1
lerf-ovs-3d/1 legaussians-mip360/1 scannet-points/1 scannet-volume/1 3dovs-closed/1 3dovs-threshold/1 3dovs-stability/1
scenesplat-fmiou/1"""
RELEVANCY = ("lerf-ovs-2d", "lerf-ovs-3d", "legaussians-mip360", "3dovs-threshold", "3dovs-stability")


def test_all_protocols_are_there():
    assert set(PROTOCOLS) == set(NAMES.split())


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_protocol_is_a_frozen_dataclass_that_says_what_it_does(name):
    protocol = get_protocol(name)
    assert protocol == get_protocol(name.partition("/")[0]) == PROTOCOLS[name]()
    assert protocol.name == name
    assert len(protocol.about) > 40
    assert protocol.__dataclass_params__.frozen
    source = inspect.getsource(type(protocol))
    for option in dataclasses.fields(protocol):
        after = source[source.index(f"    {option.name}: ") :].split("\n", 1)[1]
        assert after.lstrip().startswith('"""'), f"{name}: {option.name} has no docstring"


@pytest.mark.parametrize("name", PROTOCOLS)
def test_the_page_of_protocols_names_it(name):
    assert f"`{name}`" in DOC.read_text()


def test_options_and_presets():
    assert get_protocol("scannet-points", classes=10).classes == 10
    assert LerfOvs3D.vala().silhouette == pytest.approx(0.04, abs=0.001)
    assert LerfOvs3D().silhouette == 0.7


def test_wrong_names_get_a_hint():
    with pytest.raises(ValueError, match="got 'lerf-2d'; did you mean lerf-ovs-2d/1"):
        get_protocol("lerf-2d")
    with pytest.raises(ValueError, match="expected one of kfgs-pooled/1, .*, got 'lerf-ovs-2d/2'"):
        get_protocol("lerf-ovs-2d/2")
    with pytest.raises(TypeError, match="expected options among split, got level; leave them out"):
        get_protocol("kfgs-color", level=1)


@pytest.mark.parametrize(
    ("name", "option", "value", "says"),
    [
        *((name, "negatives", (), "at least one text") for name in RELEVANCY),
        *((name, "scale", 0.0, "(0, inf)") for name in RELEVANCY),
        *((name, "threshold", float("nan"), "[0, 1]") for name in RELEVANCY if name != "3dovs-stability"),
        ("3dovs-stability", "run", 0, "[1, inf)"),
        ("3dovs-stability", "fractions", (0.9, 0.1), "(0.9, inf)"),
        ("feature3dgs-teacher", "most", 0, "[1, inf)"),
        ("feature3dgs-teacher", "split", (0, 2), "[1, inf)"),
        ("feature3dgs-teacher", "split", (8, -1), "[0, inf)"),
        ("feature3dgs-teacher", "size", (0, 5), "[1, inf)"),
        ("feature3dgs-teacher", "largest", (0, 5), "[1, inf)"),
    ],
)
def test_options_that_make_no_sense_are_refused(name, option, value, says):
    with pytest.raises(ValueError, match=tells(option, says)):
        get_protocol(name, **{option: value})
