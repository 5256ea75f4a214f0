import asyncio
import importlib.util
import logging
import socket
from types import SimpleNamespace
from unittest.mock import MagicMock

import cases_page
import pytest
from messages import tells

from kfgs.viz import available
from kfgs.viz.explorer import notebook, serve, web
from kfgs.viz.explorer.web_guard import is_loopback, make_guard
from kfgs.viz.explorer.web_page import _number, _share

needs_web = pytest.mark.skipif(importlib.util.find_spec("trame") is None, reason="needs trame")
needs_driver = pytest.mark.skipif(not available(), reason="needs a driver that draws")


@pytest.fixture
def explorer(tmp_path):
    with cases_page.explorer(tmp_path) as opened:
        yield opened


def test_without_the_extra_the_install_line_is_told(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "trame_vtk" else found(name))
    with pytest.raises(ImportError, match=tells("'web'", "trame_vtk", 'pip install "kfgs[web]"')):
        web.require_web()


@pytest.mark.parametrize(
    ("host", "local"),
    [("127.0.0.1", True), ("localhost", True), ("::1", True), ("[::1]", True), ("127.5.0.1", True), ("LOCALHOST", True),
     ("0.0.0.0", False), ("192.168.1.7", False), ("127.evil.example", False), ("localhost.evil.example", False)],
)  # fmt: skip
def test_which_addresses_are_of_this_machine_only(host, local):
    assert is_loopback(host) is local


@needs_web
@pytest.mark.parametrize(
    ("path", "headers", "host", "status"),
    [
        ("/secret/index.html", {"Host": "127.0.0.1:80"}, "127.0.0.1", 200),
        ("/secret/index.html", {"Host": "127.0.0.1:80", "Origin": "http://127.0.0.1:80"}, "127.0.0.1", 200),
        ("/secret/index.html", {"Host": "127.0.0.1:80", "Origin": "http://127.0.0.1:81"}, "127.0.0.1", 403),
        ("/secret/index.html", {"Host": "127.0.0.1:80", "Origin": "null"}, "127.0.0.1", 403),
        ("/secret/index.html", {"Host": "evil.example:80"}, "127.0.0.1", 403),
        ("/secret/index.html", {"Host": "evil.example:80", "Origin": "http://evil.example:80"}, "127.0.0.1", 403),
        ("/secret/index.html", {"Host": "office:80", "Origin": "http://office:80"}, "0.0.0.0", 200),
        ("/secret/index.html", {"Host": "office:80", "Origin": "http://evil.example"}, "0.0.0.0", 403),
        ("/secrex/index.html", {"Host": "127.0.0.1:80"}, "127.0.0.1", 403),
        ("/", {"Host": "127.0.0.1:80"}, "127.0.0.1", 403),
    ],
)
def test_the_guard_lets_through_only_the_page_with_its_link(path, headers, host, status):
    from aiohttp import web as aiohttp_web
    from aiohttp.test_utils import make_mocked_request

    async def answer(_):
        return aiohttp_web.Response(text="in")

    async def ask():
        try:
            return (await make_guard("secret", host)(make_mocked_request("GET", path, headers=headers), answer)).status
        except aiohttp_web.HTTPException as error:
            return error.status

    assert asyncio.run(ask()) == status


@needs_web
@needs_driver
def test_a_port_that_is_taken_is_told(explorer):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=tells("host, port:", f"got '127.0.0.1' and {port}")):
            serve(explorer, port=port, open_browser=False)
    with pytest.raises(ValueError, match=tells("host, port:", "got '203.0.113.7'")):
        serve(explorer, host="203.0.113.7", open_browser=False)


def test_a_port_is_a_whole_number():
    with pytest.raises(ValueError, match=tells("port:", "got 70000")):
        serve(None, port=70000)


@needs_web
def test_within_an_event_loop_the_notebook_way_is_told():
    async def inside():
        serve(None)

    with pytest.raises(RuntimeError, match=tells("serve:", "show_in_notebook")):
        asyncio.run(inside())


@needs_web
@needs_driver
def test_listening_to_others_is_told_and_trame_forgets_the_server(explorer, monkeypatch):
    from trame.app.core import AVAILABLE_SERVERS
    from trame_vtk.modules.vtk import HELPERS_PER_SERVER

    before, said = (set(AVAILABLE_SERVERS), set(HELPERS_PER_SERVER)), []
    monkeypatch.setattr("sys.argv", ["kfgs", "--port", "1", "--host", "203.0.113.7"])  # is not trame's to read
    monkeypatch.setattr(web.Listening, "ended", lambda self: asyncio.sleep(0))
    opened = []
    monkeypatch.setattr(web.webbrowser, "open", opened.append)
    monkeypatch.setattr(web, "has_display", lambda: False)
    serve(explorer, report=lambda _: None)
    assert opened == []  # no browser within the terminal
    monkeypatch.setattr(web, "has_display", lambda: True)
    serve(explorer, host="0.0.0.0", report=said.append)
    assert said[0] == f"the explorer is open at {opened[0]}"
    assert "everyone who reaches it and has the link can look, steer, and save" in said[1]
    assert str(explorer.options.out) in said[1]
    assert (set(AVAILABLE_SERVERS), set(HELPERS_PER_SERVER)) == before


@needs_web
@needs_driver
def test_of_many_positions_of_a_slider_only_the_last_is_drawn(explorer):
    seen = []
    explorer.listen(lambda: seen.append(explorer.state.distance))

    async def drag():
        async with web.Listening(explorer, "127.0.0.1", 0) as listening:
            state = listening.page.server.state
            for at in (0.1, 0.2, 0.3):
                with state:
                    state.distance_at = at
            while not seen:
                await asyncio.sleep(0.01)
            explorer.set_distance(0.5)  # as a cell of a notebook does
            while state.distance != 0.5:
                await asyncio.sleep(0.01)

    low, high = explorer.state.distance_range
    asyncio.run(asyncio.wait_for(drag(), 300))
    assert seen == [pytest.approx(low * (high / low) ** 0.3), 0.5]


@needs_web
@needs_driver
def test_what_goes_wrong_is_told_on_the_page_and_nothing_ends(explorer, monkeypatch, caplog):
    def fails(_):
        raise ZeroDivisionError("by zero")

    async def ask():
        async with web.Listening(explorer, "127.0.0.1", 0) as listening:
            page = listening.page
            monkeypatch.setattr(explorer, "ask", fails)
            page._on_ask("chair")
            while "by zero" not in page.server.state.error:
                await asyncio.sleep(0.01)
            page._on_hide({"a": 1}, True)
            while "label: expected a whole number, got \"{'a': 1}\"" not in page.server.state.error:
                await asyncio.sleep(0.01)
            page._on_set_number("gamma", "x")
            while "gamma: expected a number, got 'x'" not in page.server.state.error:
                await asyncio.sleep(0.01)

    with caplog.at_level(logging.ERROR):
        asyncio.run(asyncio.wait_for(ask(), 300))
    assert any("could not do" in record.message for record in caplog.records)


@pytest.mark.parametrize("value", ["0.5", None, True, float("nan"), float("inf"), [0.5]])
def test_a_position_is_a_number(value):
    with pytest.raises(ValueError, match=tells("position:", "0 and 1", "reload")):
        _share(value)


def test_positions_and_numbers_are_read():
    assert [_share(0.5), _share(-1), _share(7)] == [0.5, 0, 1]
    assert _number("gamma", "0,25") == 0.25
    with pytest.raises(ValueError, match=tells("gamma:", "got 'much'", "0.05")):
        _number("gamma", "much")


@needs_driver
def test_outside_a_notebook_there_is_a_picture_and_a_reason(explorer, monkeypatch):
    shown = []
    monkeypatch.setattr(notebook, "_display", lambda page, words: shown.append((page, words)))
    assert not notebook.in_notebook()
    notebook.show_in_notebook(explorer)
    page, words = shown[0]
    assert page.startswith("<img")
    assert "data:image/jpeg;base64," in page
    assert "<script" not in page
    assert words.startswith("controls need a Jupyter kernel")


@needs_driver
def test_in_a_notebook_without_the_extra_the_install_line_is_told(explorer, monkeypatch):
    shown = []
    monkeypatch.setattr(notebook, "_display", lambda page, words: shown.append((page, words)))
    shell = MagicMock(kernel=object(), execution_count=1)
    monkeypatch.setitem(notebook.sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    notebook.show_in_notebook(explorer)
    assert 'pip install "kfgs[web]"' in shown[0][1]
    assert "pip install &quot;kfgs[web]&quot;" in shown[0][0]
