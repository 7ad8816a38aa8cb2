"""The server of the application: on this machine only, and only for those who have its address.

The address contains a token, which is the first part of every path; other paths do not exist. WebSockets are
accepted from pages of this server only.
"""

from __future__ import annotations

import asyncio
import secrets
import signal
import socket
import threading
import webbrowser
from collections.abc import Callable
from contextlib import closing
from html import escape
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from mirrorskin.io import InputError

HERE = "127.0.0.1"

_TOKEN_BYTES = 24


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

    Attributes
    ----------
    address : str
        With the token.

    Raises
    ------
    InputError
        The port cannot be used.
    """

    def __init__(self, page: Callable[[], Any], port: int = 0, lifetime: int = 15_000) -> None:
        from panel.io.resources import DIST_DIR
        from panel.io.server import get_server
        from tornado.web import StaticFileHandler

        port = _free_port(port)
        token = secrets.token_urlsafe(_TOKEN_BYTES)
        interrupt = signal.getsignal(signal.SIGINT)
        self._server = get_server(
            page,
            port=port,
            address=HERE,
            websocket_origin=f"{HERE}:{port}",
            prefix=token,
            title="mirrorskin",
            ico_path="none",  # Bokeh's is at an address without the token
            extra_patterns=[(r"/(favicon\.ico)", StaticFileHandler, {"path": str(DIST_DIR / "images")})],
            show=False,
            start=False,
            session_token_expiration=86400,
            unused_session_lifetime_milliseconds=lifetime,
            check_unused_sessions_milliseconds=min(lifetime, 17_000),
        )
        _restore(interrupt)
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


def open_browser(address: str, folder: Path) -> None:
    """Open an address in the browser, through a file in a private folder that leads there.

    The arguments of programs can be read by all users of a computer, and the address is secret.
    """
    page = folder / "open.html"
    page.write_text(f'<meta http-equiv="refresh" content="0; url={escape(address)}">', encoding="utf-8")
    webbrowser.open(page.as_uri())


class StopServer:
    """A server that calls a function when its secret address receives a POST, such as `RigControl.stop`.

    Threads of its own answer, so that it works while the server of the pages is busy, and for a page that
    has lost its connection.

    Attributes
    ----------
    address : str
        With a token.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        path = f"/{secrets.token_urlsafe(_TOKEN_BYTES)}"

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                known = secrets.compare_digest(self.path.encode(), path.encode())
                if known:
                    stop()
                self.send_response(204 if known else 404)
                self.end_headers()

            def log_message(self, format: str, *args: Any) -> None:  # noqa: A002  # overrides
                pass

        self._server = ThreadingHTTPServer((HERE, 0), Handler)
        self.address = f"http://{HERE}:{self._server.server_port}{path}"
        self._thread = threading.Thread(target=self._server.serve_forever, name="stop", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Listen no longer."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


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
            raise InputError(f"port {port} cannot be used ({error}): choose another with --port") from error
        return int(probe.getsockname()[1])
