"""Packed scenes that are kept: found again as long as nothing changed, never a reason to fail, and corrected if outdated."""

import os
import re
import subprocess
import sys
import time
from contextlib import contextmanager
from urllib.request import urlopen

import cases_explorer
import cases_page
import pytest
from cases_web import SECONDS, needs_chromium, software_chromium

from kfgs.formats import SplatFile, write_splats
from kfgs.page import kept
from kfgs.page.document import PYTHON_START, document
from kfgs.page.kept import keep_scene, read_scene, scene_key, scenes_folder
from kfgs.page.server import PageServer
from kfgs.viz.explorer import Session
from kfgs.viz.explorer.html import scene_for_page


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))


@pytest.fixture
def inputs(tmp_path):
    folder = tmp_path / "scene"
    (folder / "images").mkdir(parents=True)
    (folder / "images/a.png").write_bytes(b"picture")
    splat = tmp_path / "room.ply"
    splat.write_bytes(b"splat")
    return [folder, splat]


def test_the_same_inputs_find_the_same_scene(inputs):
    key = scene_key(["chair", None], inputs)
    assert read_scene(key) is None
    keep_scene(key, b"packed")
    assert read_scene(scene_key(["chair", None], inputs)) == b"packed"
    assert oct(scenes_folder().stat().st_mode)[-3:] == "700"


def test_whatever_changes_is_another_scene(inputs):
    folder, splat = inputs
    found = [scene_key(["chair"], inputs), scene_key(["wall"], inputs), scene_key(["chair"], [splat])]
    (folder / "images/b.png").write_bytes(b"")
    found.append(scene_key(["chair"], inputs))
    splat.with_name("room.labels.npz").write_bytes(b"labels")
    found.append(scene_key(["chair"], inputs))
    splat.write_bytes(b"tlaps")
    os.utime(splat, ns=(1, 1))
    found.append(scene_key(["chair"], inputs))
    splat.with_name("other.ply").write_bytes(b"nothing of the kind")
    assert scene_key(["chair"], inputs) == found[-1]
    assert len(set(found)) == len(found)


def test_too_many_files_are_not_looked_at(inputs, monkeypatch):
    monkeypatch.setattr(kept, "MOST_FILES", 1)
    assert scene_key([], inputs) is None


def test_a_damaged_file_is_none(inputs):
    key = scene_key([], inputs)
    keep_scene(key, b"packed")
    path = scenes_folder() / key
    for content in (path.read_bytes()[:-1], b"", path.read_bytes()[:-1] + b"D"):
        path.write_bytes(content)
        assert read_scene(key) is None


def test_the_oldest_goes(monkeypatch):
    monkeypatch.setattr(kept, "MOST", 2)
    scenes_folder().mkdir(parents=True)
    for number in range(5):
        (scenes_folder() / f"mine_{number}").write_text("my own")
    for number, name in enumerate("abc"):
        keep_scene(64 * name, name.encode())
        os.utime(scenes_folder() / (64 * name), ns=(number, number))
    assert read_scene(64 * "a") is None
    assert read_scene(64 * "b") == b"b"  # and is now the one that was used last
    keep_scene(64 * "d", b"d")
    assert [read_scene(64 * name) for name in "bcd"] == [b"b", None, b"d"]
    assert len(list(scenes_folder().glob("mine_*"))) == 5  # not ours


def test_large_scenes_push_others_out(monkeypatch):
    monkeypatch.setattr(kept, "MOST_BYTES", 100)
    for number, name in enumerate("ab"):
        keep_scene(64 * name, bytes(40))
        os.utime(scenes_folder() / (64 * name), ns=(number, number))
    assert [read_scene(64 * name) is None for name in "ab"] == [True, False]


def test_no_folder_is_no_reason_to_fail(tmp_path, monkeypatch):
    (tmp_path / "caches").write_text("a file")
    keep_scene("a", b"a")
    assert read_scene("a") is None
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "caches"))
    keep_scene("a", b"a")
    assert read_scene("a") is None

    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(kept.Path, "home", homeless)
    keep_scene("a", b"a")
    assert read_scene("a") is None
    assert scene_key([], [tmp_path / ("x" * 5000)]) is None


REMOVE = (
    "viewer.model.select('semantic', new Uint8Array(viewer.model.total('semantic')).fill(1)), viewer.model.remove()"
)


@needs_chromium[0]
@needs_chromium[1]
def test_an_outdated_scene_is_shown_and_then_replaced():
    """By the page itself, once; calls wait for Python."""
    old, new = (cases_page.exploration(("table", name, "rug")) for name in ("chair", "stool"))
    errors = []
    with PageServer(document("room", PYTHON_START)) as server, software_chromium() as browser:
        server.show(scene_for_page(old))
        page = browser.new_page(viewport={"width": 800, "height": 600})
        page.set_default_timeout(1000 * SECONDS)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(server.url)
        page.wait_for_selector(".kfgs:not([aria-busy])")
        assert "chair" in page.evaluate("viewer.model.names")
        assert page.evaluate(REMOVE) == 0  # an edit would be lost with the scene
        assert "outdated" in page.text_content(".toast:not([hidden])")
        with page.expect_navigation():
            server.show(scene_for_page(new), Session(new).call)
        page.wait_for_selector(".kfgs:not([aria-busy])")
        assert "stool" in page.evaluate("viewer.model.names")
        page.evaluate("globalThis.latest = true")
        page.evaluate("fetch('version')")
        page.wait_for_timeout(300)
        assert page.evaluate("globalThis.latest")  # not loaded once more
        assert page.evaluate(REMOVE) == 180
        assert page.evaluate("viewer.ask('stool').then(() => viewer.model.answer.words)") == "stool"
    assert errors == []


def test_the_command_shows_what_it_showed_the_last_time(tmp_path):
    write_splats(
        tmp_path / "labelled.ply", SplatFile(cases_explorer.grid_clouds()[0], classes=("wall", "chair", "table", "rug"))
    )

    def fetch(served, name):
        with urlopen(served + name, timeout=60) as answer:
            return answer.read()

    with viewing(tmp_path / "labelled.ply") as served:
        first, version = fetch(served, "pack"), fetch(served, "version")
        end = time.monotonic() + 30
        while not (written := list(scenes_folder().glob(64 * "?"))):  # beside it may be the hidden folder of its writer
            assert time.monotonic() < end
            time.sleep(0.05)
    (path,) = written
    assert read_scene(path.name) == first
    keep_scene(path.name, b"outdated")
    with viewing(tmp_path / "labelled.ply") as served:
        assert fetch(served, "pack") == b"outdated"
        assert fetch(served, "version") == version
        assert fetch(served, "pack") == first


@contextmanager
def viewing(source):
    """The address of a page of `kfgs view`."""
    command = [sys.executable, "-m", "kfgs", "view", str(source), "--where", "browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as running:
        yield next(re.search(r"http://\S+", line)[0] for line in running.stdout if "http://" in line)
        running.terminate()
