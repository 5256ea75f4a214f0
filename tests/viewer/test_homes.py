"""The same person in the page, in a notebook's widget and in the exported file: what they do selects what Python selects."""

import base64
import json
from contextlib import contextmanager

import cases_explorer
import cases_page
import numpy as np
import pytest
import torch
from cases_page import agree, errors_of, mask, set_slider
from cases_web import needs_chromium

from kfgs.formats import read_splats, write_splats
from kfgs.viewer import Exploration, FieldMeaning, Viewer

pytestmark = needs_chromium

WIDGET = """async ({script, style, values}) => {
  const decode = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const encode = (bytes) => btoa(String.fromCharCode(...bytes));
  const state = {...values, data: new DataView(decode(values.data).buffer)}, handlers = {};
  const model = {
    get: (name) => state[name],
    on: (name, handler) => (handlers[name] ??= []).push(handler),
    set: (name, value) => (state[name] = value),
    save_changes: () => {},
    send: async (message, _, buffers) => {
      const [answer, attached] = await python(JSON.stringify(message), buffers.map(encode));
      handlers["msg:custom"].forEach((handler) => handler(answer, [new DataView(decode(attached).buffer)]));
    },
  };
  document.head.append(Object.assign(document.createElement("style"), {textContent: style}));
  const made = await import(URL.createObjectURL(new Blob([script], {type: "text/javascript"})));
  await made.default.render({model, el: document.body});
  globalThis.viewer = document.querySelector(".kfgs").viewer;
}"""


@contextmanager
def in_page(page, state, out):
    with Viewer(state, out=out).open_page() as served:
        page.goto(served.url)
        yield


@contextmanager
def in_file(page, state, out):
    page.goto(Viewer(state).save_html(out.parent / "scene.html").as_uri())
    yield


@contextmanager
def in_widget(page, state, out):
    pytest.importorskip("anywidget")
    widget = Viewer(state, out=out).widget

    def python(message, attached):
        sent = []
        widget.send = lambda *found: sent.append(found)
        widget._handle_custom_msg(json.loads(message), [base64.b64decode(part) for part in attached])
        ((answer, (more,)),) = sent
        return answer, base64.b64encode(more).decode()

    page.expose_function("python", python)
    page.set_content("<body></body>")
    values = {name: getattr(widget, name) for name in ("header", "wire", "view", "things", "height")}
    values["data"] = base64.b64encode(widget.data).decode()
    page.evaluate(WIDGET, {"script": str(widget._esm), "style": str(widget._css), "values": values})
    yield
    widget.close()


HOMES = pytest.mark.parametrize("home", [in_page, in_file, in_widget], ids=["page", "file", "widget"])
DROP = """([name, content]) => {
  const moved = new DataTransfer();
  moved.items.add(new File([Uint8Array.from(atob(content), (letter) => letter.charCodeAt(0))], name));
  document.querySelector(".stage").dispatchEvent(new DragEvent("drop", {dataTransfer: moved, bubbles: true, cancelable: true}));
}"""


@HOMES
def test_a_file_that_is_dropped_opens_in_a_page_alone(browser, tmp_path, home, monkeypatch):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    write_splats(cases_page.exploration().cloud("color")[torch.arange(450) < 77], tmp_path / "small.ply")
    content = base64.b64encode((tmp_path / "small.ply").read_bytes()).decode()
    page = browser.new_page(viewport={"width": 800, "height": 600})
    errors = errors_of(page)
    with home(page, cases_page.exploration(), tmp_path / "out"):
        page.wait_for_selector(".kfgs:not([aria-busy])")
        page.evaluate(DROP, ["small.ply", content])
        if home is in_page:
            page.wait_for_selector(".kfgs:not([aria-busy]) .said:has-text('77 Gaussians')")
            assert (page.locator("h1").inner_text(), page.evaluate("viewer.model.total('semantic')")) == ("small", 77)
            page.evaluate(DROP, ["..\\wrong.ply", base64.b64encode(b"no splat").decode()])
            page.wait_for_selector("[role=alert]:has-text('wrong.ply: expected')")
            assert str(tmp_path) not in page.locator(".toast").inner_text()
        else:
            page.wait_for_selector("[role=alert]:has-text('run “kfgs view small.ply”')")
    assert list((tmp_path / "temporary").iterdir()) == []
    page.close()
    assert errors == []


@HOMES
def test_one_person_everywhere(browser, tmp_path, home):
    state, out = cases_page.exploration(), tmp_path / "out"
    page = browser.new_page(viewport={"width": 800, "height": 600})
    errors = errors_of(page)
    with home(page, state, out):
        page.wait_for_selector(".kfgs:not([aria-busy])")
        page.fill("#query", "lamp")  # no class
        page.press("#query", "Enter")
        needs = "kfgs view” or in a notebook" if home is in_file else "--teacher"
        page.wait_for_selector(f"[role=alert]:has-text('“lamp” is none of the classes'):has-text('{needs}')")
        page.fill("#query", "chair")  # query
        page.press("#query", "Enter")
        page.wait_for_selector("h2:has-text('Search: chair')")
        state.ask("chair")
        agree(page, state)
        set_slider(page, "gamma", 0.5)
        state.set_gamma(0.5)
        agree(page, state)
        set_slider(page, "lambda", 0.35)
        state.set_distance(0.35)
        agree(page, state)
        none = int((state.labels("color") < 0).sum())
        said = page.locator("#lambda-said").inner_text()
        assert said.startswith(f"{none} of 450 Gaussians are farther than 0.35 from")
        x, y, width, height = page.locator(".stage").bounding_box().values()
        page.mouse.click(x + width / 2, y + height / 2)  # pick: perhaps nothing is there
        page.evaluate("viewer.model.pick('color', 200)")
        page.wait_for_selector(".picked p")
        assert "colour Gaussian 200" in page.locator(".picked").inner_text()
        page.keyboard.press("3")  # lasso
        page.mouse.move(x + 0.1 * width, y + 0.1 * height)
        page.mouse.down()
        for across, down in ((0.6, 0.1), (0.6, 0.9), (0.1, 0.9)):
            page.mouse.move(x + across * width, y + down * height, steps=3)
        page.mouse.up()
        selected = mask(page, "color")
        assert 0 < selected.sum() < len(selected)
        page.press(".stage", "Delete")  # remove
        assert page.evaluate("viewer.model.counts('color').total") == int((~selected).sum())
        page.keyboard.press("Control+z")  # undo
        np.testing.assert_array_equal(mask(page, "color"), selected)
        if home is in_file:  # export
            assert not page.locator("text=Save Gaussians").is_visible()
            saved = json.loads(page.evaluate("JSON.stringify(viewer.model)"))
            bits = np.packbits(selected, bitorder="little").tobytes()
            assert base64.b64decode(saved["sides"]["color"]["selected"]) == bits
        else:
            page.click("button:text-is('Parts')")
            page.click("li:has-text('chair 1') button, li:has-text('part 1') button")
            part = mask(page, "color")
            assert 0 < part.sum() <= selected.sum()
            assert not (part & ~selected).any()
            page.press(".stage", "Control+z")
            page.click("text=Save Gaussians")
            page.wait_for_selector("[role=alert]:has-text('Saved:')")
            written = read_splats(out / "selection_001" / "selection_color.ply")
            np.testing.assert_allclose(written.means, state.cloud("color").means[selected], rtol=1e-6)
            page.press(".stage", "Delete")
            page.click("text=Save edited scene")
            page.wait_for_selector("[role=alert]:has-text('edited_001')")
            assert len(read_splats(out / "edited_001" / "color.ply")) == int((~selected).sum())
    page.close()
    assert errors == []


@pytest.mark.parametrize("phrase", ["1", "null"])
def test_a_phrase_that_only_python_can_answer(browser, tmp_path, phrase):
    field = cases_explorer.field("fused")
    words = {phrase: field.decode(field.latents[20])}
    meaning = FieldMeaning(field, cases_explorer.classes(), embed=words.__getitem__)
    state = Exploration(meaning, cases_explorer.cloud(field.gaussians.means[:40] + 0.05), distance=1.0)
    page = browser.new_page(viewport={"width": 800, "height": 600})
    errors = errors_of(page)
    with in_page(page, state, tmp_path / "out"):
        page.wait_for_selector(".kfgs:not([aria-busy])")
        page.fill("#query", phrase)
        page.press("#query", "Enter")
        page.wait_for_selector(f"h2:has-text('Search: {phrase}')")
        page.evaluate("viewer.settled()")  # the renderer hears of it with the next frame
        state.ask(phrase)
        agree(page, state)
        assert state.selected("semantic").any()
        assert page.evaluate("viewer.panes.renderer.inTexture === viewer.model.answer.scores")
    page.close()
    assert errors == []
