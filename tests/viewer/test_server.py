"""The page's server: who is answered, what calls look like, and that nothing is left behind."""

import http.client
import socket
import threading
import time
from urllib.parse import urlsplit

import pytest
from messages import refused

from kfgs.viewer.server import LONGEST_FILE, PageServer, pack_message, read_message

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
    with PageServer(PAGE, PACK, answer) as made:
        yield made


def ask(server, path, method="GET", body=None, **headers):
    address = urlsplit(server.url)
    connection = http.client.HTTPConnection(address.hostname, address.port, timeout=300)
    connection.request(method, path, body, {"Host": address.netloc} | headers)
    response = connection.getresponse()
    told = response.status, response.read(), dict(response.headers)
    connection.close()
    return told


def secret(server):
    return f"/{server.secret}/"


def call(server, name, args=None, attached=b""):
    body = pack_message({"name": name, "args": args}, attached)
    return read_message(ask(server, secret(server) + "call", "POST", body)[1])


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


@pytest.mark.parametrize("host", [b"[", b"[::1", b"a:b:c", b"\xff\xe2\x84\x80", b"\x00", b"", b"@"])
def test_a_malformed_host_is_refused_and_prints_nothing(server, capfd, host):
    with socket.create_connection(("127.0.0.1", urlsplit(server.url).port)) as connection:
        connection.sendall(f"GET {secret(server)} HTTP/1.0\r\n".encode() + b"Host: " + host + b"\r\n\r\n")
        assert connection.makefile("rb").readline().split()[1] == b"403"
    assert capfd.readouterr().err == ""


def test_a_call_and_its_answer(server, capfd):
    assert call(server, "ask", {"words": "chair"}, b"abc") == ({"name": "ask", "args": {"words": "chair"}}, b"cba")
    assert call(server, "fail", {"wanted": "a class"})[0] == {"error": "words: expected a class"}
    assert call(server, "break")[0] == {"error": "RuntimeError: out of memory"}
    for args in (5, "words", [["a", 1]]):
        assert "args: expected an object" in call(server, "ask", args)[0]["error"]
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "body", [b"", b"abc", b"\xff\xff\xff\x7f{}", pack_message({})[:5], b"\x02\0\0\0[]", b"\x90\x5f\1\0" + b"[" * 90_000]
)
def test_a_body_that_is_no_call(server, body):
    status, content, _ = ask(server, secret(server) + "call", "POST", body)
    assert status == 200
    assert "message: expected" in read_message(content)[0]["error"]


def test_slow_calls_and_tabs_that_stall_hold_up_no_other(server):
    address = urlsplit(server.url)
    tabs = [socket.create_connection((address.hostname, address.port)) for _ in range(12)]
    for tab in tabs:
        tab.sendall(b"GET /")  # and nothing more
    slow = threading.Thread(target=call, args=(server, "wait", {"seconds": 100}))
    slow.start()
    try:
        assert ask(server, secret(server))[0] == 200
        assert slow.is_alive()
    finally:
        GO.set()
        slow.join()
        GO.clear()
        for tab in tabs:
            tab.close()


def test_pages_of_files_are_few_and_local():
    made = lambda name, content: (name, content, answer)  # noqa: E731
    with PageServer(PAGE, PACK, answer, open_file=made) as server:
        opened = [call(server, "open", {"name": f"page {k}"}, bytes([k]))[0]["secret"] for k in range(5)]
        found = [ask(server, f"/{one}/pack")[:2] for one in (server.secret, *opened)]
        assert [status for status, _ in found] == [200, 403, 403, 200, 200, 200]
        assert [content for _, content in found[3:]] == [b"\2", b"\3", b"\4"]
        assert ask(server, f"/{opened[4]}/")[1] == b"page 4"
        server.scenes |= dict.fromkeys("abc", server.scenes[server.secret])  # as if all came at the same time
        call(server, "open", {"name": "x"})
        assert len(server.scenes) == 4
    with PageServer(PAGE, PACK, answer, "0.0.0.0", open_file=made) as other:
        assert "only this machine can open" in call(other, "open", {"name": "x"})[0]["error"]


def test_closing_leaves_no_thread_behind():
    before = threading.active_count()
    server = PageServer(PAGE, PACK, answer)
    for _ in range(5):
        ask(server, secret(server))
    server.close()
    server.close()
    end = time.monotonic() + 300
    while threading.active_count() > before and time.monotonic() < end:
        time.sleep(0.01)
    assert threading.active_count() == before
    with pytest.raises(ConnectionRefusedError):
        ask(server, "/")


def test_other_pages_names_lengths_and_addresses_are_refused(server):
    port = urlsplit(server.url).port
    for headers, status in (
        ({"Origin": "http://evil.example"}, 403), ({"Origin": "null"}, 403), ({"Host": f"evil.example:{port}"}, 403),
        ({"Origin": f"http://127.0.0.1:{port}"}, 200), ({"Host": f"localhost:{port}"}, 200),
    ):  # fmt: skip
        assert ask(server, secret(server), **headers)[0] == status
    for length in (str(LONGEST_FILE + 1), "-5", "9" * 5000):
        assert ask(server, secret(server) + "call", "POST", b"", **{"Content-Length": length})[0] == 400
    assert ask(server, secret(server) + "pack", "POST", b"")[0] == 400
    refused(lambda: PageServer(PAGE, PACK, answer, host=" "), "host", "127.0.0.1")
    refused(lambda: PageServer(PAGE, PACK, answer, port=70000), "port", "70000")
    refused(lambda: PageServer(PAGE, PACK, answer, port=port), "host, port", "free")
    with PageServer(PAGE, PACK, answer, host="::1") as other:
        assert ask(other, secret(other))[0] == 200
