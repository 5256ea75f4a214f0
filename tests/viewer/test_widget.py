"""The notebook widget: what is sent to the browser, and how calls are answered. In a notebook: test_lab.py."""

import base64
import io
import sys

import cases_explorer
import numpy as np
import pytest
import torch
from messages import refused
from PIL import Image

pytest.importorskip("anywidget")

from kfgs.splat import rasterize
from kfgs.viewer import Viewer, explore, pack


def test_explore_in_a_notebook_gives_a_viewer(monkeypatch):
    state = cases_explorer.room()
    viewer = explore(
        cases_explorer.field("fused"), state.cloud("color"), classes=cases_explorer.classes(), where="notebook"
    )
    assert isinstance(viewer, Viewer)
    viewer.ask("chair")
    packed = pack.pack_scene(viewer.state)
    assert viewer.widget.wire["words"] == "chair"
    viewer.ask(None)
    assert viewer.widget.wire["words"] is None
    assert (viewer.widget.header, viewer.widget.data) == (packed.header, packed.compressed())
    viewer.add("here", (0, 0, 0))  # once: not with the scene, too
    assert (list(viewer.widget.things), viewer.widget.header["things"]) == (["here"], {})
    bundle = viewer._repr_mimebundle_()
    assert "application/vnd.jupyter.widget-view+json" in (bundle[0] if isinstance(bundle, tuple) else bundle)
    viewer.close()
    monkeypatch.setitem(sys.modules, "anywidget", None)
    refused(lambda: Viewer(state).widget, "kfgs[notebook]", error=ImportError)


@pytest.mark.parametrize("show", ["rgb", "labels"])
def test_a_picture_stands_in_where_widgets_cannot_run(show):
    state = cases_explorer.room()
    state.set_show(show)
    bundle = Viewer(state).widget._repr_mimebundle_()
    file = base64.b64decode((bundle[0] if isinstance(bundle, tuple) else bundle)["image/jpeg"])
    picture = np.asarray(Image.open(io.BytesIO(file))).astype(int)
    assert picture.shape[:2] == (state.cameras[0].height, state.cameras[0].width)
    cloud = state.cloud("color")
    if show == "labels":
        cloud = cloud.replace(features=torch.from_numpy(state.colors("color")) / 255, sh=None)
    truth = rasterize(cloud, state.cameras[0], background=torch.ones(3)).map.clamp(0, 1)
    assert np.abs(picture / 255 - truth.numpy()).mean() < 0.03
