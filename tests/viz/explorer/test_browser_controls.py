"""A real browser uses the page's boxes, buttons and fields, and others try to reach it."""

import http.client
from urllib.parse import urlsplit

import cases_page
import numpy as np
import pytest
from cases_browser import (
    SECONDS,
    clouds,
    colored,
    near,
    needs_browser,
    open_page,
    until,
)
from PIL import Image

pytestmark = needs_browser


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
    with pytest.raises(ValueError, match="chair") as told:
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
