"""The live viewer: a page on the loopback address, served by a thread of this process."""

from __future__ import annotations

import json
import threading
from time import monotonic, sleep
from typing import Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.control.tracking import Reference, followed, reference_of
from fflin.dynamics.impact import inertia_at
from fflin.dynamics.state import StateMap
from fflin.robot.robot import Robot
from fflin.view.page import (
    Recorder,
    build_page,
    corner_points,
    rounded,
    stage_info,
    subtitle,
)
from fflin.view.playback import body_poses
from fflin.view.scene import Drawing, Visualizer, body_paths
from fflin.view.server import Server


class Live:
    """Live view of a robot in a browser; made by `visualize(robot)`.

    A thread of this process serves the page, to this machine only, until the process ends. Given to
    `simulate` as its callback, the viewer shows the running simulation; `follow` adds a ghost at
    the trajectory.

    Attributes
    ----------
    url : str
        Address of the page.
    port : int
        Port of the page.
    q : ndarray (nq,)
        Current configuration of the robot; the sliders change it.
    meshcat : meshcat.Visualizer
        Viewer for additional objects.
    notes : tuple of str
        Remarks on visual elements that could not be drawn.
    """

    def __init__(
        self,
        robot: Robot,
        q: Array,
        *,
        scene: str = "space",
        tool: str | None = None,
        follow: bool = False,
        speed: float = 1.0,
        port: int = 0,
        frame: str | None = None,
    ) -> None:
        self.robot = robot
        self._data = robot.model.createData()
        self._state_map = StateMap(robot)
        self._joints = _joints(robot)
        self._lock = threading.Lock()
        self._speed = speed
        # When on the clock, and at which time, the simulation that is shown began.
        self._began: tuple[float, float] | None = None
        self._recorder = Recorder(self._forward)
        self.meshcat = Visualizer(window=self._recorder)
        drawing = Drawing(robot, self.meshcat["robot"])
        self.notes = drawing.notes
        poses = body_poses(robot, self._data, q)
        info = stage_info(
            robot, drawing, poses, scene=scene, subtitle=subtitle(robot), tool=tool, frame=frame
        )
        info |= {
            "mode": "live",
            "follow": follow,
            "points": rounded(corner_points(drawing, poses), info["size"]),
            "joints": self._joints,
            "names": [name.partition(".")[2] for name in self._state_map.names[-6 - robot.n :]],
            "bodies": [["meshcat", "robot", path] for path in body_paths(robot)],
        }
        info["names"][:6] = [
            f"base {kind} {axis}" for kind in ("rotation", "translation") for axis in "xyz"
        ]
        page = build_page(info, connect="'self' ws:")
        self._reference: Reference | None = None
        self._server = Server(page, self._recorder.commands, self._asked, port)
        self.url = self._recorder.web_url = self._server.url
        self.port = self._server.port
        self.show(q)

    def follow(self, policy: Any) -> Live:
        """Show the trajectory that a policy or schedule follows as a ghost; return the viewer.

        Use it as ``simulate(robot, schedule, callback=live.follow(schedule))``.

        Raises
        ------
        InputError
            If the policy does not follow a trajectory.
        """
        self._reference = reference_of(followed(policy, self.robot))
        if self._reference is None:
            raise InputError(
                f"policy has type {type(policy).__name__}, which does not follow a trajectory; "
                "give a "
                "GainSchedule or a TrajectoryFeedback"
            )
        Drawing(self.robot, self.meshcat["target"], "ghost")
        return self

    def show(self, q: Array, t: float | None = None) -> None:
        """Show the robot at a valid configuration (nq,), and the time t [s]."""
        q = self.robot.checked_configuration(q).copy()
        q.setflags(write=False)
        with self._lock:
            poses = body_poses(self.robot, self._data, q)
            inertia = self._state_map.project(inertia_at(self.robot, q))
            scale = np.sqrt(np.diag(inertia))
            state = {
                "time": None if t is None else float(t),
                "poses": poses.round(7).tolist(),
                "joints": [self.robot.joint(each["name"]).value(q) for each in self._joints],
                "coupling": (inertia / np.outer(scale, scale)).round(4).ravel().tolist(),
            }
            if self._reference is not None and t is not None:
                ghost = body_poses(self.robot, self._data, self._reference(float(t))[0])
                state["ghost"] = ghost.round(7).tolist()
            self.q = q
        self._server.update(json.dumps(state))

    def __call__(self, t: float, q: Array, *_: Any) -> None:
        """Show a step of a running simulation, delayed to the playback speed."""
        now = monotonic()
        if self._began is None or t <= self._began[1]:
            self._began = now, t
        sleep(max(0.0, self._began[0] + (t - self._began[1]) / self._speed - now))
        self.show(q, t)

    def open(self) -> None:
        """Open the page in a browser."""
        import webbrowser

        webbrowser.open(self.url)

    def wait(self) -> None:
        """Wait until the viewer is closed, or until Ctrl-C."""
        self._server.wait()

    def close(self) -> None:
        """Close the viewer; the page then reports the lost connection."""
        self._server.close()

    def __enter__(self) -> Live:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _forward(self, command: bytes) -> None:
        # What is drawn before there is a server waits in the recorder.
        if hasattr(self, "_server"):
            self._server.send(command)

    def _asked(self, message: Any) -> None:
        """Execute a browser's request: {"joints": {name: value}}, {"neutral": _}, {"random": _}."""
        q = self.q.copy()
        if message.get("neutral"):
            q[7:] = self.robot.neutral()[7:]
        limits = {each["name"]: each for each in self._joints}
        wanted = dict(message.get("joints", {}))
        if message.get("random"):
            rng = np.random.default_rng()
            wanted = {name: rng.uniform(x["low"], x["high"]) for name, x in limits.items()}
        for name, value in wanted.items():
            self.robot.joint(name).place(q, float(value))
        self.robot.follow(q)
        self.show(q)


def _joints(robot: Robot) -> list[dict[str, Any]]:
    """Return name and range of the slider of every joint except wheels."""
    model = robot.model
    found = []
    for joint in robot.joints:
        if joint.name in robot.wheels:
            continue
        low, high = -np.pi, np.pi
        if not joint.unbounded:
            low = max(
                float(model.lowerPositionLimit[joint.idx_q]), -1.0 if joint.prismatic else -np.pi
            )
            high = min(
                float(model.upperPositionLimit[joint.idx_q]), 1.0 if joint.prismatic else np.pi
            )
            if not low < high:
                low, high = low - 1.0, low + 1.0
        found.append({"name": joint.name, "low": low, "high": high, "length": joint.prismatic})
    return found
