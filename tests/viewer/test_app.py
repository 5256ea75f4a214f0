"""The exported file in a browser without a network: what it counts and selects is what Python counts and selects."""

import io
import itertools
import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import cases_explorer
import cases_page
import numpy as np
import pytest
import torch
from cases_web import SECONDS, needs_chromium, software_chromium
from PIL import Image

from kfgs.labels import EditList
from kfgs.labels.edits.edit_list import read_edits
from kfgs.viewer import Exploration, FieldMeaning, pack
from kfgs.viewer.page import save_html

pytestmark = needs_chromium
SIDES = "color", "semantic"
VIEWMAT = "[...(viewer.panes.camera?.viewmat ?? new Float32Array(16))]"  # zeros while a new frame is to come


@pytest.fixture(scope="module")
def browser():
    with software_chromium() as opened:
        yield opened


@pytest.fixture(scope="module")
def state():
    """A fresh state for each test would be the same: tests only read it or set what they compare."""
    return cases_page.exploration()


@pytest.fixture(scope="module")
def file(state, tmp_path_factory):
    return save_html(state, tmp_path_factory.mktemp("page") / "heaps.html", title="Three <heaps>")


@pytest.fixture
def page(browser, file):
    yield from show(browser, file)


def show(browser, file, **options):
    """The file in a tab that may load nothing else; at the end nothing was asked for, and nothing went wrong."""
    context = browser.new_context(viewport={"width": 800, "height": 600}, **options)
    page = context.new_page()
    page.set_default_timeout(1000 * SECONDS)
    asked, errors = [], []

    def guard(route):
        if route.request.url == file.as_uri():
            return route.continue_()
        asked.append(route.request.url)
        return route.abort()

    page.route("**/*", guard)
    page.on("websocket", lambda socket: asked.append(socket.url))
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
    page.goto(file.as_uri())
    page.wait_for_selector(".kfgs:not([aria-busy])")
    yield page
    context.close()
    assert (asked, errors) == ([], [])


def ask(page, words):
    page.fill("#query", words)
    page.press("#query", "Enter")
    page.evaluate("viewer.settled()")


def until(page, condition):
    """Wait for something: a busy machine draws its next frame late."""
    for _ in range(20 * SECONDS):
        if condition(page):
            return
        page.wait_for_timeout(50)
    raise AssertionError("it did not happen")


def mask(page, side, kind="selected"):
    return np.array(page.evaluate(f"[...viewer.model.{kind}('{side}')]"), bool)


def set_slider(page, name, value):
    """Type the value beside a slider."""
    field = page.locator(f".slider:has(#{name}) input.number")
    field.fill(value if isinstance(value, str) else repr(value))
    field.press("Enter")


def place_of(page, side, index):
    """Where a Gaussian lies in the window."""
    x, y = page.evaluate(
        """([side, i]) => {
          const { viewmat: m, fx, fy, cx, cy } = viewer.panes.camera, p = viewer.model.position(side, i);
          const [x, y, z] = [0, 4, 8].map((r) => m[r] * p[0] + m[r + 1] * p[1] + m[r + 2] * p[2] + m[r + 3]);
          const box = viewer.stage.getBoundingClientRect();
          return [box.left + (fx * x / z + cx) / viewer.panes.ratio, box.top + (fy * y / z + cy) / viewer.panes.ratio];
        }""",
        [side, index],
    )
    return x, y


def agree(page, state):
    """Gaussian by Gaussian, and in the counts of the class list."""
    details = state.details()
    for side in state.sides:
        np.testing.assert_array_equal(mask(page, side), state.selected(side))
        np.testing.assert_array_equal(
            np.array(page.evaluate(f"[...viewer.model.labels('{side}')]")), state.labels(side)
        )
        counts = page.evaluate(f"viewer.model.counts('{side}')")
        assert counts["classes"] == [count for _, count in details[side]["classes"]]
        assert [counts[key] for key in ("total", "selected", "none")] == [
            details[side][key] for key in ("total", "selected", "none")
        ]


def scenes():
    """Distances that tie; scores of a field, compared in float32; a splat with scores; a field alone."""
    semantic, _ = cases_explorer.grid_clouds()
    field = cases_explorer.field("fused")
    near = cases_explorer.cloud(field.gaussians.means[:40] + 0.05)
    yield cases_explorer.grid()
    yield cases_explorer.grid(score=np.linspace(-1, 1, len(semantic), dtype=np.float32))
    yield Exploration(FieldMeaning(field, cases_explorer.classes()), near)
    yield Exploration(FieldMeaning(field, cases_explorer.classes()))


@pytest.mark.parametrize("scene", range(4))
def test_every_class_gamma_and_lambda_selects_what_python_selects(browser, tmp_path, scene):
    state = list(scenes())[scene]
    for page in show(browser, save_html(state, tmp_path / "scene.html")):
        agree(page, state)
        for name in state.meaning.names:
            asked = state.ask(name)
            page.evaluate("(words) => viewer.ask(words)", name)
            scores = asked.selection.scores
            for gamma in (state.gamma, float(scores.median()), float(np.float64(scores.max()) * 0.7)):
                state.set_gamma(min(max(gamma, asked.low), asked.high))
                page.evaluate("(gamma) => viewer.model.setGamma(gamma)", state.gamma)
                for distance in (1.0, 2**0.5, 0.3) if len(state.sides) > 1 else ():
                    state.set_distance(distance)
                    page.evaluate("(lambda) => viewer.model.setLambda(lambda)", distance)
                    agree(page, state)
                agree(page, state)


def test_a_person_searches_and_moves_gamma_and_lambda(page, state):
    ask(page, "CHAIR")
    state.ask("chair")
    agree(page, state)
    for gamma in (0.5, 0.55):
        set_slider(page, "gamma", gamma)
        state.set_gamma(gamma)
        agree(page, state)
    for distance in (0.35, 0.32, 1.0):
        set_slider(page, "lambda", distance)
        state.set_distance(distance)
        agree(page, state)
    said = page.locator(".said").inner_text()
    assert said == f"{state.selected('color').sum()} of 450 colour Gaussians score above 0.55 for “chair”."
    set_slider(page, "lambda", 0.4)
    state.set_distance(0.4)
    none = int((state.labels("color") < 0).sum())
    assert page.locator("#lambda-said").inner_text().startswith(f"{none} of 450 Gaussians are farther than 0.4 from")
    state.ask(None)


def test_a_typed_value_that_is_not_possible_is_replaced_by_the_one_that_counts(page):
    ask(page, "chair")
    suggested = page.evaluate("[viewer.model.gamma, viewer.model.lambda]")
    assert page.locator("section:has(#gamma) .note").inner_text().startswith("Suggested: ")
    for name, typed in (("gamma", ""), ("gamma", "half"), ("lambda", "-1"), ("lambda", "0")):
        set_slider(page, name, typed)
    assert page.evaluate("[viewer.model.gamma, viewer.model.lambda]") == suggested
    assert float(page.locator(".slider:has(#lambda) input.number").input_value()) == pytest.approx(suggested[1])
    set_slider(page, "gamma", "7")
    assert page.locator(".slider:has(#gamma) input.number").input_value() == "1"


def test_suggestions_show_names_as_words_and_arrow_keys_choose(page):
    page.click("#query")
    assert page.locator("[role=option] span").all_inner_texts() == list(cases_page.NAMES)
    page.keyboard.type("ch")
    assert page.locator("[role=option] span").all_inner_texts() == ["chair"]
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    page.wait_for_selector("h2:has-text('Search: chair')")
    page.keyboard.press("Escape")
    page.wait_for_selector("h2:has-text('Search: chair')", state="hidden")


def test_letters_of_one_class_only_are_enough(page):
    ask(page, "HAI")
    page.wait_for_selector("h2:has-text('Search: chair')")
    assert page.evaluate("document.activeElement === viewer.stage")  # its keys work now
    ask(page, "a")  # chair, table
    assert page.evaluate("document.activeElement === viewer.top.search.input")  # to type other words
    assert "“a” is none of the classes" in page.locator("[role=alert]:visible").inner_text()


def test_other_words_need_python_and_the_page_says_so(page):
    ask(page, "chairs in the corner")
    page.wait_for_selector("[role=alert]:visible")
    said = page.locator("[role=alert]:visible").inner_text()
    assert "is none of the classes" in said
    assert "need Python" in said
    assert page.evaluate("viewer.model.answer") is None


def test_a_late_answer_does_not_replace_a_later_search(page):
    said = page.evaluate("""async () => {
      const [now, late, said] = [viewer.link.ask.bind(viewer.link), [], []];
      viewer.link.ask = async (words) => (words === "table" && await new Promise((go) => late.push(go)), now(words));
      const slow = viewer.ask("table");
      await viewer.ask("chair");
      late.pop()();
      await slow;
      said.push(viewer.model.answer.words);
      const given_up = viewer.ask("table");
      await viewer.ask("");
      late.pop()();
      await given_up;
      return [...said, viewer.model.answer, viewer.toast.hidden, viewer.top.search.element.hasAttribute("aria-busy")];
    }""")
    assert said == ["chair", None, True, False]


def test_hidden_classes_are_not_drawn_picked_or_selected_by_hand(page, state):
    page.click("button[aria-label='Hide chair']")
    for side in SIDES:
        np.testing.assert_array_equal(mask(page, side, "drawn"), state.labels(side) != 1)
    page.evaluate("viewer.shape([[0, 0], [5000, 0], [5000, 5000], [0, 5000]], 'replace')")
    assert not (mask(page, "color") & (state.labels("color") == 1)).any()
    x, y = np.mean([place_of(page, "color", i) for i in range(150, 300)], axis=0)  # where the chairs are
    page.mouse.click(x, y)
    found = page.evaluate("viewer.model.picked?.index ?? -1")
    assert found < 0 or state.labels("color")[found] != 1
    page.hover("li[data-label='0']")
    page.click("button[aria-label='Show only table']")
    assert (page.evaluate("viewer.model.counts('color').classes[0]"), mask(page, "color", "drawn").sum()) == (150, 150)
    page.click("text=Show all")
    assert mask(page, "color", "drawn").all()


def test_a_click_picks_what_is_under_it(page, state):
    x, y = np.mean([place_of(page, "color", i) for i in range(150, 300)], axis=0)  # the middle of the chairs' heap
    page.mouse.click(x, y)
    page.wait_for_selector(".picked p")
    said = page.locator(".picked").inner_text()
    found = int(re.search(r"colour Gaussian (\d+)", said).group(1))
    assert state.labels("color")[found] == 1
    assert f"chair, score {state.scores('color')[found]:.3f}" in said
    assert f"semantic Gaussian {state.source[found]}, {float(f'{state.far[found]:.3g}')}" in said
    assert np.hypot(*(np.array(place_of(page, "color", found)) - (x, y))) < 30


def test_lasso_selects_remove_removes_and_undo_brings_back(page, state):
    page.keyboard.press("3")
    box = page.locator(".stage").bounding_box()
    corners = [(0.15, 0.2), (0.5, 0.2), (0.5, 0.75), (0.15, 0.75)]
    path = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in corners]
    places = np.array([place_of(page, "color", i) for i in range(450)])
    page.mouse.move(*path[0])
    page.mouse.down()
    for place in path[1:]:
        page.mouse.move(*place, steps=4)
    page.mouse.up()
    (left, top), (right, bottom) = path[0], path[2]
    inside = (places > (left, top)).all(1) & (places < (right, bottom)).all(1)
    edge = (np.abs(places - (left, top)).min(1) < 1) | (np.abs(places - (right, bottom)).min(1) < 1)
    selected = mask(page, "color")
    assert 0 < selected.sum() < 450
    np.testing.assert_array_equal(selected[~edge], inside[~edge])
    page.keyboard.press("Delete")
    labels = state.labels("color")[~selected]
    counts = page.evaluate("viewer.model.counts('color')")
    assert counts["classes"] == [int((labels == k).sum()) for k in range(3)]
    assert (counts["total"], counts["removed"], counts["selected"]) == (450 - selected.sum(), selected.sum(), 0)
    page.keyboard.press("Control+z")
    assert page.evaluate("viewer.model.counts('color').total") == 450
    np.testing.assert_array_equal(mask(page, "color"), selected)
    page.keyboard.press("Control+z")
    assert not mask(page, "color").any()
    page.keyboard.press("Control+Shift+Z")
    page.keyboard.press("Control+Shift+Z")
    assert page.evaluate("viewer.model.counts('color').removed") == selected.sum()


def test_grow_adds_and_shrink_drops_neighbours_and_invert_is_the_rest(page):
    ask(page, "chair")
    before = mask(page, "color")
    page.click("text=Shrink")
    small = mask(page, "color")
    assert not (small & ~before).any()
    ask(page, "table")
    before = mask(page, "color")
    page.click("text=Invert")
    np.testing.assert_array_equal(mask(page, "color"), ~before)
    page.evaluate("viewer.model.select('color', new Uint8Array(450).fill(1, 0, 1))")
    page.click("text=Grow")
    grown = mask(page, "color")
    assert 1 < grown.sum() <= 150  # one heap of three
    assert grown[:150].sum() == grown.sum()


def test_edits_are_those_of_python(page, state, tmp_path):
    """What a person does becomes an EditList, whose result has the Gaussians that the page shows."""
    ask(page, "table")
    chosen = np.flatnonzero(mask(page, "color")).tolist()
    page.evaluate("viewer.model.recolor([0.1, 0.8, 0.3])")
    page.evaluate("viewer.model.fade(0.3)")
    page.evaluate("viewer.model.fade(0.5)")  # of the same selection: in place of the other
    page.click("text=Duplicate")
    copies = np.flatnonzero(mask(page, "color")).tolist()
    assert copies == list(range(450, 450 + len(chosen)))
    page.evaluate("viewer.model.move([0, 0, 1])")
    page.evaluate("viewer.model.move([0, 0.5, 1], true)")  # of one drag
    page.evaluate(
        "viewer.model.select('color', Uint8Array.from({length: viewer.model.total('color')}, (_, i) => i < 5))"
    )
    page.locator(".stage").focus()
    page.keyboard.press("Delete")
    saved = json.loads(page.evaluate("JSON.stringify(viewer.model)"))["sides"]["color"]
    assert [edit["op"] for edit in saved["edits"]] == ["recolor", "opacity", "duplicate", "move", "remove"]
    assert (saved["edits"][1]["factor"], saved["edits"][3]["translation"]) == (0.5, [0, 0.5, 2])
    made = EditList(read_edits(saved["edits"]))
    cloud = state.cloud("color").replace(labels=torch.from_numpy(state.labels("color")))
    edited = made.apply(cloud.replace(names=cases_page.NAMES))
    kept = np.flatnonzero(mask(page, "color", "drawn"))
    here = np.array(page.evaluate("[...viewer.model.clouds.color.means]")).reshape(-1, 3)[kept]
    np.testing.assert_allclose(here, edited.means, atol=1e-4)
    np.testing.assert_array_equal(np.array(page.evaluate("[...viewer.model.labels('color')]"))[kept], edited.labels)
    opacities = np.array(
        page.evaluate(
            "Array.from({length: viewer.model.total('color')}, (_, i) => viewer.model.clouds.color.opacityOf(i))"
        )
    )
    np.testing.assert_allclose(opacities[kept], edited.opacities, atol=1 / 255)
    for _ in range(5):
        page.keyboard.press("Control+z")
    assert page.evaluate("[viewer.model.total('color'), viewer.model.now.edits.length]") == [450, 1]
    for _ in range(5):
        page.keyboard.press("Control+Shift+Z")
    assert json.loads(page.evaluate("JSON.stringify(viewer.model)"))["sides"]["color"]["edits"] == saved["edits"]
    page.click("text=Restore all")
    assert not page.evaluate("viewer.model.edited")
    assert page.evaluate("viewer.model.total('color')") == 450


def test_a_reload_keeps_the_work_and_a_saved_state_opens_again(page, tmp_path):
    ask(page, "chair")
    set_slider(page, "gamma", 0.5)
    page.evaluate("viewer.model.recolor([0.1, 0.8, 0.3])")
    page.click("button[aria-label='Hide table']")
    with page.expect_download() as download:
        page.click("text=Save state")
    download.value.save_as(tmp_path / "state.json")
    before = page.evaluate("viewer.state()")
    assert {"mode", "view"} < set(json.loads(before))
    assert json.loads((tmp_path / "state.json").read_text()) == json.loads(before)
    until(page, lambda tab: tab.evaluate("sessionStorage.getItem(viewer.place)") == before)
    page.on("dialog", lambda dialog: dialog.accept())  # "changes may not be saved"
    page.reload()
    page.wait_for_selector(".kfgs:not([aria-busy])")
    assert page.evaluate("viewer.state()") == before
    page.click("text=Restore all")
    page.evaluate("viewer.ask('table')")
    page.evaluate("viewer.model.invert()")
    page.set_input_files("input[type=file]", tmp_path / "state.json")
    until(page, lambda tab: tab.evaluate("viewer.state()") == before)
    page.keyboard.press("Control+z")  # one step of undo
    assert page.evaluate("[viewer.model.answer.words, viewer.model.byHand]") == ["table", True]


def open_state(page, folder, state):
    (folder / "state.json").write_text(state if isinstance(state, str) else json.dumps(state))
    page.evaluate("viewer.say('')")
    page.set_input_files("input[type=file]", folder / "state.json")


def test_a_state_without_a_question_ends_the_one_that_is_shown(page, tmp_path):
    saved = page.evaluate("JSON.stringify(viewer.model)")
    ask(page, "chair")
    open_state(page, tmp_path, saved)
    until(page, lambda tab: tab.evaluate("JSON.stringify(viewer.model)") == saved)


def test_a_selection_by_example_is_kept_as_a_selection(page):
    """Nobody answers "like the selection" when the page is opened again."""
    ask(page, "chair")
    selected = mask(page, "color")
    page.evaluate("viewer.model.ask({...viewer.model.answer, words: 'like the selection', example: true})")
    page.evaluate("viewer.open(JSON.parse(JSON.stringify(viewer.model)))")
    np.testing.assert_array_equal(mask(page, "color"), selected)
    assert page.evaluate("[viewer.model.answer, viewer.toast.hidden]") == [None, True]


def test_a_state_that_somebody_changed_is_refused_as_a_whole(page, tmp_path):
    ask(page, "chair")
    page.evaluate("viewer.model.fade(0.5)")
    before = page.evaluate("JSON.stringify(viewer.model)")
    own = json.loads(before)
    rows = {"kind": "index", "indices": [0, 1]}
    wrong = [
        {"op": "explode", "where": rows},
        {"op": "remove", "where": {"kind": "class", "name": "chair"}},
        {"op": "remove", "where": {"kind": "index", "indices": [450]}},
        {"op": "opacity", "where": rows, "factor": 5},
        {"op": "recolor", "where": rows, "mode": "tint"},
        {"op": "move", "where": rows, "translation": [0, 0]},
    ]
    states = [own | {"sides": own["sides"] | {"color": own["sides"]["color"] | {"edits": [edit]}}} for edit in wrong]
    other = {"format": "kfgs.view", "version": 1}
    edits = {"format": "kfgs.edits", "version": 1, "edits": []}  # of "Save edited scene"
    for state in (*states, {}, "no JSON", edits, other, other | {"sides": {"color": {"count": 3}}}):
        open_state(page, tmp_path, state)
        page.wait_for_selector("[role=alert]:visible")
        said = page.locator("[role=alert]:visible").inner_text()
        assert re.match("This (state|file) (is|has) ", said)
        assert ("kfgs_view.json" in said) == ("This file" in said)  # which file is wanted instead
        assert page.evaluate("JSON.stringify(viewer.model)") == before


def test_a_ball_selects_what_lies_in_it_and_a_drag_moves_it(page):
    middle = np.mean([place_of(page, "color", i) for i in range(150, 300)], axis=0)
    page.keyboard.press("5")
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 30, middle[1], steps=3)
    page.mouse.up()
    selected = np.flatnonzero(mask(page, "color"))
    assert 0 < len(selected) <= 150
    assert set(selected) <= set(range(150, 300))
    before = np.array(place_of(page, "color", int(selected[0])))
    page.keyboard.press("6")
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 40, middle[1] - 20, steps=4)
    page.mouse.up()
    assert np.array(place_of(page, "color", int(selected[0]))) - before == pytest.approx([40, -20], abs=8)
    page.keyboard.press("Control+z")
    assert place_of(page, "color", int(selected[0])) == pytest.approx(before)


def test_undo_and_drags_repeat_no_earlier_edit(page):
    """The clouds of every step are kept; what an edit did not change is the same array."""
    ask(page, "table")
    page.evaluate("viewer.model.recolor([0.1, 0.8, 0.3])")
    before = page.evaluate_handle("viewer.model.clouds.color")
    page.evaluate("viewer.model.move([1, 0, 0])")
    page.evaluate("viewer.model.move([0, 1, 0], true)")
    moved = page.evaluate_handle("viewer.model.clouds.color")
    assert page.evaluate("([a, b]) => a.dc === b.dc && a.means !== b.means", [before, moved])
    offset = page.evaluate(
        "([a, b]) => { const i = [...viewer.model.selected('color')].indexOf(1); "
        "return [0, 1, 2].map((axis) => b.means[3 * i + axis] - a.means[3 * i + axis]); }",
        [before, moved],
    )
    assert offset == pytest.approx([1, 1, 0], abs=1e-6)
    page.keyboard.press("Control+z")  # after Enter in the search box, keys are those of the view
    assert page.evaluate("cloud => cloud === viewer.model.clouds.color", before)
    page.keyboard.press("Control+Shift+Z")
    assert page.evaluate("cloud => cloud === viewer.model.clouds.color", moved)


def test_parts_end_when_their_gaussians_go_elsewhere(page):
    ask(page, "table")
    parts = "{side: 'color', name: 'table', parts: [{count: 1, corners: Array(8).fill([0, 0, 0])}], numbers: []}"
    for edit, left in (
        ("recolor([1, 0, 0])", True),
        ("move([0, 0, 1])", False),
        ("undo()", False),
        ("remove()", False),
    ):
        page.evaluate(f"viewer.model.setParts({parts})")
        page.evaluate(f"viewer.model.{edit}")
        assert page.locator("section:has-text('Connected parts')").is_visible() == left


def test_a_field_alone_has_no_colours_to_change_and_its_gaussians_need_no_adjective(browser, tmp_path):
    state = Exploration(FieldMeaning(cases_explorer.field("fused"), cases_explorer.classes()))
    for page in show(browser, save_html(state, tmp_path / "page.html")):
        ask(page, state.meaning.names[0])
        assert "score above" in page.locator(".said").inner_text()
        assert "semantic" not in page.locator(".said, .panel").first.inner_text()
        assert page.locator("text=Opacity").is_visible()
        assert not page.locator("text=Recolour").is_visible()


def test_a_tooltip_names_what_the_pointer_rests_on(page):
    middle = np.mean([place_of(page, "color", i) for i in range(150, 300)], axis=0)
    page.mouse.move(*middle)
    page.wait_for_selector(".tip:visible")
    assert page.locator(".tip").inner_text().startswith("chair, 0.")
    page.mouse.move(middle[0] + 3, middle[1])
    page.mouse.down()
    assert not page.locator(".tip").is_visible()
    page.mouse.up()


def test_without_keys_a_selection_can_be_added_to(page):
    """As on a tablet, which has no Shift."""
    first, second = (
        np.mean([place_of(page, "color", i) for i in range(start, start + 150)], axis=0) for start in (150, 0)
    )
    page.keyboard.press("5")
    for how, middle in (("Select anew", first), ("Add to the selection (Shift)", second)):
        page.click(f"button[title='{how}']")
        page.mouse.move(*middle)
        page.mouse.down()
        page.mouse.move(middle[0] + 30, middle[1], steps=3)
        page.mouse.up()
    selected = mask(page, "color")
    assert selected[:150].any()
    assert selected[150:300].any()
    page.keyboard.press("1")
    assert not page.locator("button[title='Select anew']").is_visible()


def test_hidden_gaussians_of_a_selection_are_told(page, state):
    ask(page, "chair")
    count = int(mask(page, "color").sum())
    page.evaluate("viewer.model.setHidden([1])")
    hidden = int((mask(page, "color") & (state.labels("color") == 1)).sum())
    assert 0 < hidden <= count
    assert f"{hidden} of these are hidden, and change with the others." in page.locator(".said").inner_text()


def test_keys_fly_and_turn_and_help_lists_them(page):
    before = page.evaluate("viewer.eye.view.position")
    page.locator(".stage").focus()
    page.keyboard.down("w")
    until(page, lambda tab: tab.evaluate("viewer.eye.view.position") != before)
    page.keyboard.up("w")
    page.evaluate("new Promise(requestAnimationFrame)")
    after = page.evaluate("viewer.eye.view.position")
    assert before != after
    page.keyboard.press("ArrowLeft")
    assert page.evaluate("viewer.eye.view.position") != after
    page.keyboard.press("?")
    assert page.locator("dialog dt").count() > 10
    page.keyboard.press("Escape")
    assert not page.locator("dialog").is_visible()


def looks_at(point, look, farthest, tab):
    """Whether the camera looks at a point, from no farther away."""
    place, ahead = np.array(tab.evaluate(look)).reshape(2, 3)
    far = np.linalg.norm(point - place)
    return far < farthest + 1e-6 and np.allclose(ahead, (point - place) / far, atol=1e-4)


def test_buttons_go_to_the_scenes_views(browser, tmp_path):
    views = cases_explorer.cameras()
    for page in show(browser, save_html(cases_explorer.line(cameras=views), tmp_path / "page.html")):
        current = page.locator(".views [aria-current=true]")
        assert current.get_attribute("aria-label") == "Go to view_0"
        page.keyboard.press("]")
        until(page, lambda tab: tab.locator("[aria-current=true][aria-label='Go to view_1']").count())
        assert page.locator(".views button:not([tabindex='-1'])").count() == 1  # Tab leaves the views at once
        until(page, lambda tab: np.allclose(tab.evaluate(VIEWMAT), views[1].viewmat.flatten(), atol=1e-6))
        ask(page, "chair")
        page.locator(".stage").focus()
        page.keyboard.press("f")
        assert current.count() == 0
        middle = np.array(page.evaluate("viewer.model.extent('color').center"))
        look = "[...viewer.eye.view.position, ...viewer.eye.view.R.slice(6)]"

        farthest = max(np.linalg.norm(view.center.numpy() - middle) for view in views)
        until(page, partial(looks_at, middle, look, farthest))
        page.keyboard.press("Escape")
        page.keyboard.press("f")
        until(page, lambda tab: np.allclose(tab.evaluate(VIEWMAT), views[0].viewmat.flatten(), atol=1e-6))


def test_beside_an_upright_photo_no_wider_angle_is_seen_than_its_own(browser, tmp_path, monkeypatch):
    monkeypatch.setattr(pack, "show_photos", lambda scene: lambda camera: np.zeros((*camera.size, 3), np.uint8))
    upright = [replace(view, width=28, height=60) for view in cases_explorer.cameras()]
    state = cases_explorer.line(cameras=upright)
    file = save_html(state, tmp_path / "page.html", scene=photographed(state))
    angles = "() => { const { fx, fy, width, height } = viewer.panes.camera; return [width / fx, height / fy]; }"
    for page in show(browser, file):
        page.set_viewport_size({"width": 1400, "height": 600})
        until(page, lambda tab: tab.evaluate("viewer.canvas.width > 1000"))
        page.evaluate("viewer.settled()")
        wide, high = page.evaluate(angles)
        assert wide == pytest.approx(60 / 40, rel=0.01)  # K has fx = 40, fy = 44
        page.locator(".stage").focus()
        page.keyboard.press("p")
        until(page, lambda tab: tab.locator(".photo:visible").count())
        page.evaluate("viewer.settled()")
        assert page.evaluate(angles)[1] == pytest.approx(60 / 44, rel=0.01)  # all of it
        photo, stage = page.locator(".photo").bounding_box(), page.locator(".stage").bounding_box()
        assert photo["height"] == pytest.approx(stage["height"], abs=1)
        page.keyboard.press("p")
        page.evaluate("viewer.settled()")
        assert page.evaluate(angles) == pytest.approx([wide, high])


def test_the_photo_is_of_the_view_that_looks_the_same_way(browser, tmp_path):
    """Of two views, one is in the same place but looks back."""
    for page in show(browser, save_html(cases_explorer.line(cameras=cases_explorer.cameras()), tmp_path / "page.html")):
        found = page.evaluate("""() => {
          const { cameras } = viewer.header;
          const own = { ...cameras[0], thumbnail: "a photo" };
          const back = own.viewmat.map((value, i) => (Math.floor(i / 4) % 2 ? value : -value));
          const beside = own.viewmat.map((value, i) => value + (i === 3 ? 0.2 * viewer.eye.ball.radius : 0));
          cameras.splice(0, cameras.length, { ...own, viewmat: back }, { ...own, viewmat: beside });
          return viewer.nearestView();
        }""")
        assert found == 1


def photographed(state):
    """A scene that has a photograph of every view."""
    return SimpleNamespace(cameras=state.cameras, image_paths=[Path(__file__)] * len(state.cameras))


def test_the_list_of_views_scrolls_to_the_current_one(browser, tmp_path, monkeypatch):
    """Photos are loaded when they come into sight; their places must not move then."""
    monkeypatch.setattr(pack, "show_photos", lambda scene: lambda camera: np.zeros((*camera.size, 3), np.uint8))
    state = cases_explorer.line(cameras=cases_explorer.cameras(90))
    for page in show(browser, save_html(state, tmp_path / "page.html", scene=photographed(state))):
        page.keyboard.press("[")
        until(page, lambda tab: tab.evaluate("viewer.view") == tab.locator(".views button").count() - 1)
        page.wait_for_timeout(500)  # the list scrolls
        box, last = page.locator(".views").bounding_box(), page.locator(".views button").last.bounding_box()
        assert page.locator(".views [aria-current=true]").count() == 1
        assert page.evaluate("viewer.view") == page.locator(".views button").count() - 1
        assert last["x"] + last["width"] <= box["x"] + box["width"]


@pytest.mark.parametrize("size", [(300, 300), (360, 640), (640, 360)])
def test_a_small_tab_still_has_every_button_and_some_view(page, size):
    page.set_viewport_size(dict(zip(("width", "height"), size, strict=True)))
    for button in page.locator(".top button:visible").all():
        box = button.bounding_box()
        assert 0 <= box["x"] <= size[0] - box["width"]
    assert page.locator(".stage").bounding_box()["height"] >= 0.3 * size[1]


def test_split_slider_and_modes_draw(page):
    def picture():
        page.evaluate("viewer.settled()")
        with Image.open(io.BytesIO(page.locator("canvas").screenshot())) as opened:
            return np.asarray(opened.convert("RGB"))

    pictures = [picture()]
    for mode in ("Score", "Colour"):
        page.click(f".choice >> text={mode}")
        pictures.append(picture())
    for layout in ("split", "slider"):
        page.select_option("select[aria-label=Views]", layout)
        pictures.append(picture())
    for one, other in itertools.pairwise(pictures):
        assert (one != other).any(2).sum() > 500
    assert page.locator(".captions select").count() == 2


def test_the_page_opens_as_python_left_it(browser, tmp_path):
    state = cases_page.exploration()
    state.ask("chair")
    state.set_gamma(0.5)
    state.set_show("rgb")
    for page in show(browser, save_html(state, tmp_path / "page.html"), color_scheme="dark"):
        agree(page, state)
        assert page.get_attribute(".kfgs", "data-theme") == "dark"
        assert page.locator(".top .choice [aria-pressed=true]").inner_text() == "Colour"
        assert page.locator("button[aria-label='Undo']").is_disabled()


def test_a_page_that_opens_with_a_question_has_the_suggested_gamma(browser, tmp_path):
    state = cases_page.exploration()
    state.ask("chair")
    for page in show(browser, save_html(state, tmp_path / "page.html")):
        assert page.locator("section:has(#gamma) .note").inner_text().startswith("Suggested: ")


def test_a_pressed_button_can_be_read_while_the_pointer_is_on_it(page):
    page.click(".choice >> text=Score")
    color = page.evaluate("getComputedStyle(document.querySelector('.choice [aria-pressed=true]')).backgroundColor")
    assert page.locator(".choice [aria-pressed=true]:hover").inner_text() == "Score"
    assert color == page.evaluate("getComputedStyle(viewer.rail.element.firstChild).backgroundColor")


def test_every_control_has_a_name(page):
    ask(page, "chair")
    nameless = page.evaluate(
        """[...document.querySelectorAll("button, input, select, [role=listbox]")]
          .filter((one) => !(one.getAttribute("aria-label") || one.textContent.trim() || one.labels?.length))
          .map((one) => one.outerHTML)"""
    )
    assert nameless == []


def test_other_names_are_refused(state, tmp_path):
    with pytest.raises(ValueError, match=r"path: expected a name that ends in .html, got 'scene.ply'"):
        save_html(state, tmp_path / "scene.ply")
    assert list(tmp_path.iterdir()) == []


def test_work_that_a_browser_cannot_keep_is_told_once(page):
    page.evaluate("() => { Storage.prototype.setItem = () => { throw new Error('full'); }; }")
    ask(page, "chair")
    page.wait_for_selector("[role=alert]:has-text('Save state')")
    page.evaluate("viewer.say('')")
    ask(page, "table")
    page.wait_for_timeout(800)
    assert not page.locator("[role=alert]:visible").count()
