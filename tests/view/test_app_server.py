"""The server of the application: no access without the token, from foreign pages or other machines."""

import asyncio
import http.client
import logging
import re
import socket
import sys
import threading
import urllib.error
import urllib.request
from contextlib import closing, contextmanager
from functools import partial
from urllib.parse import urlsplit

import numpy as np
import pytest
from bokeh.document import Document
from stacks import record
from tornado.httpclient import HTTPRequest
from tornado.ioloop import IOLoop
from tornado.websocket import websocket_connect

from mirrorskin import io
from mirrorskin.engine.base.reconstruction import load_operation
from mirrorskin.io import InputError
from mirrorskin.twin import Twin, Vertical
from mirrorskin.view.app import App, Opening
from mirrorskin.view.app.page import pages
from mirrorskin.view.app.server import AppServer, StopServer, open_browser

PATIENCE = 60.0  # seconds


def _page():
    import panel as pn

    return pn.pane.HTML("<p>here</p>")


@contextmanager
def serving(page, **settings):
    """Serve pages from a thread; yield the parts of the address."""
    ready, ended, server = threading.Event(), threading.Event(), {}

    def serve():
        asyncio.set_event_loop(asyncio.new_event_loop())
        app = AppServer(page, **settings)
        server["address"], server["loop"] = urlsplit(app.address), IOLoop.current()
        IOLoop.current().add_callback(ready.set)
        app.run(browser=False)
        ended.set()

    thread = threading.Thread(target=serve)
    thread.start()
    assert ready.wait(PATIENCE)
    try:
        yield server["address"]
    finally:
        server["loop"].add_callback(server["loop"].stop)
        thread.join(PATIENCE)
    assert ended.is_set()


@pytest.fixture(scope="module")
def served():
    """The parts of the address of a server, which runs in a thread."""
    with serving(_page, page_limit=1000) as address:
        yield address


def status(url, **headers):
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=PATIENCE) as reply:
            return reply.status
    except urllib.error.HTTPError as error:
        return error.code


def test_the_page_is_served_with_the_token(served):
    assert status(served.geturl()) == 200


@pytest.mark.parametrize(
    "path",
    ["/", "/index.html", "/favicon.ico", "/static/js/bokeh.min.js", "/autoload.js", "/metadata", "/ws"],
)
@pytest.mark.parametrize("before", ["", "/wrong", "/%2e%2e"])
def test_nothing_is_served_without_the_token(served, before, path):
    assert status(f"http://{served.netloc}{before}{path}") == 404


def test_the_token_cannot_be_guessed(served):
    assert len(served.path.strip("/")) >= 32


def test_it_listens_on_this_machine_only(served):
    assert served.hostname == "127.0.0.1"
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.2", served.port), timeout=PATIENCE)


def _connect(served, path, origin, **headers):
    """Return the HTTP status of the answer to a WebSocket: 101 if it is accepted."""
    headers = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Protocol": f"bokeh, {_token(served)}",
        "Origin": origin,
        **headers,
    }
    with closing(http.client.HTTPConnection(served.netloc, timeout=PATIENCE)) as connection:
        connection.request("GET", path, headers=headers)
        with closing(connection.getresponse()) as reply:
            return reply.status


def _token(served):
    """Return the token of a session, from the page."""
    with urllib.request.urlopen(served.geturl(), timeout=PATIENCE) as reply:
        text = reply.read().decode()
    return re.search(r'"token":"([^"]+)"', text)[1]


def test_a_web_socket_of_the_page_is_accepted(served):
    assert _connect(served, f"{served.path}ws", f"http://{served.netloc}") == 101


FOREIGN = ["http://example.org", "http://localhost:1", "null", "", "http://[", "[::1]", "http://a:b:c", "//"]


@pytest.mark.parametrize("origin", FOREIGN)
def test_a_web_socket_of_another_page_is_refused(served, origin):
    assert _connect(served, f"{served.path}ws", origin) == 403


@pytest.mark.parametrize("origin", FOREIGN)
def test_pulses_are_sent_to_own_pages_only(served, origin):
    own = f"http://{served.netloc}"
    assert _connect(served, f"{served.path}pulse", own) == 101
    assert _connect(served, f"{served.path}pulse", origin) == 403
    assert _connect(served, "/pulse", own) == 404


@pytest.mark.parametrize("origin", FOREIGN)
def test_a_request_of_another_page_is_refused(served, origin):
    assert status(served.geturl(), Origin=origin) == 403


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "[::1]", "LocalHost"])
def test_names_of_this_machine_are_answered(served, name):
    host = f"{name}:{served.port}"
    assert status(served.geturl(), Host=host) == 200
    assert _connect(served, f"{served.path}ws", f"http://{host}", Host=host) == 101


@pytest.mark.parametrize(
    "host",
    [
        "example.org",
        "localhost",
        "127.0.0.1:1",
        "[::1]",
        "[::1",
        "]",
        "a:b:c",
        ":",
        "127.0.0.1.example.org:{}",
    ],
)
def test_other_names_are_refused(served, host):
    host = host.format(served.port)
    assert status(served.geturl(), Host=host) == 421
    assert _connect(served, f"{served.path}ws", f"http://{served.netloc}", Host=host) == 421


@pytest.mark.parametrize("query", ["bokeh-session-id=", "bokeh-token=x", "a?b"])
def test_a_query_is_refused(served, query):
    assert status(f"{served.geturl()}?{query}") == 404


def test_a_web_socket_without_the_token_is_refused(served):
    assert _connect(served, "/ws", f"http://{served.netloc}") == 404


def test_a_port_that_is_in_use_is_refused_in_one_line(served):
    with pytest.raises(InputError, match=f"port {served.port} cannot be used .*choose another with --port"):
        AppServer(_page, served.port)


def test_a_file_being_opened_when_the_server_ends_is_given_up(tmp_path, monkeypatch, caplog):
    twin = Twin(object="sphere", shape=(40, 40), pixel_size=0.26, movement=Vertical([0.1, 0.2, 0.3]))
    record(twin, tmp_path / "press.h5")
    begun, go_on, opened = threading.Event(), threading.Event(), io.open_recording

    def wait(*arguments, **keywords):
        begun.set()
        assert go_on.wait(PATIENCE)
        return opened(*arguments, **keywords)

    monkeypatch.setattr(io, "open_recording", wait)
    with pages([tmp_path / "press.h5"], [Opening()]) as page, serving(page) as address:
        assert status(address.geturl()) == 200
        assert begun.wait(PATIENCE)
    go_on.set()
    for thread in threading.enumerate():
        if thread.name.startswith("mirrorskin-page"):
            thread.join(PATIENCE)
    assert not [entry for entry in caplog.records if entry.levelno >= logging.WARNING]


def test_the_token_is_no_argument_of_the_browser(tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    open_browser("http://127.0.0.1:1/secret/", tmp_path)
    assert "secret" not in opened[0]
    assert "http://127.0.0.1:1/secret/" in (tmp_path / "open.html").read_text()


def test_no_log_contains_the_token(caplog, capfd):
    for logger in (None, "tornado.access", "tornado.application"):  # other tests may have silenced them
        caplog.set_level(logging.DEBUG, logger)
    with serving(_page) as address:
        here = f"http://{address.netloc}"
        answers = [
            status(address.geturl(), Host="example.org"),
            status(f"{address.geturl()}static/../../none"),
            status(f"{address.geturl()}none"),
            post(address.geturl()),
            _connect(address, f"{address.path}ws", here, **{"Sec-WebSocket-Protocol": "bokeh, none"}),
        ]
    assert answers == [421, 403, 404, 405, 101]
    token = address.path.strip("/")
    written = capfd.readouterr()
    assert caplog.text.count("GET /.../") >= 3
    assert token not in caplog.text + "".join(str(record.exc_text) for record in caplog.records)
    assert token not in written.out + written.err


async def _open_socket(address, token):
    """Open the WebSocket of a page, and wait for its greeting."""
    headers = {"Origin": f"http://{address.netloc}"}
    request = HTTPRequest(f"ws://{address.netloc}{address.path}ws", headers=headers)
    socket = await websocket_connect(request, subprotocols=["bokeh", token])
    assert "ACK" in await socket.read_message()
    return socket


async def _close_socket(socket):
    socket.close()
    while await socket.read_message() is not None:
        pass


def test_more_pages_than_the_limit_are_refused_until_one_is_closed():
    closed = threading.Event()

    def page():
        import panel as pn

        pn.state.on_session_destroyed(lambda _: closed.set())
        return _page()

    async def open_and_close(address):
        get = partial(asyncio.to_thread, status, address.geturl())
        tokens = [await asyncio.to_thread(_token, address) for _ in range(2)]
        sockets = [await _open_socket(address, token) for token in tokens]
        assert await get() == 503
        closed.clear()
        await _close_socket(sockets[0])
        assert await asyncio.to_thread(closed.wait, PATIENCE)
        answer = await get()
        await _close_socket(sockets[1])
        return answer

    with serving(page, page_limit=2, lifetime=10) as address:
        assert asyncio.run(open_and_close(address)) == 200


BLOCKED = """
import threading
from mirrorskin import engine

started, go = threading.Event(), threading.Event()

class Blocked(engine.Operation):
    motions = ("vertical",)

    def start(self, shape, dtype):
        self.brightest = 0

    def push(self, frames):
        started.set()
        assert go.wait(60)
        self.brightest = frames.max(axis=0)

    def result(self):
        return {"brightest": self.brightest}
"""


@pytest.fixture
def blocked(tmp_path, monkeypatch):
    """The class of an operation that waits, and its events."""
    (tmp_path / "blocked.py").write_text(BLOCKED)
    return load_operation(f"{tmp_path / 'blocked.py'}:Blocked"), f"{tmp_path / 'blocked.py'}:Blocked"


def test_pages_are_served_while_one_computes(blocked, tmp_path):
    kind, name = blocked
    events = sys.modules[kind.__module__]
    twin = Twin(object="sphere", shape=(20, 20), pixel_size=0.5, movement=Vertical(0.1 * np.arange(4)))
    record(twin, tmp_path / "press.h5")
    computed = threading.Event()

    def page():
        return Watched(tmp_path / "press.h5", opening=Opening(operation=name)).view

    class Watched(App):
        def _keep(self, number, result):
            super()._keep(number, result)
            if result is not None:
                computed.set()

    async def look(address):
        socket = await _open_socket(address, await asyncio.to_thread(_token, address))
        assert await asyncio.to_thread(events.started.wait, PATIENCE)
        answer = await asyncio.to_thread(status, address.geturl())
        early = computed.is_set()
        events.go.set()
        assert await asyncio.to_thread(computed.wait, PATIENCE)
        await _close_socket(socket)
        return answer, early

    with serving(page) as address:
        assert asyncio.run(look(address)) == (200, False)


def test_only_the_thread_of_the_server_adds_to_a_page(tmp_path, monkeypatch):
    # Panel exchanges lists of what is to be sent, and would lose what another thread adds meanwhile.
    twin = Twin(object="sphere", shape=(20, 20), pixel_size=0.5, movement=Vertical(0.1 * np.arange(4)))
    record(twin, tmp_path / "press.h5")
    computed, servers, adding = threading.Event(), set(), set()
    add = Document.add_next_tick_callback

    def added(document, callback):
        adding.add(threading.get_ident())
        return add(document, callback)

    monkeypatch.setattr(Document, "add_next_tick_callback", added)

    class Watched(App):
        def _keep(self, number, result):
            super()._keep(number, result)
            if result is not None:
                computed.set()

    def page():
        servers.add(threading.get_ident())
        return Watched(tmp_path / "press.h5").view

    async def look(address):
        socket = await _open_socket(address, await asyncio.to_thread(_token, address))
        assert await asyncio.to_thread(computed.wait, PATIENCE)
        await _close_socket(socket)

    with serving(page) as address:
        asyncio.run(look(address))
    assert adding == servers


@pytest.fixture
def stopper():
    """A server that stops something, and what was asked of it so far."""
    asked = []
    with closing(StopServer(lambda: asked.append("stop"))) as server:
        yield server.address, asked


def post(url, **headers):
    request = urllib.request.Request(url, method="POST", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE) as reply:
            return reply.status
    except urllib.error.HTTPError as error:
        return error.code


def test_a_post_to_the_secret_address_stops(stopper):
    address, asked = stopper
    assert post(address) == 204
    assert asked == ["stop"]


def test_a_post_to_another_host_stops_nothing(stopper):
    address, asked = stopper
    assert post(address, Host="example.org") == 421
    assert asked == []


def test_a_post_to_another_address_stops_nothing(stopper):
    address, asked = stopper
    assert post(address.rpartition("/")[0] + "/other") == 404
    assert asked == []


def test_a_stop_that_fails_is_answered_with_the_reason():
    def stop():
        raise InputError("the stage does not answer")

    with closing(StopServer(stop)) as server, pytest.raises(urllib.error.HTTPError) as failed:
        urllib.request.urlopen(urllib.request.Request(server.address, method="POST"), timeout=PATIENCE)
    assert failed.value.code == 500
    assert failed.value.read() == b"the stage does not answer"


@pytest.fixture
def receiving(tmp_path):
    """The parts of the address of a server that takes files, and the folder where it puts them."""
    folder = tmp_path / "drops"
    folder.mkdir()
    with serving(_page, drops=folder) as address:
        yield address, folder


@pytest.mark.parametrize("name", ["ball.h5", "..%2F..%2Fball.h5", "%2Ftmp%2Fball.h5", "a%5Cball.h5"])
def test_a_file_that_is_dropped_is_put_into_a_folder_of_its_own(receiving, name):
    address, folder = receiving
    content = bytes(range(256)) * 10_000
    request = urllib.request.Request(f"{address.geturl()}drop/{name}", data=content)
    with urllib.request.urlopen(request, timeout=PATIENCE) as reply:
        place = reply.read().decode()
    assert place.partition("/")[2] == "ball.h5"
    assert (folder / place).read_bytes() == content
    assert [path for path in folder.rglob("*") if path.is_file()] == [folder / place]


def test_other_pages_cannot_drop_files(receiving):
    address, folder = receiving
    assert post(f"{address.geturl()}drop/ball.h5", Origin="http://example.org") == 403
    assert post(f"http://{address.netloc}/wrong/drop/ball.h5") == 404
    assert list(folder.iterdir()) == []


def test_without_a_folder_no_file_is_taken(served):
    assert post(f"{served.geturl()}drop/ball.h5") == 404
