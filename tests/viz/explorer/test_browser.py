"""A real browser opens the page: pixels and numbers change as they should; others try to reach it."""

import http.client
import signal
from urllib.parse import urlsplit

import cases_page
import numpy as np
import pytest
import torch
from cases_browser import (
    SECONDS,
    changed,
    check_hosts,
    check_picked,
    click,
    clouds,
    colored,
    near,
    needs_browser,
    open_page,
    places,
    said_lines,
    set_slider,
    settled,
    until,
    wait_lines,
)
from messages import tells
from PIL import Image

from kfgs.labels import transfer_labels

pytestmark = needs_browser


def test_asking_moving_lambda_and_picking(server, browser, tmp_path):
    state = cases_page.exploration()
    page = open_page(browser, server)
    wait_lines(page, state)
    before = clouds(page)
    half = before.shape[1] // 2
    where = places(tmp_path, before.shape)
    semantic, color = state.cloud("semantic"), state.cloud("color")
    for side in state.sides:  # all three classes shine in both panes
        pane = slice(0, half) if side == "semantic" else slice(half, None)
        assert all(near(before[:, pane], label).sum() > 100 for label in range(3))

    page.fill("#query", "chair")
    page.keyboard.press("Enter")
    state.ask("chair")
    wait_lines(page, state)
    assert f"semantic: {int((semantic.labels == cases_page.CHAIR).sum())} of 180 Gaussians" in said_lines(page)
    until(page, lambda: not near(clouds(page), cases_page.TABLE).any())
    asked = clouds(page)
    for side, pane in (("semantic", (0, half)), ("color", (half, before.shape[1]))):
        chairs = where[side][state.selected(side)]
        rows, columns = np.nonzero(colored(asked)[:, slice(*pane)])
        distance = np.linalg.norm(np.stack([columns + pane[0], rows], 1)[:, None] + 0.5 - chairs, axis=-1).min(1)
        assert len(rows) > 100
        assert distance.max() < 25  # a Gaussian reaches some 12 pixels from its centre
        assert near(asked[:, slice(*pane)], cases_page.CHAIR).sum() > 100

    low, high = state.distance_range
    halfway = float(torch.cdist(color.means, semantic.means).min(1).values.median())
    at = round(float(np.log(halfway / low) / np.log(high / low)), 3)  # the slider is logarithmic
    reached = transfer_labels(semantic, semantic.labels, color, low * (high / low) ** at)
    expected = int((reached.labels == cases_page.CHAIR).sum())
    assert 0 < expected < int(state.selected("color").sum())
    set_slider(page, "distance", at)
    state.set_distance(low * (high / low) ** at)
    wait_lines(page, state)
    assert f"colour: {expected} of 450 Gaussians" in said_lines(page)
    assert float(page.input_value("input[aria-label^='lambda, a number']")) == pytest.approx(state.distance, rel=1e-3)
    until(page, lambda: near(clouds(page)[:, half:], 1).sum() < 0.9 * near(asked[:, half:], 1).sum())
    moved = clouds(page)
    inner = slice(before.shape[0] // 10, None), slice(0, half - 32)  # JPEG mixes neighbours
    assert np.abs(moved[inner].astype(int) - asked[inner]).mean() < 0.5

    at = 0.37
    set_slider(page, "gamma", at)
    low, high = state.gamma_range
    state.set_gamma(low + at * (high - low))
    wait_lines(page, state)

    click(page, where["semantic"][semantic.labels == cases_page.CHAIR].mean(0))
    page.wait_for_selector(".picked h2")
    assert check_picked(page, state, "semantic") == cases_page.CHAIR
    check_hosts(page, server)
    page.context.close()


def test_a_second_tab_shows_the_same_and_picks_with_other_pixels(server, browser, tmp_path):
    state = cases_page.exploration()
    first, second = open_page(browser, server), open_page(browser, server, scale=2)
    for page in first, second:  # whatever was asked before
        page.wait_for_selector(".numbers p")
    first.fill("#query", "")
    first.press("#query", "Enter")
    set_slider(first, "distance", 0.6)
    low, high = state.distance_range
    state.set_distance(low * (high / low) ** 0.6)
    for page in first, second:
        wait_lines(page, state)
    where = places(tmp_path, clouds(second).shape)
    tables = state.labels("color") == cases_page.TABLE
    assert tables.any()
    until(second, lambda: near(clouds(second), cases_page.TABLE).any())
    click(second, where["color"][tables].mean(0))
    first.wait_for_selector(".picked >> text=colour Gaussian")
    assert check_picked(first, state, "color") == cases_page.TABLE
    second.wait_for_selector(".picked >> text=colour Gaussian")
    assert check_picked(second, state, "color") == cases_page.TABLE
    click(second, (5, clouds(second).shape[0] - 5))
    first.wait_for_selector("text=Nothing is drawn there")
    first.context.close()
    second.context.close()


def test_a_drag_turns_both_clouds_and_picks_nothing(server, browser):
    page = open_page(browser, server)
    page.get_by_role("button", name="clear the question").click(force=True)
    page.get_by_role("button", name="Reset view").click()
    before = settled(page)
    half = before.shape[1] // 2
    picked = page.locator(".picked").inner_text()
    click(page, (half / 2, before.shape[0] / 2), steps=4)
    panes = slice(0, half), slice(half, None)
    until(page, lambda: all(changed(clouds(page)[:, pane], before[:, pane]) > 100 for pane in panes))
    page.get_by_role("button", name="Reset view").click()
    until(page, lambda: changed(clouds(page), before) < 20)
    assert page.locator(".picked").inner_text() == picked
    page.context.close()


def test_classes_are_words_hidden_by_their_box_and_asked_by_their_name(server, browser):
    page = open_page(browser, server)
    names = page.locator(".classes .name").all_inner_texts()
    assert names == [*cases_page.NAMES, "no class"]  # no name is taken for markup, or for a template
    page.get_by_label("show table").uncheck()
    until(page, lambda: not near(clouds(page), cases_page.TABLE).any())
    page.get_by_label("show table").check()
    until(page, lambda: near(clouds(page), cases_page.TABLE).any())
    page.get_by_role("button", name=cases_page.NAMES[2]).click()
    until(page, lambda: page.input_value("#query") == cases_page.NAMES[2])
    page.get_by_role("button", name="clear the question").click()
    until(page, lambda: page.input_value("#query") == "")
    page.context.close()


def test_what_cannot_be_answered_is_told_under_the_field(server, browser):
    page = open_page(browser, server)
    page.fill("#query", "chiar")
    page.keyboard.press("Enter")
    with pytest.raises(ValueError, match=tells("class:", "got 'chiar'")) as told:
        cases_page.exploration().ask("chiar")
    until(page, lambda: page.inner_text("#error") == str(told.value))
    page.fill("input[aria-label^='lambda, a number']", "-1")
    page.keyboard.press("Enter")
    until(page, lambda: "distance: expected a number in (0, inf)" in page.inner_text("#error"))
    page.fill("#query", "chair")
    page.keyboard.press("Enter")
    until(page, lambda: not page.inner_text("#error"))
    page.context.close()


def test_saving_goes_into_the_folder_of_the_options(server, browser):
    page = open_page(browser, server)
    page.get_by_role("button", name="save picture").click()
    page.wait_for_selector("text=picture_001.png")
    picture = np.asarray(Image.open(server.out / "picture_001.png"))
    shown = clouds(page)
    assert picture.shape == shown.shape
    assert np.abs(picture.astype(int) - shown).mean() < 3  # JPEG
    page.fill("#query", "chair")
    page.keyboard.press("Enter")
    page.wait_for_selector("button[aria-label='save selection']:enabled")
    page.get_by_role("button", name="save selection").click()
    page.wait_for_selector("text=selection.json")
    written = sorted(path.name for path in (server.out / "selection_001").iterdir())
    assert {"selection.json", "selection_semantic.ply", "selection_color.ply"} <= set(written)
    page.context.close()


def test_panes_follow_the_window_and_a_reload_keeps_the_link(server, browser):
    page = open_page(browser, server)
    page.set_viewport_size({"width": 700, "height": 640})
    until(page, lambda: clouds(page).shape[0] == 640 and colored(clouds(page)).sum() > 100)
    middle = clouds(page)[320, :, :]
    half = len(middle) // 2
    assert (middle[half - 3 : half + 3].max(1) < 250).any()  # the border of the panes is in the middle
    page.reload()
    page.wait_for_selector("#query")
    until(page, lambda: colored(clouds(page)).sum() > 100)
    page.context.close()


def ask_for(server, path, **headers):
    """The status of one request; an upgrade where headers say so."""
    connection = http.client.HTTPConnection(urlsplit(server.url).netloc, timeout=SECONDS)
    try:
        connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders())
    finally:
        connection.close()


UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec_WebSocket_Version": "13",
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
}


def test_only_the_page_itself_with_its_link_gets_through(server):
    parts = urlsplit(server.url)
    secret, own = parts.path.split("/")[1], f"http://{parts.netloc}"
    assert len(secret) >= 32
    assert parts.hostname == "127.0.0.1"
    assert ask_for(server, f"/{secret}/ws", **UPGRADE, Origin=own)[0] == 101
    assert ask_for(server, f"/{secret}/ws", **UPGRADE, Origin="http://evil.example")[0] == 403
    assert ask_for(server, f"/{secret}/ws", **UPGRADE, Origin="http://127.0.0.1:1")[0] == 403
    assert ask_for(server, f"/{secret}/ws", **UPGRADE, Origin="null")[0] == 403
    assert ask_for(server, f"/{secret}/ws", **UPGRADE, Host="evil.example")[0] == 403
    for path in ("/", "/index.html", "/ws", f"/{secret[:-1]}/ws", "/wslink-secret/ws", f"/{secret}x/index.html"):
        assert ask_for(server, path, **UPGRADE, Origin=own)[0] == 403
    assert ask_for(server, parts.path)[0] == 200
    for path in ("/../../etc/passwd", "/kfgs_page/../__init__.py", "/kfgs_page/..%2f__init__.py"):
        assert ask_for(server, f"/{secret}{path}")[0] == 404
    for path, status in (
        ("/", 403),
        (f"/{secret}/nothing", 404),
        (f"/{secret}/ws", 400),
    ):  # refusals do not tell the link
        answered, headers = ask_for(server, path)
        assert (answered, headers["Referrer-Policy"]) == (status, "no-referrer")
        assert "default-src 'self'" in headers["Content-Security-Policy"]
    policy = ask_for(server, parts.path)[1]["Content-Security-Policy"]
    assert "default-src 'self'" in policy
    assert f"connect-src 'self' ws://{parts.netloc}" in policy


def test_ctrl_c_ends_the_server_without_a_word_more(server, browser):
    page = open_page(browser, server)
    server.process.send_signal(signal.SIGINT)
    assert server.process.wait(SECONDS) == 0
    page.context.close()
    assert server.process.stdout.read() == ""
    assert len(server.said) == 2
    assert server.said[0].startswith(f"the explorer is open at {server.url}")
