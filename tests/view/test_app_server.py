"""The server of the application: no access without the token, from foreign pages or other machines."""

import asyncio
import http.client
import re
import socket
import threading
import urllib.error
import urllib.request
from contextlib import closing
from urllib.parse import urlsplit

import pytest
from tornado.ioloop import IOLoop

from mirrorskin.io import InputError
from mirrorskin.view.app.server import AppServer, StopServer, open_browser

PATIENCE = 60.0  # seconds


def _page():
    import panel as pn

    return pn.pane.HTML("<p>here</p>")


@pytest.fixture(scope="module")
def served():
    """The parts of the address of a server, which runs in a thread."""
    ready, ended, found = threading.Event(), threading.Event(), {}

    def serve():
        asyncio.set_event_loop(asyncio.new_event_loop())
        server = AppServer(_page)
        found["address"], found["loop"] = urlsplit(server.address), IOLoop.current()
        IOLoop.current().add_callback(ready.set)
        server.run(browser=False)
        ended.set()

    thread = threading.Thread(target=serve)
    thread.start()
    assert ready.wait(PATIENCE)
    yield found["address"]
    found["loop"].add_callback(found["loop"].stop)
    thread.join(PATIENCE)
    assert ended.is_set()


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


def _connect(served, path, origin):
    """Return the HTTP status of the answer to a WebSocket: 101 if it is accepted."""
    headers = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Protocol": f"bokeh, {_token(served)}",
        "Origin": origin,
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


@pytest.mark.parametrize("origin", ["http://example.org", "http://localhost:1", "null"])
def test_a_web_socket_of_another_page_is_refused(served, origin):
    assert _connect(served, f"{served.path}ws", origin) == 403


def test_a_web_socket_without_the_token_is_refused(served):
    assert _connect(served, "/ws", f"http://{served.netloc}") == 404


def test_a_port_that_is_in_use_is_refused_in_one_line(served):
    with pytest.raises(InputError, match=f"port {served.port} cannot be used .*choose another with --port"):
        AppServer(_page, served.port)


def test_the_token_is_no_argument_of_the_browser(tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    open_browser("http://127.0.0.1:1/secret/", tmp_path)
    assert "secret" not in opened[0]
    assert "http://127.0.0.1:1/secret/" in (tmp_path / "open.html").read_text()


@pytest.fixture
def stopper():
    """A server that stops something, and what was asked of it so far."""
    asked = []
    with closing(StopServer(lambda: asked.append("stop"))) as server:
        yield server.address, asked


def post(url):
    try:
        with urllib.request.urlopen(urllib.request.Request(url, method="POST"), timeout=PATIENCE) as reply:
            return reply.status
    except urllib.error.HTTPError as error:
        return error.code


def test_a_post_to_the_secret_address_stops(stopper):
    address, asked = stopper
    assert post(address) == 204
    assert asked == ["stop"]


def test_a_post_to_another_address_stops_nothing(stopper):
    address, asked = stopper
    assert post(address.rpartition("/")[0] + "/other") == 404
    assert asked == []
