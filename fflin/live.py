"""The live viewer: a page on this machine's loopback, served by a thread of this process."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import threading
from typing import Any

import numpy as np
import pinocchio as pin
from tornado import httpserver, web, websocket

from fflin.errors import FflinError, InputError
from fflin.film import corner_points, stage_info, triads
from fflin.model import Robot
from fflin.page import build_page
from fflin.playback import body_poses
from fflin.recorder import Recorder
from fflin.scene import Drawing, Visualizer, body_paths
from fflin.state import StateMap
from fflin.validation import Array

_HOST = "127.0.0.1"


class Live:
    """A robot in a browser, that moves as it is told; made by `visualize(robot)`.

    It is served by a thread of this process, to this machine only, and ends with it. Given to
    `simulate` as an observer, it shows the simulation as it runs.

    Parameters
    ----------
    robot : Robot
    q : ndarray (nq,)
        Where it stands first.
    scene : str
        "space" or "lab".
    tool : str or None
        Frame that gets a triad.
    follow : bool
        Whether the camera follows the base.
    port : int
        0 for one that is free.

    Attributes
    ----------
    url : str
    q : ndarray (nq,)
        Where the robot stands; sliders move it.
    meshcat : meshcat.Visualizer
        For what else is to be drawn.
    notes : tuple of str
        What could not be drawn.
    """

    def __init__(
        self,
        robot: Robot,
        q: Array,
        *,
        scene: str = "space",
        tool: str | None = None,
        follow: bool = False,
        port: int = 0,
    ) -> None:
        self.robot = robot
        self._data = robot.model.createData()
        self._state_map = StateMap(robot)
        self._recorder = Recorder(self._forward)
        self._clients: set[_Socket] = set()
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._pending = False
        self.meshcat = Visualizer(window=self._recorder)
        drawing = Drawing(robot, self.meshcat["robot"])
        self.notes = drawing.notes
        poses = body_poses(robot, self._data, q)
        info = stage_info(robot, drawing, poses, scene=scene, subtitle=_subtitle(robot))
        info |= {
            "mode": "live",
            "follow": follow,
            "legend": [],
            "points": corner_points(drawing, poses).round(4).tolist(),
            "joints": _joints(robot),
            "names": [name.partition(".")[2] for name in self._state_map.names[-6 - robot.n :]],
            "bodies": [["meshcat", "robot", path] for path in body_paths(robot)],
            "triads": triads(robot, tool, info["size"]),
        }
        info["names"][:6] = [f"base {kind} {axis}" for kind in ("turn", "shift") for axis in "xyz"]
        self._serve(build_page(info, connect="'self' ws:"), port)
        self._recorder.web_url = self.url
        self.show(q)

    def show(self, q: Array, t: float | None = None) -> None:
        """Put the robot at a configuration.

        Parameters
        ----------
        q : array_like (nq,)
        t : float, optional
            Time to show [s].

        Raises
        ------
        InputError
            If q is no configuration of the robot.
        """
        q = self.robot.checked_configuration(q).copy()
        q.setflags(write=False)
        with self._lock:
            poses = body_poses(self.robot, self._data, q)
            inertia = pin.crba(self.robot.model, self._data, q)
            inertia = self._state_map.project(np.triu(inertia) + np.triu(inertia, 1).T)
            scale = np.sqrt(np.diag(inertia))
            state = {
                "time": None if t is None else float(t),
                "poses": poses.round(7).tolist(),
                "joints": self._state_map.joint_positions(q).tolist(),
                "coupling": (inertia / np.outer(scale, scale)).round(4).ravel().tolist(),
            }
            self.q = q
            self._message = json.dumps(state)
        self._call(self._broadcast)

    def __call__(self, t: float, q: Array, *_: Any) -> None:
        """Show a step of a running simulation."""
        self.show(q, t)

    def open(self) -> None:
        """Open a browser on it."""
        import webbrowser

        webbrowser.open(self.url)

    def wait(self) -> None:
        """Wait until it is closed, or until Ctrl-C."""
        try:
            # Without a timeout some platforms do not let Ctrl-C through.
            while self._thread.is_alive():
                self._thread.join(0.5)
        except KeyboardInterrupt:
            self.close()

    def close(self) -> None:
        """End it; the page says that the connection is lost."""
        loop, self._loop = self._loop, None
        if loop:
            loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(5.0)

    def __enter__(self) -> Live:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _serve(self, page: str, port: int) -> None:
        listener = _listen(port)
        self.port = listener.getsockname()[1]
        self.url = f"http://{_HOST}:{self.port}/"
        hosts = {f"{name}:{self.port}" for name in (_HOST, "localhost")}
        application = web.Application(
            [
                ("/", _Page, {"hosts": hosts, "page": page}),
                ("/socket", _Socket, {"hosts": hosts, "live": self}),
            ],
            log_function=lambda _: None,
            websocket_ping_interval=20,
        )
        started = threading.Event()

        async def run() -> None:
            self._loop = asyncio.get_running_loop()
            self._stop = asyncio.Event()
            server = httpserver.HTTPServer(application)
            server.add_socket(listener)
            started.set()
            await self._stop.wait()
            server.stop()
            for client in list(self._clients):
                client.close()
            await server.close_all_connections()

        self._thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
        self._thread.start()
        started.wait()

    def _call(self, what: Any, *arguments: Any) -> None:
        loop = self._loop
        if loop:
            loop.call_soon_threadsafe(what, *arguments)

    def _forward(self, command: bytes) -> None:
        if self._loop:
            self._call(lambda: [client.send(command) for client in list(self._clients)])

    def _broadcast(self) -> None:
        for client in list(self._clients):
            client.update()

    def _opened(self, client: _Socket) -> None:
        self._clients.add(client)
        for command in self._recorder.commands():
            client.send(command)
        client.update()

    def _asked(self, message: dict[str, Any]) -> None:
        q = self.q.copy()
        if message.get("neutral"):
            q[7:] = self.robot.neutral()[7:]
        limits = {each["name"]: each for each in _joints(self.robot)}
        wanted = dict(message.get("joints", {}))
        if message.get("random"):
            rng = np.random.default_rng()
            wanted = {name: rng.uniform(x["low"], x["high"]) for name, x in limits.items()}
        for name, value in wanted.items():
            self.robot.joint(name).place(q, float(value))
        self.robot.follow(q)
        self.show(q)


class _Guarded(web.RequestHandler):
    """Answers only to this machine's own names, so that no other site's page gets through."""

    def initialize(self, hosts: set[str], **fields: Any) -> None:
        self._hosts = hosts
        self._fields = fields

    def prepare(self) -> None:
        if self.request.host not in self._hosts:
            raise web.HTTPError(403)

    def set_default_headers(self) -> None:
        self.clear_header("Server")


class _Page(_Guarded):
    def get(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.write(self._fields["page"])


class _Socket(_Guarded, websocket.WebSocketHandler):
    """One browser. It is sent the newest state when it has taken the one before."""

    _busy = False
    _behind = False

    def check_origin(self, origin: str) -> bool:
        return origin.partition("://")[2] in self._hosts

    def open(self, *_: str, **__: str) -> None:
        self._fields["live"]._opened(self)

    def on_close(self) -> None:
        self._fields["live"]._clients.discard(self)

    def on_message(self, message: str | bytes) -> None:
        try:
            asked = json.loads(message)
            self._fields["live"]._asked(asked)
        except (FflinError, ValueError, TypeError, AttributeError):
            pass  # of no page of ours

    def send(self, content: bytes | str) -> Any:
        try:
            return self.write_message(content, binary=isinstance(content, bytes))
        except websocket.WebSocketClosedError:
            return None

    def update(self) -> None:
        if self._busy:
            self._behind = True
            return
        sent = self.send(self._fields["live"]._message)
        if sent is None:
            return
        self._busy = True

        def done(future: asyncio.Future[None]) -> None:
            self._busy = False
            if future.exception() is None and self._behind:
                self._behind = False
                self.update()

        sent.add_done_callback(done)


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
            f"port {port} cannot be had: {error.strerror}; name another, or none for a free one"
        ) from None
    listener.setblocking(False)
    return listener


def _subtitle(robot: Robot) -> str:
    return f"{robot.n} joint{'s' * (robot.n != 1)}, {robot.mass:.4g} kg"


def _joints(robot: Robot) -> list[dict[str, Any]]:
    """Return name and range of the slider of every joint."""
    model = robot.model
    found = []
    for joint in robot.joints:
        low, high = -np.pi, np.pi
        if not joint.unbounded:
            low = max(float(model.lowerPositionLimit[joint.idx_q]), -1.0 if joint.prismatic else -np.pi)
            high = min(float(model.upperPositionLimit[joint.idx_q]), 1.0 if joint.prismatic else np.pi)
            if not low < high:
                low, high = low - 1.0, low + 1.0
        found.append({"name": joint.name, "low": low, "high": high, "length": joint.prismatic})
    return found
