import base64
import importlib.util
import io
import json
import re
import shutil
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import torch
from messages import tells
from PIL import Image

from kfgs.gaussians import Gaussians
from kfgs.viz import add_cloud, available, headless, make_plotter, palette
from kfgs.viz.page import _furnish, _legend, save_page
from kfgs.viz.points_and_ellipsoids import half_surfaces, strongest, without_gaussians

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
EMPTY = "<html><head><title>viewer\nof others</title></head><body>\n<script>'</body>'</script>\n</body></html>"


def some_gaussians(n=30, seed=0):
    generator = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    return Gaussians(
        means=rand(n, 3) * 2 - 1,
        quats=torch.randn(n, 4, generator=generator),
        scales=rand(n, 3) * 0.2 + 0.03,
        opacities=torch.linspace(0.02, 0.95, n),
        labels=torch.arange(n) % 4,
    )


@pytest.fixture
def plotter():
    if not available():
        pytest.skip(headless.probe().reason)
    plotter = make_plotter(60, 80, background="black", off_screen=True)
    yield plotter
    plotter.close()


def test_gaussians_are_exchanged_for_a_while_and_come_back(plotter):
    gaussians = some_gaussians()
    actor = add_cloud(plotter, gaussians, style="gaussians")
    add_cloud(plotter, gaussians, style="points")
    before = plotter.screenshot(return_img=True)
    kept = gaussians.opacities > 0.1
    with without_gaussians(plotter, "points", 1000) as counts:
        assert counts == [int(kept.sum()), int((~kept).sum())]
        assert not actor.GetVisibility()
        assert plotter.renderer.GetActors().GetNumberOfItems() == 3
        stand_in = plotter.renderer.GetActors().GetLastActor()
        np.testing.assert_array_equal(
            np.sort(stand_in.mapper.dataset.points, axis=0), np.sort(gaussians.means[kept], axis=0)
        )
        assert {tuple(color) for color in stand_in.mapper.dataset["rgb"]} == {
            tuple(color) for color in palette(gaussians.labels[kept])
        }
    assert actor.GetVisibility()
    assert plotter.renderer.GetActors().GetNumberOfItems() == 2
    plotter.render()
    np.testing.assert_array_equal(plotter.screenshot(return_img=True), before)


def test_stand_ins_go_even_if_writing_fails(plotter):
    actor = add_cloud(plotter, some_gaussians(), style="gaussians")
    with pytest.raises(RuntimeError, match="full disk"), without_gaussians(plotter, "ellipsoids", 1000):
        raise RuntimeError("full disk")
    assert actor.GetVisibility()
    assert plotter.renderer.GetActors().GetNumberOfItems() == 1


def test_the_strongest_are_kept_where_there_are_too_many(plotter):
    gaussians = some_gaussians()
    cloud = add_cloud(plotter, gaussians, style="gaussians").mapper.dataset
    scales, opacities = gaussians.scales.numpy().astype(float), gaussians.opacities.numpy().astype(float)
    worth = [o * max(s[0] * s[1], s[0] * s[2], s[1] * s[2]) for o, s in zip(opacities, scales, strict=True)]
    rows = strongest(cloud, 5, 0.1)
    assert (np.diff(rows) > 0).all()
    best = sorted((i for i in range(30) if opacities[i] > 0.1), key=lambda i: -worth[i])[:5]
    assert sorted(cloud["index"][rows]) == sorted(best)
    assert len(strongest(cloud, 1000, 0.5)) == int((gaussians.opacities > 0.5).sum())


def test_an_ellipsoid_is_the_surface_where_alpha_is_half(plotter):
    gaussians = some_gaussians()
    cloud = add_cloud(plotter, gaussians, style="gaussians").mapper.dataset
    rows = strongest(cloud, 1000, 0.5)
    mesh = half_surfaces(cloud, rows)
    for vertex in range(0, mesh.n_points, 17):
        i = int(cloud["index"][rows[mesh["index"][vertex]]])
        w, x, y, z = (gaussians.quats[i] / gaussians.quats[i].norm()).double().tolist()
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        inside = R.T @ (mesh.points[vertex] - gaussians.means[i].numpy()) / gaussians.scales[i].numpy()
        assert float(gaussians.opacities[i]) * np.exp(-0.5 * inside @ inside) == pytest.approx(0.5, abs=1e-4)


def test_the_box_holds_legend_and_note_and_nothing_that_is_read_as_html():
    names = ["wall", "<b>sofa", "rug", "lamp"]
    legend = _legend(torch.tensor([[1, 1], [3, -1]]), names)
    page = _furnish(EMPTY, "a & b", "5 Gaussians < 6", legend)
    assert "<title>a &amp; b</title>" in page
    assert "viewer" not in page
    given, body = page.split("</head>")
    assert body == EMPTY.split("<title>viewer\nof others</title></head>")[1]
    (text,) = re.findall(r'insertAdjacentHTML\("beforeend", (".*")\)', given)
    assert "</" not in text  # which would end the script
    box = json.loads(text)
    assert 'id="kfgs"' in box
    assert "5 Gaussians &lt; 6" in box
    for name, label, there in (
        ("&lt;b&gt;sofa", 1, True),
        ("lamp", 3, True),
        ("no class", -1, True),
        ("wall", 0, False),
    ):
        red, green, blue = palette(np.array(label), names)
        assert (f"rgb({red},{green},{blue})" in box) == there
        assert (f">{name}<" in box.replace("</span>", ">")) == there
    assert 'id=\\"kfgs' not in _furnish(EMPTY, "t", "", "")


@pytest.mark.skipif(BROWSER is None, reason="needs chromium")
@pytest.mark.skipif(importlib.util.find_spec("trame_vtk") is None, reason="needs trame-vtk")
def test_a_browser_shows_scene_legend_and_note(plotter, tmp_path):
    names, gaussians = ["wall", "sofa", "rug", "lamp"], some_gaussians()
    add_cloud(plotter, gaussians, color_by=palette(gaussians.labels, names), style="gaussians")
    plotter.camera_position = "xy"
    page = save_page(tmp_path / "room.html", plotter, labels=torch.arange(4), names=names)
    picture = tmp_path / "seen.png"
    flags = "--headless --no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --disable-gpu-sandbox"
    look = [BROWSER, *flags.split(), f"--user-data-dir={tmp_path}/profile", "--window-size=400,300"]
    look += ["--virtual-time-budget=8000", f"--screenshot={picture}", page.path.as_uri()]
    subprocess.run(look, check=True, capture_output=True, timeout=90)
    seen = np.asarray(Image.open(picture).convert("RGB")).reshape(-1, 3)
    colors = {tuple(color) for color in seen}
    assert len(colors) > 20  # letters and edges, beside the flat ones
    for label in range(4):
        exact = (seen == palette(np.array(label), names)).all(axis=1)
        assert exact.sum() > 100  # the legend's square has about 100 pixels, a point of the cloud more


@pytest.mark.skipif(importlib.util.find_spec("trame_vtk") is None, reason="needs trame-vtk")
@pytest.mark.parametrize("instead", ["points", "ellipsoids"])
def test_a_page_carries_the_scene_and_says_what_became_of_gaussians(plotter, tmp_path, instead):
    gaussians = some_gaussians()
    add_cloud(plotter, gaussians, style="gaussians")
    plotter.screenshot(return_img=True)  # places the camera
    plotter.camera.focal_point = np.array(plotter.camera.position) + plotter.camera.direction  # as look_through does
    plotter.renderer.ResetCameraClippingRange()
    plotter.render()
    before = plotter.screenshot(return_img=True)
    names = ["wall", "sofa", "rug", "lamp"]
    page = save_page(tmp_path / "room.html", plotter, instead=instead, limit=9, labels=gaussians.labels, names=names)
    text = page.path.read_text(encoding="utf-8")
    assert (page.drawn, page.left_out) == (9, 21)
    assert page.note.startswith(f"9 Gaussians are shown as {instead}, since this viewer has no Gaussians; 21 faint")
    assert page.note in text
    assert "<title>kfgs</title>" in text
    packed = base64.b64decode(re.search(r'base64Str = "([^"]+)"', text).group(1))
    scene = json.loads(zipfile.ZipFile(io.BytesIO(packed)).read("index.json"))
    (mesh,) = find(scene["scene"], "vtkPolyData")
    points = array(scene, mesh["points"], np.float32).reshape(-1, 3)
    (colors,) = [field for field in mesh["fields"] if field["name"] == "rgb"]
    rgb = array(scene, colors, np.uint8).reshape(-1, 3)
    assert len(points) == len(rgb)
    assert len(points) == 9 if instead == "points" else (len(points) > 100 and len(points) % 9 == 0)
    if instead == "points":
        for point, color in zip(points, rgb, strict=True):
            i = int((gaussians.means - torch.tensor(point)).norm(dim=1).argmin())
            assert (color == palette(gaussians.labels[i])).all()
    (camera,) = find(scene["scene"], "vtkOpenGLCamera")
    assert camera["viewAngle"] == pytest.approx(plotter.camera.view_angle)
    ahead = np.array(plotter.camera.focal_point) - plotter.camera.position
    step = np.array(camera["focalPoint"]) - plotter.camera.position
    forward = ahead / np.linalg.norm(ahead)
    np.testing.assert_allclose(step, forward * np.median((points - plotter.camera.position) @ forward), rtol=1e-4)
    np.testing.assert_array_equal(plotter.screenshot(return_img=True), before)


def array(scene, entry, dtype):
    return np.frombuffer(base64.b64decode(scene["hashes"][entry["hash"]]["content"]), dtype)


def find(part, kind):
    own = [part["properties"]] if part["type"] == kind else []
    return own + [found for child in part.get("dependencies", ()) for found in find(child, kind)]


def test_without_trame_vtk_it_says_what_to_install(plotter, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trame_vtk", None)
    monkeypatch.setitem(sys.modules, "trame_vtk.modules.vtk.serializers", None)
    add_cloud(plotter, some_gaussians())
    with pytest.raises(ImportError, match=tells("pip install trame-vtk")):
        save_page(tmp_path / "a.html", plotter)
    assert not list(tmp_path.iterdir())


def test_what_makes_no_page_is_refused(plotter, tmp_path):
    with pytest.raises(ValueError, match=tells("path:", ".html", "got 'a.htm'")):
        save_page(tmp_path / "a.htm", plotter)
    with pytest.raises(ValueError, match=tells("instead:", "'points', 'ellipsoids'", "got 'gaussians'")):
        save_page(tmp_path / "a.html", plotter, instead="gaussians")
    with pytest.raises(ValueError, match=tells("limit:", "got 0")):
        save_page(tmp_path / "a.html", plotter, limit=0)
    with pytest.raises(ValueError, match=tells("names:", "got 1")):
        save_page(tmp_path / "a.html", plotter, labels=torch.tensor([4]), names=["wall"])
    with pytest.raises(ValueError, match=tells("plotter:", "actor")):
        save_page(tmp_path / "a.html", plotter)
