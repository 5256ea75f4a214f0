"""The exported file in a browser without a network: what it counts and selects is what Python counts and selects."""

import html
import io
import itertools
import json
import re
from functools import partial

import cases_explorer
import cases_page
import numpy as np
import pytest
import torch
from cases_page import agree, errors_of, mask, set_slider
from cases_web import SECONDS, needs_chromium, room_state
from PIL import Image

from kfgs.cameras import Camera
from kfgs.labels import EditList
from kfgs.labels.edit_list import read_edits
from kfgs.viewer import Exploration, FieldMeaning, SplatMeaning, Viewer

pytestmark = needs_chromium
SIDES = "color", "semantic"
VIEWMAT = "[...(viewer.panes.camera?.viewmat ?? new Float32Array(16))]"  # zeros while a new frame is to come


@pytest.fixture(scope="module")
def state():
    """A fresh state for each test would be the same: tests only read it or set what they compare."""
    return cases_page.exploration()


@pytest.fixture(scope="module")
def file(state, tmp_path_factory):
    return save_html(state, tmp_path_factory.mktemp("page") / "heaps.html")


def save_html(state, path):
    return Viewer(state, title="Three <heaps>").save_html(path)


@pytest.fixture
def page(browser, file):
    yield from show(browser, file)


def show(browser, file, **options):
    """The file in a tab that may load nothing else; at the end nothing was asked for, and nothing went wrong."""
    context = browser.new_context(viewport={"width": 800, "height": 600}, **options)
    page = context.new_page()
    asked, errors = [], errors_of(page)

    def guard(route):
        if route.request.url == file.as_uri():
            return route.continue_()
        asked.append(route.request.url)
        return route.abort()

    page.route("**/*", guard)
    page.on("websocket", lambda socket: asked.append(socket.url))
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
            for gamma in (state.gamma, float(scores.median())):
                state.set_gamma(min(max(gamma, asked.low), asked.high))
                page.evaluate("(gamma) => viewer.model.setGamma(gamma)", state.gamma)
                for distance in (1.0, 2**0.5) if len(state.sides) > 1 else ():
                    state.set_distance(distance)
                    page.evaluate("(lambda) => viewer.model.setLambda(lambda)", distance)
                    agree(page, state)
                agree(page, state)
        state.set_show("score")
    for page in show(browser, save_html(state, tmp_path / "scene.html"), color_scheme="dark"):  # as Python left it
        agree(page, state)
        assert page.get_attribute(".kfgs", "data-theme") == "dark"
        assert page.locator(".top .choice [aria-pressed=true]").inner_text() == "Score"
        assert page.locator("button[aria-label='Undo']").is_disabled()


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
    script = "viewer.model.select('color', Uint8Array.from({length: viewer.model.total('color')}, (_, i) => i < 5))"
    page.evaluate(script)
    page.press(".stage", "Delete")
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
    opacities = page.evaluate("(rows) => rows.map((i) => viewer.model.clouds.color.opacityOf(i))", kept.tolist())
    np.testing.assert_allclose(opacities, edited.opacities, atol=1 / 255)
    for _ in range(5):
        page.keyboard.press("Control+z")
    assert page.evaluate("[viewer.model.total('color'), viewer.model.now.edits.length]") == [450, 1]
    for _ in range(5):
        page.keyboard.press("Control+Shift+Z")
    assert json.loads(page.evaluate("JSON.stringify(viewer.model)"))["sides"]["color"]["edits"] == saved["edits"]
    for _ in range(6):
        page.keyboard.press("Control+z")
    assert not page.evaluate("viewer.model.edited")
    assert page.evaluate("viewer.model.total('color')") == 450


def test_a_saved_state_opens_again(page, tmp_path):
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
    page.evaluate("viewer.model.undo()")
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
        {"op": "recolor", "where": rows},
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
        page.press(".stage", "f")
        assert current.count() == 0
        middle = np.array(page.evaluate("viewer.model.extent('color').center"))
        look = "[...viewer.eye.view.position, ...viewer.eye.view.R.slice(6)]"

        farthest = max(np.linalg.norm(view.center.numpy() - middle) for view in views)
        until(page, partial(looks_at, middle, look, farthest))
        page.keyboard.press("Escape")
        page.keyboard.press("f")
        until(page, lambda tab: np.allclose(tab.evaluate(VIEWMAT), views[0].viewmat.flatten(), atol=1e-6))


def walls():
    """Two walls of opaque Gaussians, one behind the other, before a camera, and a hole in the first. No classes."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, 21), torch.linspace(-1, 1, 21), indexing="ij")
    wall = torch.stack([x, y, 0 * x], dim=-1).reshape(-1, 3)
    hole = wall.norm(dim=1) < 0.35
    near = wall[~hole] + torch.tensor([0.0, 0, 4])
    means = torch.cat([near, 2 * wall + torch.tensor([0.0, 0, 8])])
    cloud = cases_explorer.cloud(means, sh=torch.zeros(len(means), 1, 3)).replace(
        scales=torch.tensor([[0.07, 0.07, 0.01]]).repeat(len(means), 1), opacities=torch.full((len(means),), 0.95)
    )
    camera = Camera(torch.eye(4), torch.tensor([[300.0, 0, 200], [0, 300, 150], [0, 0, 1]]), 400, 300, "front")
    return len(near), Exploration(SplatMeaning(cloud), cameras=[camera])


def in_the_middle(page, near):
    """How many Gaussians of the near wall the box selects in the middle of the picture, and which of the other one."""
    x, y, width, height = page.locator(".stage").bounding_box().values()
    page.keyboard.press("2")
    page.mouse.move(x + 0.3 * width, y + 0.3 * height)
    page.mouse.down()
    page.mouse.move(x + 0.7 * width, y + 0.7 * height)
    page.mouse.up()
    chosen = np.flatnonzero(mask(page, "semantic"))
    return (chosen < near).sum(), chosen[chosen >= near] - near


def test_tools_take_what_is_seen_and_with_a_key_what_is_behind_it(browser, tmp_path):
    near, state = walls()
    for page in show(browser, save_html(state, tmp_path / "walls.html")):
        assert not page.locator("#query").is_visible()  # nothing can be searched for
        assert page.locator("h2:visible").all_inner_texts() == ["Selection"]
        x, y, width, height = page.locator(".stage").bounding_box().values()

        first, behind = in_the_middle(page, near)
        there = np.linalg.norm(state.cloud("semantic").means[near:, :2].numpy()[behind], axis=1)
        assert first > 30
        assert 0 < len(behind) < 0.5 * first
        assert (there < 0.75).all()  # through the hole: its radius, twice as far away
        page.keyboard.press("x")
        both, all_behind = in_the_middle(page, near)
        assert both == first
        assert len(all_behind) > 0.9 * first
        page.keyboard.press("x")
        page.keyboard.press("4")  # the brush, beside the hole
        page.mouse.move(x + 0.35 * width, y + 0.5 * height)
        page.mouse.down()
        page.mouse.move(x + 0.36 * width, y + 0.52 * height)
        page.mouse.up()
        painted = np.flatnonzero(mask(page, "semantic"))
        assert len(painted) > 1
        assert (painted < near).all()


def test_two_clicks_measure_what_is_seen(browser, tmp_path):
    _, state = walls()
    for page in show(browser, save_html(state, tmp_path / "walls.html")):
        x, y, width, height = page.locator(".stage").bounding_box().values()
        page.keyboard.press("6")
        page.mouse.click(x + 0.5 * width, y + 0.5 * height)  # through the hole to the far wall
        page.mouse.click(x + 0.36 * width, y + 0.5 * height)
        focal, cx, across = page.evaluate("[viewer.panes.camera.fx, viewer.panes.camera.cx, viewer.canvas.width]")
        ends = np.array(page.evaluate("viewer.model.tape"))
        true = [[0, 0, 8], [4 * (0.36 * across - cx) / focal, 0, 4]]  # under the pointer
        np.testing.assert_allclose(ends, true, atol=0.02)
        length = np.linalg.norm(ends[1] - ends[0])
        assert f"The tape is {length:.3g} world units long" in page.locator(".said").inner_text()
        page.evaluate("viewer.settled()")
        assert page.locator(".boxes text").inner_html() == f"{length:.3g}"
        page.mouse.click(x + 0.36 * width, y + 0.5 * height)  # a third one begins anew
        assert page.evaluate("viewer.model.tape.length") == 1
        page.keyboard.press("Escape")
        assert page.evaluate("[viewer.model.tape.length, viewer.tools.tool]") == [0, "tape"]


def drag(page, dx, dy):
    x, y, width, height = page.locator(".stage").bounding_box().values()
    page.mouse.move(x + width / 2, y + height / 2)
    page.mouse.down()
    page.mouse.move(x + width / 2 + dx / 2, y + height / 2 + dy / 2)
    page.mouse.move(x + width / 2 + dx, y + height / 2 + dy)
    page.mouse.up()
    return np.array(page.evaluate("viewer.eye.view.position")), np.array(page.evaluate("viewer.eye.view.R.slice(6)"))


def test_a_drag_looks_around_in_a_room_and_turns_about_what_the_cameras_look_at(browser, room, tmp_path):
    state = room_state(room)
    for page in show(browser, save_html(state, tmp_path / "room.html")):
        before = state.cameras[0]
        place, ahead = drag(page, 300, 150)
        np.testing.assert_allclose(place, before.center.numpy(), atol=1e-4)  # it never ends in a wall
        assert np.dot(ahead, before.viewmat[2, :3].numpy()) < 0.9
    around = [Camera.look_at((4 * np.cos(a), 4 * np.sin(a), 1.5), (0.2, 0.1, 0), width=80, height=60) for a in range(6)]
    state = Exploration(cases_page.exploration().meaning, cameras=around)
    for page in show(browser, save_html(state, tmp_path / "object.html")):
        focus = np.array([0.2, 0.1, 0])
        np.testing.assert_allclose(page.evaluate("viewer.header.focus"), focus, atol=1e-4)
        far = np.linalg.norm(np.array(page.evaluate("viewer.eye.view.position")) - focus)
        place, ahead = drag(page, 200, 0)
        assert np.linalg.norm(place - around[0].center.numpy()) > 1
        np.testing.assert_allclose(np.linalg.norm(place - focus), far, rtol=1e-3)
        np.testing.assert_allclose(place + far * ahead, focus, atol=1e-3)


def test_a_file_without_cameras_stands_upright_and_a_key_rolls_it(browser, tmp_path):
    state = cases_page.exploration()
    assert state.up == (0, -1, 0)
    for up in (state.up, (0, 0, 1)):
        state.up = up
        for page in show(browser, save_html(state, tmp_path / "up.html")):
            R = np.array(page.evaluate("viewer.eye.view.R")).reshape(3, 3)
            assert up @ R[1] < -0.5  # y of the picture points down
            assert abs(up @ R[0]) < 1e-6
            page.press(".stage", "r")
            turned, axis = page.evaluate("[viewer.eye.view.R, viewer.eye.up]")
            assert np.abs(np.subtract(axis, up)).max() == 1
            assert np.dot(axis, turned[3:6]) < -0.2
            page.keyboard.press("Shift+R")
            rolled = np.array(page.evaluate("viewer.eye.view.R")).reshape(3, 3)
            angle = np.degrees(np.arccos(np.clip(rolled[0] @ turned[:3], -1, 1)))
            assert angle == pytest.approx(5, abs=0.1)
            np.testing.assert_allclose(rolled[2], turned[6:], atol=1e-6)


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


def test_in_a_frame_the_page_around_it_keeps_its_keys_and_scrolls(browser, tmp_path):
    file = save_html(cases_explorer.line(cameras=cases_explorer.cameras()), tmp_path / "page.html")
    page, held = browser.new_page(), html.escape(file.read_text(encoding="utf-8"))
    page.set_content(f'<input autofocus><p style="height: 2000px"><iframe srcdoc="{held}" width=1000 height=900>')
    inside = page.frame_locator("iframe")
    inside.locator(".kfgs:not([aria-busy])").wait_for()
    assert page.evaluate("[document.activeElement.tagName, scrollY]") == ["INPUT", 0]
    inside.locator("canvas").hover()
    page.mouse.wheel(0, 200)
    until(page, lambda tab: tab.evaluate("scrollY") > 0)
    page.close()
