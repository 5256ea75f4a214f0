"""The renderer in a headless Chromium with software WebGL, and a room for it, for the tests of the viewer."""

import base64
import json
from contextlib import contextmanager
from pathlib import Path

import cases_color
import numpy as np
import pytest
import torch

from kfgs.gaussians import Gaussians
from kfgs.scenes import load_scene
from kfgs.splat.sh import rgb_to_sh0
from kfgs.viewer import Exploration, SplatMeaning
from kfgs.viewer.page import inline_script
from kfgs.viz import palette

CHROMIUM = next((path for path in ("/usr/bin/chromium", "/usr/bin/chromium-browser") if Path(path).exists()), None)
SECONDS = 300  # of patience with a busy machine, for each thing that is waited for
SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


def has_playwright():
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        return False
    return True


needs_chromium = [
    pytest.mark.skipif(not has_playwright(), reason="needs playwright"),
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium"),
]

START = """async ({header, data}) => {
  const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
  globalThis.packed = {header, data: bytes.buffer};
  globalThis.canvas = document.querySelector("canvas");
  globalThis.renderer = new kfgs.Renderer(canvas, packed, {background: [0.25, 0.5, 0.75]});
}"""

PICTURE = """async ({camera, side, look, marks}) => {
  canvas.width = camera.width;
  canvas.height = camera.height;
  renderer.side = side;
  const scores = look.question === undefined ? null : kfgs.bufferOf(packed, `scores/${look.question}`);
  renderer.setLook({mode: "color", hidden: null, dim: false, outline: null, mixing: 1, ...look, scores});
  renderer.camera = camera;
  renderer.draw();
  await renderer.ordered();
  renderer.draw();
  return base64(shown());
}"""

BASE64 = """
const base64 = (bytes) => {
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
};
const shown = () => {
  const { width, height } = canvas;
  const flat = new OffscreenCanvas(width, height).getContext("2d");
  flat.drawImage(canvas, 0, 0);
  return flat.getImageData(0, 0, width, height).data;
};
"""
PAPER = torch.tensor([0.25, 0.5, 0.75])


class Viewer:
    """One tab with one renderer."""

    def __init__(self, browser, packed, before=""):
        self.page = browser.new_page(viewport={"width": 400, "height": 300})
        self.page.set_default_timeout(1000 * SECONDS)
        self.errors = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", self._hear)
        self.page.set_content(f"<canvas></canvas><script>{before}{inline_script()}{BASE64}</script>")
        self.run(START, {"header": packed.header, "data": base64.b64encode(packed.data).decode()})

    def _hear(self, said):
        """The driver remarks that reading a picture back takes time: no fault."""
        if said.type in ("error", "warning") and "GL Driver Message" not in said.text:
            self.errors.append(said.text)

    def run(self, script, argument=None):
        return self.page.evaluate(script, argument)

    def picture(self, camera, side="color", **look):  # [H, W, 3] in [0, 1]
        argument = {"camera": as_json(camera), "side": side, "look": look}
        pixels = np.frombuffer(base64.b64decode(self.run(PICTURE, argument)), np.uint8)
        return pixels.reshape(camera.height, camera.width, 4)[..., :3] / 255


@contextmanager
def software_chromium(*more):
    """A browser that draws without a GPU; `more` are further options of its command line."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=[*SOFTWARE, *more])
        yield opened
        opened.close()


def as_json(camera):
    K = camera.K.double()
    return {
        "viewmat": camera.viewmat.double().flatten().tolist(), "near": camera.near,
        "fx": float(K[0, 0]), "fy": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2]),
        "width": camera.width, "height": camera.height,
    }  # fmt: skip


def numbers(text, kind):
    """An array that came as base64."""
    return np.frombuffer(base64.b64decode(text), kind)


def psnr(picture, truth):
    return float(-10 * np.log10(np.mean((picture - truth) ** 2)))


def room_state(room: Path):
    """The toy room's surface: discs of any direction whose colour depends on the view, and a semantic cloud of every third.

    Some semantic Gaussians have no class, and no source is near some colour Gaussians.
    """
    generator = torch.Generator().manual_seed(3)
    rand = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    surface, labels = cases_color.surface(room)
    n = len(surface)
    sh = 0.3 * (rand(n, 16, 3) - 0.5)
    sh[:, 0] = rgb_to_sh0(torch.from_numpy(palette(labels)).float() / 255 * (1 - 0.5 * rand(n, 1)))
    color = Gaussians(
        means=surface.means,
        quats=torch.randn(n, 4, generator=generator),
        scales=torch.tensor([0.1, 0.05, 0.01]) * (0.5 + rand(n, 1)),
        opacities=0.05 + 0.94 * rand(n),
        sh=sh,
    )
    some = slice(None, None, 3)
    known = torch.where(rand(len(labels[some])) < 0.1, -1, labels[some])
    semantic = surface[some].replace(labels=known)
    score = rand(len(semantic)).numpy().astype(np.float32)
    names = tuple(json.loads((room / "classes.json").read_text()))
    file = semantic.replace(scores=score, names=names)
    cameras = load_scene(room).cameras
    return Exploration(SplatMeaning(file), color, cameras=cameras, distance=0.2)
