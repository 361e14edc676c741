"""Live viewer: a page in a browser on this machine, served by a thread of this process."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import socket
import threading
from collections.abc import Callable, Mapping
from functools import partial
from time import monotonic, sleep
from typing import TypeAlias

import numpy as np
from tornado.httpserver import HTTPServer
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from fflin.base import html
from fflin.base.errors import FflinError, InputError
from fflin.base.validation import Array
from fflin.dynamics.impact import inertia_at
from fflin.dynamics.state import StateMap
from fflin.robot.fields import travel_of
from fflin.robot.robot import Robot
from fflin.view.html_page import HEIGHT
from fflin.view.page import Page, body_poses

_HOST = "127.0.0.1"

# Request of a browser: {"joints": {name: value}}, {"neutral": true} or {"random": true}.
Request: TypeAlias = "Mapping[str, Mapping[str, float]]"


class Live:
    """Live view of a robot in a browser; `visualize(robot)` returns it.

    A thread of this process serves the page, to this machine only, until the viewer is closed or
    the process ends. If the viewer is given to `simulate` as its callback, it shows the running
    simulation.

    Attributes
    ----------
    url : str
        Address of the page.
    port : int
        Port of the page.
    q : ndarray (nq,)
        Current configuration of the robot; the sliders change it.
    meshcat : meshcat.Visualizer
        meshcat viewer, to which further objects can be added.
    notes : tuple of str
        Notes about visual elements that could not be drawn.
    """

    def __init__(
        self, page: Page, q: Array, *, follow: bool | None, speed: float, port: int
    ) -> None:
        robot = page.robot
        self.robot, self._speed = robot, speed
        self._state_map, self._ranges = StateMap(robot), _ranges(robot)
        self._lock = threading.Lock()
        # Clock time and simulation time [s] at the first shown step of a simulation.
        self._began: tuple[float, float] | None = None
        self._state = "{}"
        self._clients = set[_Socket]()
        self._page = page
        page.window.forward = partial(self._each, _Socket.send)
        self.meshcat = page.meshcat
        self.notes = tuple(page.notes)
        axes = [
            f"base {kind} {axis}"
            for kind in ("rotation", "translation")
            for axis in "xyz"
        ]
        sliders = [
            {
                "name": name,
                "low": low,
                "high": high,
                "length": robot.joint(name).prismatic,
            }
            for name, (low, high) in self._ranges.items()
        ]
        self._html = page.html(
            "live",
            page.points,
            follow=bool(follow),
            joints=sliders,
            names=[*axes, *robot.joint_names],
        )
        try:
            listener = socket.create_server((_HOST, port), backlog=128)
        except OSError as error:
            why = os.strerror(error.errno or 0)
            raise InputError(
                f"port {port} is not available: {why}; give another port, or 0 for a free port"
            ) from None
        listener.setblocking(False)
        self.port: int = listener.getsockname()[1]
        self.url = page.window.web_url = f"http://{_HOST}:{self.port}/"
        self._hosts = {f"{name}:{self.port}" for name in (_HOST, "localhost")}
        self._thread = self._serve(listener)
        self.show(q)

    def _serve(self, listener: socket.socket) -> threading.Thread:
        """Start a thread that serves the page until the viewer is closed."""
        given = {"live": self}
        application = Application(
            [("/", _Page, given), ("/socket", _Socket, given)],
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
            server.stop()
            for client in list(self._clients):
                client.close()
            await server.close_all_connections()

        thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
        thread.start()
        started.wait()
        return thread

    def show(self, q: Array, t: float | None = None) -> None:
        """Show the robot at a configuration (nq,), and the time t [s]."""
        q = self.robot.checked_configuration(q).copy()
        q.setflags(write=False)
        with self._lock:
            poses = body_poses(self.robot, q)
            inertia = self._state_map.project(inertia_at(self.robot, q))
            scale = np.sqrt(np.diag(inertia))
            state = {
                "time": None if t is None else float(t),
                "poses": poses.round(7).tolist(),
                "joints": [self.robot.joint(name).value(q) for name in self._ranges],
                "coupling": (inertia / np.outer(scale, scale))
                .round(4)
                .ravel()
                .tolist(),
            }
            self.q = q
            self._state = json.dumps(state)
        # A slow browser receives only the newest state, and skips the older states.
        self._each(_Socket.update)

    def __call__(self, t: float, q: Array, *_: object) -> None:
        """Show a step of a running simulation; wait first, to keep the playback speed."""
        now = monotonic()
        if self._began is None or t <= self._began[1]:
            self._began = now, t
        sleep(max(0.0, self._began[0] + (t - self._began[1]) / self._speed - now))
        self.show(q, t)

    def __repr__(self) -> str:
        return f"Live('{self.robot.name}', {self.url})"

    def _repr_html_(self) -> str:
        """Return the address, and a frame with the page if the browser can reach this machine."""
        link = f'<a href="{self.url}" target="_blank">{self.url}</a>'
        if not html.browser_is_local():
            note = "Only browsers on the machine of this kernel can open the live page."
            return html.card(
                "Live", self.robot.name, link, html.paragraph(note, "note")
            )
        shown = html.frame(self.robot.name, HEIGHT, address=self.url)
        return html.card("Live", self.robot.name, link, shown)

    def open(self) -> None:
        """Open the page in a browser."""
        import webbrowser

        webbrowser.open(self.url)

    def wait(self) -> None:
        """Wait until the viewer is closed, or until Ctrl-C."""
        try:
            # Some platforms do not handle Ctrl-C during a wait without timeout.
            while self._thread.is_alive():
                self._thread.join(0.5)
        except KeyboardInterrupt:
            self.close()

    def close(self) -> None:
        """Close the viewer; the page in the browser reports the lost connection."""
        self._call(self._stop.set)
        self._thread.join(5.0)

    def __enter__(self) -> Live:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _each(self, what: Callable[..., object], *arguments: object) -> None:
        """Call a method of `_Socket` for the connection to each browser."""
        self._call(lambda: [what(client, *arguments) for client in list(self._clients)])

    def _call(self, what: Callable[[], object]) -> None:
        with contextlib.suppress(RuntimeError):  # the server is closed
            self._loop.call_soon_threadsafe(what)

    def _asked(self, message: Request) -> None:
        q = self.q.copy()
        if message.get("neutral"):
            q[7:] = self.robot.neutral()[7:]
        wanted = dict(message.get("joints", {}))
        if message.get("random"):
            uniform = np.random.default_rng().uniform
            wanted = {name: uniform(*ends) for name, ends in self._ranges.items()}
        for name, value in wanted.items():
            self.robot.joint(name).place(q, float(value))
        self.robot.follow(q)
        self.show(q)


def _ranges(robot: Robot) -> dict[str, tuple[float, float]]:
    """Return {joint: range of the slider [rad|m|kg^0.5 m]} for all joints except wheels."""
    ranges = {}
    for joint in robot.joints:
        most = 1.0 if joint.prismatic else np.pi
        least, largest = travel_of(robot.model, joint)
        low, high = max(least, -most), min(largest, most)
        if not low < high:
            low, high = low - 1.0, low + 1.0
        if joint.name not in robot.wheels:
            ranges[joint.name] = (low, high)
    return ranges


class _Guarded(RequestHandler):
    """Handler that refuses each request whose Host header does not name this machine."""

    def initialize(self, live: Live) -> None:
        self._live = live

    def prepare(self) -> None:
        if self.request.host not in self._live._hosts:
            raise HTTPError(403)

    def set_default_headers(self) -> None:
        self.clear_header("Server")


class _Page(_Guarded):
    def get(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.write(self._live._html)


class _Socket(_Guarded, WebSocketHandler):
    """Connection to one browser.

    A state is sent only after the previous state has been written to the connection.
    """

    _busy = False
    _behind = False

    def check_origin(self, origin: str) -> bool:
        return origin.partition("://")[2] in self._live._hosts

    def open(self, *_: str, **__: str) -> None:
        self._live._clients.add(self)
        for message in self._live._page.window.commands():
            self.send(message)
        self.update()

    def on_close(self) -> None:
        self._live._clients.discard(self)

    def on_message(self, message: str | bytes) -> None:
        # Ignore invalid messages. A message that is nested too deeply closes the connection.
        try:
            self._live._asked(json.loads(message))
        except (FflinError, ValueError, TypeError, AttributeError, ArithmeticError):
            return
        except RecursionError:
            self.close(1008, "nested too deep")

    def send(self, content: bytes | str) -> asyncio.Future[None] | None:
        try:
            binary = isinstance(content, bytes)
            sent: asyncio.Future[None] = self.write_message(content, binary=binary)
            return sent
        except WebSocketClosedError:
            return None

    def update(self) -> None:
        self._behind = self._busy
        if self._busy:
            return
        sent = self.send(self._live._state)
        if sent:
            self._busy = True
            sent.add_done_callback(self._arrived)

    def _arrived(self, sent: asyncio.Future[None]) -> None:
        self._busy = False
        if sent.exception() is None and self._behind:
            self.update()
