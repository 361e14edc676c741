"""A server of one page to this machine alone, in a thread of this process."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import socket
import threading
from collections.abc import Callable, Iterable
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from fflin.base.errors import FflinError, InputError

_HOST = "127.0.0.1"


class Server:
    """Serves a page and keeps it up to date; it ends with its process."""

    def __init__(
        self,
        page: str,
        scene: Callable[[], Iterable[bytes]],  # for a browser that has just come
        asked: Callable[[object], None],  # takes what a browser sends
        port: int,  # 0 for one that is free
    ) -> None:
        self.scene, self.asked = scene, asked
        self.state = "{}"
        self.clients: set[_Socket] = set()
        listener = _listen(port)
        self.port: int = listener.getsockname()[1]
        self.url = f"http://{_HOST}:{self.port}/"
        hosts = {f"{name}:{self.port}" for name in (_HOST, "localhost")}
        application = Application(
            [
                ("/", _Page, {"hosts": hosts, "page": page}),
                ("/socket", _Socket, {"hosts": hosts, "server": self}),
            ],
            log_function=lambda _: None,
            websocket_ping_interval=20,
        )
        started = threading.Event()

        async def run() -> None:
            self._loop = asyncio.get_running_loop()
            self._stop = asyncio.Event()
            server = HTTPServer(application)
            server.add_socket(listener)
            started.set()
            await self._stop.wait()
            self._running = False
            server.stop()
            for client in list(self.clients):
                client.close()
            await server.close_all_connections()

        self._running = True
        self._thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
        self._thread.start()
        started.wait()

    def send(self, message: bytes) -> None:
        """Send a message to every browser."""
        self._call(lambda: [client.send(message) for client in list(self.clients)])

    def update(self, state: str) -> None:
        """Send a state to every browser; one that is slow skips those that are old by then."""
        self.state = state
        self._call(self._update_all)

    def _update_all(self) -> None:
        for client in list(self.clients):
            client.update()

    def wait(self) -> None:
        """Wait until it is closed, or until Ctrl-C."""
        try:
            # Without a timeout some platforms do not let Ctrl-C through.
            while self._thread.is_alive():
                self._thread.join(0.5)
        except KeyboardInterrupt:
            self.close()

    def close(self) -> None:
        """End it."""
        self._call(self._stop.set)
        self._thread.join(5.0)

    def _call(self, what: Callable[[], object]) -> None:
        if self._running and self._thread.is_alive():
            with contextlib.suppress(RuntimeError):  # it has just been closed
                self._loop.call_soon_threadsafe(what)


def _listen(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        if os.name == "posix":  # elsewhere it would let two listen on one port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((_HOST, port))
        listener.listen(128)
    except OSError as error:
        listener.close()
        raise InputError(
            f"port {port} is not available: {error.strerror}; give another one, or 0 for a free one"
        ) from None
    listener.setblocking(False)
    return listener


class _Guarded(RequestHandler):
    """Answers only to this machine's own names, so that no other site's page gets through."""

    def initialize(self, hosts: set[str], **fields: Any) -> None:
        self._hosts = hosts
        self._fields = fields

    def prepare(self) -> None:
        if self.request.host not in self._hosts:
            raise HTTPError(403)

    def set_default_headers(self) -> None:
        self.clear_header("Server")


class _Page(_Guarded):
    def get(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.write(self._fields["page"])


class _Socket(_Guarded, WebSocketHandler):
    """Connection to one browser, which receives the newest state after the previous state."""

    _busy = False
    _behind = False

    def check_origin(self, origin: str) -> bool:
        return origin.partition("://")[2] in self._hosts

    def open(self, *_: str, **__: str) -> None:
        server: Server = self._fields["server"]
        server.clients.add(self)
        for message in server.scene():
            self.send(message)
        self.update()

    def on_close(self) -> None:
        self._fields["server"].clients.discard(self)

    def on_message(self, message: str | bytes) -> None:
        # What no page of ours sends is passed over, and what is nested too deep ends it.
        try:
            self._fields["server"].asked(json.loads(message))
        except (FflinError, ValueError, TypeError, AttributeError, ArithmeticError):
            return
        except RecursionError:
            self.close(1008, "nested too deep")

    def send(self, content: bytes | str) -> Any:
        try:
            return self.write_message(content, binary=isinstance(content, bytes))
        except WebSocketClosedError:
            return None

    def update(self) -> None:
        if self._busy:
            self._behind = True
            return
        sent = self.send(self._fields["server"].state)
        if sent is None:
            return
        self._busy = True

        def done(future: asyncio.Future[None]) -> None:
            self._busy = False
            if future.exception() is None and self._behind:
                self._behind = False
                self.update()

        sent.add_done_callback(done)
