"""What tabs may send to the page, and what becomes of it when a tab or the explorer is closed."""

import asyncio
import gc
import importlib.util
import logging
import weakref

import cases_page
import pytest
from messages import tells

from kfgs.viz import available
from kfgs.viz.explorer import notebook, serve, web
from kfgs.viz.explorer.web_picture import MOST
from kfgs.viz.gaussian_actor import STILL

pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("trame") is None, reason="needs trame"),
    pytest.mark.skipif(not available(), reason="needs a driver that draws"),
]


@pytest.fixture
def explorer(tmp_path):
    with cases_page.explorer(tmp_path) as opened:
        yield opened


def within(explorer, act):
    """Do something while the page is served; five minutes at most."""

    async def run():
        async with web.Listening(explorer, "127.0.0.1", 0) as listening:
            return await act(listening)

    return asyncio.run(asyncio.wait_for(run(), 300))


def call(listening, name, *arguments):
    """What a tab calls."""
    return listening.page.server.protocol_call(name, *arguments)


def watch(listening, explorer):
    """Have pictures sent, as a tab does; returns the view's number."""
    protocol = listening.page.server.protocol
    view = str(protocol.getSharedObject("app").GetObjectIdMap().GetGlobalId(explorer.plotter.render_window))
    call(listening, "viewport.image.push.observer.add", view)
    return view


def mouse(view, action, x, y, left):
    return {
        "view": view, "action": action, "x": x, "y": y, "buttonLeft": left, "buttonMiddle": 0, "buttonRight": 0,
        "shiftKey": 0, "ctrlKey": 0, "altKey": 0, "metaKey": 0,
    }  # fmt: skip


def test_a_tab_that_closes_in_a_drag_lets_go_of_the_mouse(explorer):
    window, camera = explorer.plotter.render_window, explorer.plotter.camera

    async def drag_and_close(listening):
        view = watch(listening, explorer)
        call(listening, "viewport.mouse.interaction", mouse(view, "down", 0.25, 0.5, 1))
        call(listening, "viewport.mouse.interaction", mouse(view, "move", 0.3, 0.55, 1))
        call(listening, "viewport.image.animation.start", view)
        assert window.GetDesiredUpdateRate() >= STILL  # points may stand for Gaussians
        turned = camera.position
        before = listening.page.pictures.frame.number
        protocols = listening.page.server.protocol.getLinkProtocols()
        for protocol in protocols:  # as wslink does
            protocol.onClose("somebody")
        assert window.GetDesiredUpdateRate() < STILL
        assert not any(getattr(protocol, "views_in_animations", []) for protocol in protocols)
        assert camera.position == pytest.approx(turned)  # it lets go where the mouse was
        assert listening.page.pictures.frame.still
        assert listening.page.pictures.frame.number > before  # a picture for those who are left
        call(listening, "viewport.mouse.interaction", mouse(view, "move", 0.5, 0.5, 0))
        assert camera.position == pytest.approx(turned)
        call(listening, "viewport.mouse.interaction", mouse(view, "move", 0.55, 0.55, 1))  # another tab, which drags on
        call(listening, "viewport.mouse.interaction", mouse(view, "move", 0.6, 0.6, 1))
        assert camera.position != pytest.approx(turned)

    within(explorer, drag_and_close)


def test_a_tab_that_closes_at_rest_draws_nothing(explorer):
    async def close(listening):
        watch(listening, explorer)
        before = listening.page.pictures.frame
        for protocol in listening.page.server.protocol.getLinkProtocols():
            protocol.onClose("somebody")
        assert listening.page.pictures.frame is before

    within(explorer, close)


def test_closing_the_explorer_ends_its_page_without_a_word(explorer, caplog, capfd):
    async def close(listening):
        view = watch(listening, explorer)
        listening.page._on_ask("chair")
        explorer.close()
        call(listening, "viewport.mouse.interaction", mouse(view, "down", 0.25, 0.5, 1))  # what was on its way
        call(listening, "viewport.image.push", {"view": view})
        await listening.ended()
        return listening.url

    url = within(explorer, close)
    with pytest.raises(ConnectionRefusedError):
        asyncio.run(asyncio.open_connection("127.0.0.1", int(url.split(":")[2].split("/")[0])))
    assert explorer.state.asked is None
    assert [record for record in caplog.records if record.levelno > logging.INFO] == []
    assert capfd.readouterr() == ("", "")


def test_a_closed_explorer_is_freed_with_its_page(tmp_path):
    def serve_and_close():
        opened = cases_page.explorer(tmp_path)

        async def close(listening):
            opened.ask("chair")
            opened.close()
            await listening.ended()

        within(opened, close)
        return weakref.ref(opened)

    freed = serve_and_close()
    gc.collect()
    assert freed() is None


def test_a_closed_explorer_is_not_shown(explorer):
    explorer.close()
    for show in (lambda: serve(explorer, open_browser=False), lambda: notebook.show_in_notebook(explorer)):
        with pytest.raises(RuntimeError, match=tells("explorer:", "explore(...)")):
            show()


@pytest.mark.parametrize("host", ["", " "])
def test_no_address_is_not_everyone(explorer, host):
    with pytest.raises(ValueError, match=tells("host:", f"got '{host}'", "127.0.0.1")):
        serve(explorer, host=host, open_browser=False)


def test_an_error_stays_though_another_action_waited(explorer):
    async def act(listening):
        page = listening.page
        page._on_save_selection()  # nothing is asked
        page._on_hide_all(False)
        while page._waiting or not page.server.state.error:
            await asyncio.sleep(0.01)
        assert "ask first" in page.server.state.error
        page._on_hide_all(False)
        while page.server.state.error:
            await asyncio.sleep(0.01)

    within(explorer, act)


def test_a_long_name_of_a_class_is_asked_in_full_and_other_words_are_cut(explorer, monkeypatch):
    asked, long = [], "a" * 300
    monkeypatch.setattr(explorer.state.meaning, "names", ("table", "chair", long))
    monkeypatch.setattr(explorer, "ask", asked.append)

    async def act(listening):
        for words in (long, "b" * 300):
            listening.page._on_ask(words)
            while listening.page._waiting:
                await asyncio.sleep(0.01)

    within(explorer, act)
    assert asked == [long, "b" * 200]


def test_no_tab_ends_the_server_or_asks_for_a_huge_picture(explorer):
    async def act(listening):
        view = watch(listening, explorer)
        listening.page.server.protocol.exit()
        call(listening, "viewport.image.push.original.size", view, 1e9, 40)
        call(listening, "viewport.image.push", {"view": view})
        while (frame := listening.page.pictures.frame) is None or frame.picture.shape != (40, MOST, 3):
            await asyncio.sleep(0.01)
        assert not listening._tasks[0].done()

    within(explorer, act)


def test_none_hides_what_has_no_class_too(explorer):
    explorer.set_distance(explorer.state.distance_range[0])  # all colour Gaussians are out of reach

    async def act(listening):
        page = listening.page
        rows = [(item["label"], item["name"], item["count"]) for item in page.server.state.classes]
        assert rows == [*((label, name, "60") for label, name in enumerate(cases_page.NAMES)), (-1, "no class", "")]
        page._on_hide_all(True)
        while page._waiting:
            await asyncio.sleep(0.01)

    within(explorer, act)
    assert not explorer.state.drawn("color").any()
    assert not explorer.state.drawn("semantic").any()
