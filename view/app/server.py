"""The server of the application: on this machine only, and only for those who have its address.

The address contains a token, which is the first part of every path; other paths do not exist, and logs do not
contain it. Requests are answered if they are sent to a name of this machine, and WebSockets if they come from
pages of this server.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import signal
import socket
import threading
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from html import escape
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

from mirrorskin.io import InputError

HERE = "127.0.0.1"

PULSE = 250
"""Milliseconds from one sign of life to the next."""

_NAMES = HERE, "localhost", "[::1]"
_TOKEN_BYTES = 24
_DROP_BYTES = 8 * 1024**3  # of a file that is dropped on a page, at most
_PAGES = 16  # each has its own result, and memory of the device
_HTTP_PORT = 80  # which browsers leave out


def check_app() -> None:
    """Raise InputError if the application cannot be shown, before any work is done."""
    missing = [name for name in ("panel", "bokeh", "matplotlib", "jinja2") if find_spec(name) is None]
    if missing:
        raise InputError(f"the application needs {' and '.join(missing)}: pip install 'mirrorskin[app]'")


class AppServer:
    """A server of pages at a secret address of this machine.

    Parameters
    ----------
    page : callable
        Returns what Panel shows in a new browser window.
    port : int
        0 for any free one.
    lifetime : int
        Milliseconds after which a page that was closed, or lost its connection, is forgotten.
    page_limit : int
        Number of open pages; further ones are refused.
    drops : Path, optional
        A folder for files that are dropped on a page; without one, none are accepted.

    Attributes
    ----------
    address : str
        With the token.

    Raises
    ------
    InputError
        The port cannot be used.
    """

    def __init__(
        self,
        page: Callable[[], Any],
        port: int = 0,
        lifetime: int = 15_000,
        page_limit: int = _PAGES,
        drops: Path | None = None,
    ) -> None:
        from panel.io.resources import DIST_DIR
        from panel.io.server import get_server
        from tornado.web import StaticFileHandler

        port = _free_port(port)
        token = secrets.token_urlsafe(_TOKEN_BYTES)
        interrupt = signal.getsignal(signal.SIGINT)
        hosts = _hosts(port)
        self._make_record = _hide_in_logs(token)
        self._server: Any = get_server(
            page,
            port=port,
            address=HERE,
            location=False,  # Panel cannot parse all of these hosts
            prefix=token,
            title="mirrorskin",
            ico_path="none",  # Bokeh's is at an address without the token
            extra_patterns=[
                (r"/(favicon\.ico)", StaticFileHandler, {"path": str(DIST_DIR / "images")}),
                (r"/pulse", _pulses()),
                *([] if drops is None else [(r"/drop/(.+)", _receiver(), {"folder": drops})]),
            ],
            show=False,
            start=False,
            session_token_expiration=86400,
            unused_session_lifetime_milliseconds=lifetime,
            check_unused_sessions_milliseconds=min(lifetime, 17_000),
        )
        _restore(interrupt)
        _refuse_others(self._server, hosts, f"/{token}", page_limit)
        self.address = f"http://{HERE}:{port}/{token}/"

    def run(self, browser: bool) -> None:
        """Serve until `stop` is called."""
        self._server.io_loop.asyncio_loop.set_exception_handler(_handle)
        self._server.start()
        with closing(self), TemporaryDirectory(prefix="mirrorskin-", ignore_cleanup_errors=True) as folder:
            if browser:
                self._server.io_loop.add_callback(open_browser, self.address, Path(folder))
            self._server.io_loop.start()

    def stop(self) -> None:
        """End `run`; a signal handler may call it."""
        loop = self._server.io_loop.asyncio_loop
        loop.call_soon_threadsafe(loop.stop)

    def close(self) -> None:
        """Stop serving, and close all pages."""
        self._server.stop(wait=False)
        logging.setLogRecordFactory(self._make_record)


def open_browser(address: str, folder: Path) -> None:
    """Open an address in the browser, through a file in a private folder that leads there.

    The arguments of programs can be read by all users of a computer, and the address is secret.
    """
    page = folder / "open.html"
    page.write_text(f'<meta http-equiv="refresh" content="0; url={escape(address)}">', encoding="utf-8")
    webbrowser.open(page.as_uri())


class StopServer:
    """A server that calls a function when its secret address receives a POST, such as `RigControl.stop`.

    The answer is 204 if the function returned, and otherwise 500 with the reason. Threads of its own answer,
    so that it works while the server of the pages is busy, and for a page that has lost its connection.

    Attributes
    ----------
    address : str
        With a token.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        path = f"/{secrets.token_urlsafe(_TOKEN_BYTES)}"

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                here = self.headers.get("Host", "").lower() in hosts
                if not here or not secrets.compare_digest(self.path.encode(), path.encode()):
                    self._answer(404 if here else 421)
                    return
                try:
                    stop()
                except Exception as error:
                    self._answer(500, str(error) or type(error).__name__)
                else:
                    self._answer(204)

            def _answer(self, status: int, why: str = "") -> None:
                self.send_response(status)
                self.send_header("Access-Control-Allow-Origin", "*")  # the page reads whether it was stopped
                self.end_headers()
                self.wfile.write(why.encode())

            def log_message(self, format: str, *args: Any) -> None:  # noqa: A002  # overrides
                pass

        self._server = ThreadingHTTPServer((HERE, 0), Handler)
        hosts = _hosts(self._server.server_port)
        self.address = f"http://{HERE}:{self._server.server_port}{path}"
        self._thread = threading.Thread(target=self._server.serve_forever, name="stop", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Listen no longer."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def _pulses() -> Any:
    """Return the handler of a WebSocket that sends signs of life: the page is off if they stop.

    Bokeh's own WebSocket would take a hundred times as long for each.
    """
    from tornado.ioloop import PeriodicCallback
    from tornado.websocket import WebSocketHandler

    class Pulses(WebSocketHandler):
        def open(self) -> None:
            self._beat = PeriodicCallback(lambda: self.write_message(""), PULSE)
            self._beat.start()

        def on_close(self) -> None:
            self._beat.stop()

    return Pulses


def _receiver() -> Any:
    """Return the handler of files that are dropped on a page: each is written to a folder of its own."""
    from tornado.web import RequestHandler, stream_request_body

    @stream_request_body
    class Receiver(RequestHandler):
        def initialize(self, folder: Path) -> None:
            self._folder, self._file = folder, cast(Any, None)

        def prepare(self) -> None:
            self.request.connection.set_max_body_size(_DROP_BYTES)  # type: ignore[union-attr]

        def data_received(self, chunk: bytes) -> None:
            self._open().write(chunk)

        def _open(self) -> Any:
            if self._file is None:
                name = Path(self.path_args[0].replace("\\", "/")).name
                self._place = Path(secrets.token_hex(8), name or "file")
                (self._folder / self._place.parent).mkdir()
                self._file = (self._folder / self._place).open("xb")
            return self._file

        def post(self, _: str) -> None:
            self._open().close()
            self.write(self._place.as_posix())

        def on_connection_close(self) -> None:
            if self._file is not None:
                self._file.close()

    return Receiver


def _hosts(port: int) -> list[str]:
    """Return the names of this machine with a port, as browsers send them."""
    return [f"{name}:{port}" for name in _NAMES] + ([*_NAMES] if port == _HTTP_PORT else [])


def _refuse_others(server: Any, hosts: Sequence[str], prefix: str, page_limit: int) -> None:
    """Refuse requests for other hosts, from other pages, and for more pages than are allowed."""
    from tornado.httputil import HTTPServerRequest
    from tornado.routing import Matcher, Rule
    from tornado.web import RequestHandler

    class Refused(RequestHandler):
        def initialize(self, status: int, text: str) -> None:
            self._status, self._text = status, text

        def prepare(self) -> None:
            self.set_status(self._status)
            self.set_header("Content-Type", "text/plain; charset=utf-8")
            self.finish(f"{self._text}\n")

    class Unwanted(Matcher):
        def match(self, request: HTTPServerRequest) -> dict[str, Any] | None:
            refusal = _why_foreign(request, hosts) or _why_no_page(
                request, prefix, server.get_sessions(), page_limit
            )
            return refusal and {"target_kwargs": {"status": refusal[0], "text": refusal[1]}}

    server._tornado.default_router.rules.insert(0, Rule(Unwanted(), Refused))
    server._tornado.websocket_origins.update(hosts)


def _why_foreign(request: Any, hosts: Sequence[str]) -> tuple[int, str] | None:
    """Return status and text of the answer to a request to another host or of another page."""
    if request.host.lower() not in hosts:
        return 421, "This server answers requests to localhost only."
    origin = request.headers.get("Origin")
    if origin is not None and origin.lower() not in [f"http://{host}" for host in hosts]:
        return 403, "This server answers its own pages only."
    return None


def _why_no_page(
    request: Any, prefix: str, sessions: Sequence[Any], page_limit: int
) -> tuple[int, str] | None:
    """Return status and text of the answer to a request for a page that cannot be opened."""
    place = request.path.removeprefix(prefix)
    if place == request.path or place not in ("", "/", "/ws", "/autoload.js"):
        return None
    if request.query or place == "/autoload.js":  # which Bokeh answers, and the application does not use
        return 404, "There is no such page."
    if len(sessions) < page_limit or _is_open(request, sessions):
        return None
    remedy = "Close one, and load this page again after half a minute"
    return 503, f"{page_limit} pages are open, which is the limit. {remedy}."


def _is_open(request: Any, sessions: Sequence[Any]) -> bool:
    """Return whether a WebSocket belongs to an open page."""
    from bokeh.util.token import get_session_id

    try:
        number = get_session_id(request.headers.get("Sec-WebSocket-Protocol", "").split(",")[-1].strip())
    except (ValueError, KeyError, TypeError):
        return False
    return any(number == session.id for session in sessions)


def _hide_in_logs(secret: str) -> Callable[..., logging.LogRecord]:
    """Let no record that is logged contain a secret; return what made records before."""
    make = logging.getLogRecordFactory()
    traceback = logging.Formatter().formatException

    def make_without(*args: Any, **kwargs: Any) -> logging.LogRecord:
        record = make(*args, **kwargs)
        with suppress(Exception):  # handlers report messages that do not fit their values
            message = record.getMessage()
            if secret in message:
                record.msg, record.args = message.replace(secret, "..."), ()
        if record.exc_info and record.exc_info[0] is not None:
            record.exc_text = traceback(record.exc_info).replace(secret, "...")
        return record

    logging.setLogRecordFactory(make_without)
    return make


def _handle(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Report an error, unless it is that a page was closed while it was sent something."""
    if type(context.get("exception")).__name__ != "WebSocketClosedError":
        loop.default_exception_handler(context)


def _restore(handler: Any) -> None:
    """Set the handler of Ctrl-C again, which Panel replaces."""
    try:
        signal.signal(signal.SIGINT, handler)
    except (TypeError, ValueError):  # not of Python, or not in the main thread
        return


def _free_port(port: int) -> int:
    """Return a port on which nothing listens: the given one, or any."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HERE, port))
        except (OSError, OverflowError) as error:
            raise InputError(f"port {port} cannot be used ({error}): choose another with --port") from None
        return int(probe.getsockname()[1])
