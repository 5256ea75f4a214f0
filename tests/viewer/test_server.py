"""The page's server: who is answered, what calls look like, and that nothing is left behind."""

import http.client
import socket
import struct
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from urllib.parse import urlsplit

import pytest
from messages import tells

from kfgs.viewer.server import LONGEST_CALL, PageServer, pack_message, read_message

PAGE, PACK = "<p>page</p>", bytes(range(256))
GO = threading.Event()  # ends the call "wait" early


def answer(name, args, attached):
    if name == "fail":
        raise ValueError(f"words: expected {args['wanted']}")
    if name == "break":
        raise RuntimeError("out of memory\nin a kernel")
    if name == "wait":
        GO.wait(float(args["seconds"]))
    return {"name": name, "args": args}, attached[::-1]


@pytest.fixture
def server():
    with PageServer(PAGE) as made:
        made.show(PACK, answer)
        yield made


def ask(server, path, method="GET", body=None, **headers):
    address = urlsplit(server.url)
    connection = http.client.HTTPConnection(address.hostname, address.port, timeout=30)
    connection.request(method, path, body, {"Host": address.netloc} | headers)
    response = connection.getresponse()
    found = response.status, response.read(), dict(response.headers)
    connection.close()
    return found


def secret(server):
    return f"/{server.secret}/"


def test_the_link_opens_the_page(server):
    status, text, headers = ask(server, secret(server))
    assert (status, text) == (200, PAGE.encode())
    assert headers["Content-Security-Policy"].startswith("default-src 'none'")
    assert headers["Referrer-Policy"] == "no-referrer"
    assert ask(server, secret(server) + "pack")[1] == PACK
    assert ask(server, secret(server) + "other")[0] == 404


@pytest.mark.parametrize("path", ["/", "//", "/index.html", "/x/", "/x/pack", "/%2e%2e/etc/passwd", "*"])
def test_without_the_secret_nothing_is_told(server, path):
    status, text, _ = ask(server, path)
    assert status == 403
    assert b"link" in text


def test_other_pages_and_other_names_are_refused(server):
    port = urlsplit(server.url).port
    own = f"127.0.0.1:{port}"
    for refused in (
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Host": f"evil.example:{port}"},
        {"Host": "["},
    ):
        assert ask(server, secret(server), **refused)[0] == 403
    assert ask(server, secret(server), Origin=f"http://{own}")[0] == 200
    assert ask(server, secret(server), Host=f"localhost:{port}")[0] == 200


@pytest.mark.parametrize(
    "host", [b"[", b"]", b"[::1", b"[zz]", b"a:b:c", b"\xff\xe2\x84\x80", b"\x00", b"", b"@", b"%"]
)
def test_a_malformed_host_is_refused_and_prints_nothing(server, capfd, host):
    with socket.create_connection(("127.0.0.1", urlsplit(server.url).port)) as connection:
        connection.sendall(f"GET {secret(server)} HTTP/1.0\r\n".encode() + b"Host: " + host + b"\r\n\r\n")
        assert connection.makefile("rb").readline().split()[1] == b"403"
    assert capfd.readouterr().err == ""


def test_a_call_and_its_answer(server):
    body = pack_message({"name": "ask", "args": {"words": "chair"}}, b"abc")
    status, content, _ = ask(server, secret(server) + "call", "POST", body)
    assert status == 200
    assert read_message(content) == ({"name": "ask", "args": {"words": "chair"}}, b"cba")


def test_an_error_of_a_call_is_told(server):
    body = pack_message({"name": "fail", "args": {"wanted": "a class"}})
    assert read_message(ask(server, secret(server) + "call", "POST", body)[1])[0] == {
        "error": "words: expected a class"
    }


def test_a_failure_of_any_kind_is_told_and_prints_nothing(server, capfd):
    body = pack_message({"name": "break", "args": {}})
    told = read_message(ask(server, secret(server) + "call", "POST", body)[1])[0]["error"]
    assert told == "RuntimeError: out of memory"
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "request_line", ["GET http://[/ HTTP/1.1", "POST {secret}call HTTP/1.1\r\nContent-Length: " + "9" * 5000]
)
def test_requests_that_no_browser_sends_print_nothing(server, capfd, request_line):
    with socket.create_connection(("127.0.0.1", urlsplit(server.url).port)) as connection:
        text = request_line.format(secret=secret(server)) + "\r\nHost: 127.0.0.1\r\n\r\n"
        connection.sendall(text.encode())
        assert connection.makefile("rb").readline().split()[1] in (b"400", b"403")
    assert capfd.readouterr().err == ""


def test_a_tab_that_hangs_up_prints_nothing(server, capfd):
    connection = socket.create_connection(("127.0.0.1", urlsplit(server.url).port))
    connection.sendall(b"GET /")
    time.sleep(0.3)  # so that a thread waits for the rest
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # close with a reset
    connection.close()
    assert ask(server, secret(server))[0] == 200
    time.sleep(0.3)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "body", [b"", b"abc", b"\xff\xff\xff\x7f{}", pack_message({})[:5], b"\x02\0\0\0[]", b"\x90\x5f\1\0" + b"[" * 90_000]
)
def test_a_body_that_is_no_call(server, body):
    status, content, _ = ask(server, secret(server) + "call", "POST", body)
    assert status == 200
    assert "message: expected" in read_message(content)[0]["error"]


def test_bodies_too_long_or_of_unknown_length_are_refused(server):
    assert ask(server, secret(server) + "call", "POST", b"", **{"Content-Length": str(LONGEST_CALL + 1)})[0] == 400
    assert ask(server, secret(server) + "call", "POST", b"", **{"Content-Length": "-5"})[0] == 400
    assert ask(server, secret(server) + "pack", "POST", b"")[0] == 400


def test_a_slow_call_holds_up_no_other(server):
    slow = threading.Thread(
        target=ask,
        args=(server, secret(server) + "call", "POST", pack_message({"name": "wait", "args": {"seconds": 100}})),
    )
    slow.start()
    try:
        assert ask(server, secret(server))[0] == 200
        assert slow.is_alive()
    finally:
        GO.set()
        slow.join()
        GO.clear()


def stalled(server, request, small=1 << 12):
    """A tab that sends a request, or the beginning of one, and then neither reads nor sends."""
    address = urlsplit(server.url)
    tab = socket.socket()
    tab.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, small)
    tab.connect((address.hostname, address.port))
    tab.sendall(request.replace("{host}", address.netloc).replace("{secret}", server.secret).encode("latin-1"))
    return tab


NEVER_READ = {
    "the scene": "GET /{secret}/pack HTTP/1.1\r\nHost: {host}\r\n\r\n",
    "an answer": "POST /{secret}/call HTTP/1.1\r\nHost: {host}\r\nContent-Length: 16000036\r\n\r\n"
    + pack_message({"name": "big", "args": {}}).decode("latin-1").ljust(36)
    + "x" * 16_000_000,
}
NEVER_SENT = {
    "a request": "GET /{secret}/pack HTTP/1.1\r\nHost:",
    "a body": "POST /{secret}/call HTTP/1.1\r\nHost: {host}\r\nContent-Length: 1000\r\n\r\nab",
}


@pytest.mark.parametrize("request_", [*NEVER_READ, *NEVER_SENT])
def test_tabs_that_stall_hold_up_no_other(request_):
    """The answers are far larger than what the system buffers, so that their threads do wait for the tabs."""
    pack = bytes(64 << 20)
    with PageServer(PAGE) as server:
        server.show(pack, answer)
        before = threading.active_count()
        tabs = [stalled(server, (NEVER_READ | NEVER_SENT)[request_]) for _ in range(12)]
        end = time.monotonic() + 30
        while threading.active_count() < before + len(tabs) and time.monotonic() < end:
            time.sleep(0.01)
        time.sleep(0.2)
        assert threading.active_count() >= before + len(tabs)  # all of them wait
        began = time.monotonic()
        assert ask(server, secret(server))[1] == PAGE.encode()
        assert len(ask(server, secret(server) + "pack")[1]) == len(pack)
        call = pack_message({"name": "look", "args": {"at": 1}}, b"ab")
        assert read_message(ask(server, secret(server) + "call", "POST", call)[1])[1] == b"ba"
        assert time.monotonic() - began < 20  # far below PATIENCE, after which a stalled tab is given up
        began = time.monotonic()
        server.close()
        assert time.monotonic() - began < 20
        for tab in tabs:
            tab.close()
        while threading.active_count() >= before and time.monotonic() < end + 30:
            time.sleep(0.01)
        assert threading.active_count() < before  # theirs and the server's have ended


def test_a_tab_that_never_reads_is_given_up(monkeypatch):
    monkeypatch.setattr("kfgs.viewer.server._Handler.timeout", 0.5)
    with PageServer(PAGE) as server:
        server.show(bytes(64 << 20), answer)
        before = threading.active_count()
        tabs = [stalled(server, request) for request in (*NEVER_READ.values(), *NEVER_SENT.values())]
        end = time.monotonic() + 30
        time.sleep(1)
        while threading.active_count() > before and time.monotonic() < end:
            time.sleep(0.05)
        assert threading.active_count() == before
        for tab in tabs:
            tab.close()


def test_closing_leaves_no_thread_behind():
    before = threading.active_count()
    server = PageServer(PAGE)
    for _ in range(5):
        ask(server, secret(server))
    server.close()
    server.close()
    end = time.monotonic() + 30
    while threading.active_count() > before and time.monotonic() < end:
        time.sleep(0.01)
    assert threading.active_count() == before
    with pytest.raises(ConnectionRefusedError):
        ask(server, "/")


def test_the_page_is_there_before_its_scene():
    with PageServer(PAGE) as server, ThreadPoolExecutor() as pool:
        body = pack_message({"name": "ask", "args": {}})
        waiting = [
            pool.submit(ask, server, secret(server) + "pack"),
            pool.submit(ask, server, secret(server) + "call", "POST", body),
        ]
        assert ask(server, secret(server))[1] == PAGE.encode()
        time.sleep(0.2)
        assert not any(one.done() for one in waiting)
        server.show(PACK, answer)
        assert waiting[0].result(10)[1] == PACK
        assert read_message(waiting[1].result(10)[1])[0]["name"] == "ask"


def test_a_page_whose_scene_never_came_is_told_so():
    server = PageServer(PAGE)
    with ThreadPoolExecutor() as pool:
        waiting = pool.submit(ask, server, secret(server) + "pack")
        time.sleep(0.2)
        server.close()
        assert waiting.result(10)[0] == 404


def test_wrong_addresses():
    with pytest.raises(ValueError, match=tells("host", "127.0.0.1")):
        PageServer(PAGE, host=" ")
    with pytest.raises(ValueError, match=tells("port", "70000")):
        PageServer(PAGE, port=70000)
    with PageServer(PAGE) as server, pytest.raises(ValueError, match=tells("host, port", "free")):
        PageServer(PAGE, port=urlsplit(server.url).port)
    with PageServer(PAGE, host="::1") as server:
        assert ask(server, secret(server))[0] == 200


def test_the_page_needs_no_torch():
    """`kfgs view` opens it while Python loads."""
    program = (
        "import sys\nfrom kfgs.viewer import document, serving, server\n"
        "server.PageServer(document.document('t', document.PYTHON_START)).close()\nassert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.parametrize("args", [5, "words", [["a", 1]], 1.5, True])
def test_arguments_that_are_no_object_are_named(server, args):
    status, body, _ = ask(server, f"{secret(server)}call", "POST", pack_message({"name": "a", "args": args}))
    told, _ = read_message(body)
    assert status == 200
    assert "args: expected an object" in told["error"]


def connect(server):
    address = urlsplit(server.url)
    return socket.create_connection((address.hostname, address.port), timeout=20)


def test_a_byte_now_and_then_does_not_keep_a_stranger_connected(monkeypatch):
    monkeypatch.setattr("kfgs.viewer.server.PATIENCE", 1.0)
    with PageServer(PAGE) as server, connect(server) as stranger:
        server.show(PACK, answer)
        began = time.monotonic()
        with suppress(OSError):  # reset, or a broken pipe
            while time.monotonic() - began < 15:
                stranger.sendall(b"G")
                time.sleep(0.1)
        assert 0.9 < time.monotonic() - began < 10


def test_one_who_has_shown_the_secret_may_take_his_time(monkeypatch):
    monkeypatch.setattr("kfgs.viewer.server.PATIENCE", 1.0)
    with PageServer(PAGE) as server:
        server.show(PACK, answer)
        body = pack_message({"name": "wait", "args": {"seconds": 2.5}})
        assert ask(server, f"{secret(server)}call", "POST", body)[0] == 200


def test_many_strangers_do_not_keep_the_owner_out(server, monkeypatch):
    monkeypatch.setattr("kfgs.viewer.server.STRANGERS", 8)
    strangers = [connect(server) for _ in range(30)]
    try:
        assert ask(server, secret(server))[0] == 200
        assert strangers[0].recv(100) == b""  # the oldest was closed
    finally:
        for one in strangers:
            one.close()


FULL = """
import os, resource, socket, time
from contextlib import suppress
from urllib.parse import urlsplit
from kfgs.viewer.server import PageServer
asked, accept = [], socket.socket.accept
socket.socket.accept = lambda self: asked.append(1) or accept(self)
with PageServer("<p>page</p>") as server:
    address = urlsplit(server.url)
    resource.setrlimit(resource.RLIMIT_NOFILE, (40, 40))
    one = socket.socket()
    with suppress(OSError):
        while True:
            os.dup(0)
    one.connect((address.hostname, address.port))  # the server has no handle for it
    time.sleep(2)
    print(len(asked))
"""


def test_without_file_handles_the_server_does_not_spin():
    done = subprocess.run([sys.executable, "-c", FULL], capture_output=True, text=True, timeout=300)
    assert 1 < int(done.stdout) < 40, done.stderr  # one in 0.1 s
