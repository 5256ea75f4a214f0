"""A real browser and the page's server in a process of its own, for the tests of the explorer's page."""

import io
import os
import re
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from types import SimpleNamespace
from urllib.parse import urlsplit

import cases_page
import numpy as np
import pytest
from PIL import Image

from kfgs.viz import available, palette
from kfgs.viz.camera_view import camera_of

CHROMIUM = next((path for path in ("/usr/bin/chromium", "/usr/bin/chromium-browser") if Path(path).exists()), None)
SECONDS = 300  # of patience with a busy machine, for each thing that is waited for
SIZE = {"width": 900, "height": 420}


def has_playwright():
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        return False
    return True


needs_browser = [
    pytest.mark.skipif(not has_playwright(), reason="needs playwright"),
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium"),
    pytest.mark.skipif(not available(), reason="needs a driver that draws"),
]


@contextmanager
def served(out):
    """The page in a process of its own, as the command line serves it; ended with Ctrl-C, as a person does."""
    folders = [str(Path(cases_page.__file__).parent), str(Path(__file__).parents[1])]
    process = subprocess.Popen(
        [sys.executable, cases_page.__file__, str(out)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(folders)},
    )  # fmt: skip
    said = []
    reader = threading.Thread(target=lambda: said.extend(iter(process.stderr.readline, "")))
    reader.start()
    try:
        end = monotonic() + SECONDS
        while not any("http" in line for line in said):
            assert process.poll() is None, f"the server ended: {''.join(said)}"
            assert monotonic() < end, "no link was given"
            reader.join(0.05)
        url = re.search(r"http://\S+", "".join(said)).group()
        yield SimpleNamespace(url=url, out=out, process=process, said=said)
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
        process.stdout.close()
        reader.join()
        process.stderr.close()


@contextmanager
def chromium():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield opened
        opened.close()


def open_page(browser, server, scale=1):
    """A tab in which the clouds are shown, and the hosts that it has asked for anything."""
    page = browser.new_context(viewport=SIZE, device_scale_factor=scale).new_page()
    page.set_default_timeout(1000 * SECONDS)
    page.hosts, page.errors = [], []
    page.on("request", lambda request: page.hosts.append(urlsplit(request.url)))
    page.on("websocket", lambda socket: page.hosts.append(urlsplit(socket.url)))
    page.on("pageerror", lambda error: page.errors.append(str(error)))
    page.goto(server.url)
    page.wait_for_selector("#query")
    until(page, lambda: colored(clouds(page)).sum() > 100)
    return page


def until(page, condition):
    """Wait for something that the page shows."""
    end = monotonic() + SECONDS
    while not condition():
        assert monotonic() < end, "it did not happen"
        page.wait_for_timeout(100)


def clouds(page):  # [H, W, 3] uint8
    picture = Image.open(io.BytesIO(page.locator(".clouds").screenshot(scale="css")))
    return np.asarray(picture.convert("RGB"))


def settled(page):
    """The picture once it has stopped changing: the first ones of a tab are coarse."""
    pictures = [clouds(page)]

    def rests():
        page.wait_for_timeout(500)
        pictures.append(clouds(page))
        return np.array_equal(pictures[-1], pictures[-2])

    until(page, rests)
    return pictures[-1]


def colored(picture):  # [H, W, 3] -> [H, W] bool
    """Clearly coloured; the legend and the titles are left out."""
    height, width = picture.shape[:2]
    clear = picture.max(2).astype(int) - picture.min(2) > 110  # the rest is faint
    clear[: height // 10] = False
    clear[height // 2 :, : width // 5] = False
    return clear


def changed(picture, before):
    """How many pixels look otherwise."""
    return int((np.abs(picture.astype(int) - before).max(2) > 60).sum())


def near(picture, label):  # [H, W, 3] -> [H, W] bool
    """Of a class's colour."""
    return (np.abs(picture.astype(int) - palette(np.array(label))).max(-1) < 40) & colored(picture)


def places(tmp_path, shape):
    """Where the Gaussians of both clouds lie in the page's picture, [N, 2] for each side; kfgs's camera tells."""
    with cases_page.explorer(tmp_path) as opened:
        opened.plotter.window_size = shape[1], shape[0]
        opened.reset_view()
        if shape[1] / 2 < shape[0]:  # narrow panes are seen from further away
            opened.plotter.camera.Dolly(shape[1] / 2 / shape[0])
        camera = camera_of(opened.plotter, (0, 0))
        left = [renderer.GetOrigin()[0] for renderer in opened.plotter.renderers]
        found = {}
        for side, offset in zip(opened.state.sides, left, strict=True):
            seen = opened.state.cloud(side).means.double() @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
            xy = (seen @ camera.K.T)[:, :2] / seen[:, 2:]
            found[side] = xy.numpy() + np.array([offset, 0])
    return found


def said_lines(page):
    return page.locator(".numbers p").all_inner_texts()


def wait_lines(page, state):
    """Until the page says the numbers of a state."""
    until(page, lambda: said_lines(page) == state.lines())


def set_slider(page, name, at):
    page.locator(f"#{name}").evaluate("(e, at) => { e.value = at; e.dispatchEvent(new Event('input')); }", at)


def check_picked(page, state, side):
    """What the page says of the picked Gaussian is what the state says; returns its class."""
    lines = page.locator(".picked p").all_inner_texts()
    index = int(re.match(r"(?:semantic|colour) Gaussian (\d+): ", lines[0]).group(1))
    assert lines[0].startswith({"semantic": "semantic", "color": "colour"}[side])
    picked = state.pick(side, index)
    assert lines == picked.lines()
    return picked.label


def click(page, place, steps=0):
    """A click at a place of the clouds; with steps, the mouse moves 30 pixels while the button is down."""
    box = page.locator(".clouds").bounding_box()
    x, y = box["x"] + place[0], box["y"] + place[1]
    page.mouse.move(x, y)
    page.mouse.down()
    if steps:
        page.mouse.move(x + 30, y + 10, steps=steps)
    page.mouse.up()


def check_hosts(page, server):
    """Nothing was asked of anyone but the server, and nothing went wrong."""
    assert page.errors == []
    asked = {(host.scheme, host.netloc) for host in page.hosts if host.scheme not in ("blob", "data")}
    netloc = urlsplit(server.url).netloc
    assert asked == {("http", netloc), ("ws", netloc)}
