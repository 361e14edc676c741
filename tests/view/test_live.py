"""The live page: only of this machine, ends with its process, keeps up, and moves as told."""

import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.base import html
from fflin.robot.joints import ROOT
from tests.support.browser import Watched
from tests.support.cards import Parsed
from tests.support.messages import any_wording
from tests.support.patience import STALL, finishing, wait_until


@pytest.fixture
def live(robots):
    with fflin.visualize(robots["ets_vii"], open=False) as live:
        yield live


def websocket(live, origin=None, host=None):
    from tornado.httpclient import HTTPRequest
    from tornado.websocket import websocket_connect

    headers = {"Origin": origin or live.url.rstrip("/")}
    if host:
        headers["Host"] = host
    url = live.url.replace("http", "ws") + "socket"
    return websocket_connect(HTTPRequest(url, headers=headers))


def run(coroutine):
    """Run a coroutine in a thread, since the loop of the browser's driver occupies this one."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(asyncio.run, coroutine).result()


async def received(connection):
    """Return the next message, or None when the connection is closed."""
    try:
        return await asyncio.wait_for(connection.read_message(), STALL)
    except asyncio.TimeoutError:
        pytest.fail(f"{STALL:g} s brought no message of the server")


async def state(connection):
    """Return the next state, past the commands that build the scene."""
    while True:
        message = await received(connection)
        assert message is not None
        if isinstance(message, str):
            return json.loads(message)


def addresses():
    """This machine's addresses other than loopback."""
    with (
        contextlib.suppress(OSError),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe,
    ):
        probe.connect(("192.0.2.1", 9))  # sends nothing
        yield probe.getsockname()[0]
    yield "127.0.0.2"


def test_it_is_reached_by_loopback_alone(live):
    assert live.url == f"http://127.0.0.1:{live.port}/"
    with urllib.request.urlopen(live.url) as answer:
        assert b"<title>ets_vii</title>" in answer.read()
    for address in addresses():
        with pytest.raises(OSError):
            socket.create_connection((address, live.port), 1.0).close()


def test_pages_of_other_sites_get_nothing(live):
    request = urllib.request.Request(live.url, headers={"Host": "evil.example"})
    with pytest.raises(urllib.error.HTTPError, match="403") as caught:
        urllib.request.urlopen(request)
    caught.value.close()  # it has the connection

    async def refused(**fields):
        from tornado.httpclient import HTTPClientError

        with pytest.raises(HTTPClientError, match="403"):
            await websocket(live, **fields)

    run(refused(origin="http://evil.example"))
    run(refused(host="evil.example"))


@pytest.mark.exhaustive
def test_it_survives_a_thousand_reconnects(live):
    def count():
        return len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0

    async def reconnect():
        for index in range(1000):
            connection = await websocket(live)
            if index % 100 == 0:
                assert len((await state(connection))["poses"]) == 7
            connection.close()
            while await received(connection) is not None:
                pass

    before = count()
    run(reconnect())
    wait_until(lambda: not live._clients, "the end of the last connection")
    assert count() <= before + 5
    with urllib.request.urlopen(live.url) as answer:
        assert answer.status == 200


def test_it_sends_where_the_robot_is_and_takes_the_sliders(live, robots):
    robot = robots["ets_vii"]

    async def play():
        connection = await websocket(live)
        first = await state(connection)
        await connection.write_message(json.dumps({"joints": {"joint_2": 0.7}}))
        second = await state(connection)
        for nonsense in (
            "",
            "{",
            "[]",
            '{"joints": {"none": 1}}',
            '{"joints": {"joint_2": "x"}}',
        ):
            await connection.write_message(nonsense)
        await connection.write_message(json.dumps({"neutral": True}))
        third = await state(connection)
        connection.close()
        while await received(connection) is not None:
            pass
        return first, second, third

    first, second, third = run(play())
    assert first["joints"] == third["joints"] == [0.0] * 6
    np.testing.assert_allclose(second["joints"], [0, 0.7, 0, 0, 0, 0])
    q = fflin.configuration(robot, {"joint_2": 0.7})
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    for pose, placement in zip(second["poses"], list(data.oMi)[ROOT:], strict=True):
        assert pin.XYZQUATToSE3(np.array(pose)).isApprox(placement, 1e-6)
    inertia = fflin.linearize(robot, q).M
    scale = np.sqrt(np.diag(inertia))
    coupling = np.reshape(second["coupling"], inertia.shape)
    np.testing.assert_allclose(coupling, inertia / np.outer(scale, scale), atol=1e-4)


@pytest.mark.parametrize("opening", ["[", '{"joints":', '{"joints": {"joint_2": ['])
def test_too_deeply_nested_data_close_only_their_connection(opening, live, caplog):
    async def play():
        connection, other = await websocket(live), await websocket(live)
        await connection.write_message(opening * 100_000)
        while await received(connection) is not None:
            pass
        await state(other)
        # passed over
        await other.write_message(json.dumps({"joints": {"joint_2": 10**400}}))
        await other.write_message(json.dumps({"joints": {"joint_2": 0.5}}))
        after = await state(other)
        for item in (connection, other):
            item.close()
        while await received(other) is not None:
            pass
        return connection.close_code, connection.close_reason, after

    code, reason, after = run(play())
    assert (code, reason) == (1008, "nested too deep")
    assert after["joints"][1] == 0.5
    assert not caplog.records


def test_a_running_simulation_is_shown_as_it_runs(robots):
    robot = robots["planar_detumble"]
    v = fflin.velocity(robot, {"omega_b.z": 0.3})
    seen = []
    with fflin.visualize(robot, open=False, speed=4.0) as live:
        show = live.show
        live.show = lambda q, t: (
            seen.append((t, q.copy(), time.monotonic())),
            show(q, t),
        )
        begun = time.monotonic()
        motion = fflin.simulate(robot, v0=v, duration=2.0, callback=live)
        assert json.loads(live._state)["time"] == pytest.approx(2.0)
    assert [t for t, _, _ in seen] == motion.t.tolist()
    assert (np.array([q for _, q, _ in seen]) == motion.q).all()
    for t, _, when in seen:  # a quarter of a second for each second
        assert when - begun > t / 4.0 - 1e-6
    with pytest.raises(fflin.InputError, match="speed"):
        fflin.visualize(robot, open=False, speed=0)


@pytest.mark.exhaustive
def test_a_slow_browser_gets_the_newest_state_and_not_all(live, robots):
    """What waits for one that reads nothing stays small, and ends with the last state."""
    robot = robots["ets_vii"]
    q = robot.neutral()
    with socket.create_connection(("127.0.0.1", live.port)) as slow:
        host = f"127.0.0.1:{live.port}"
        lines = ["GET /socket HTTP/1.1", f"Host: {host}", f"Origin: http://{host}"]
        lines += [
            "Connection: Upgrade",
            "Upgrade: websocket",
            "Sec-WebSocket-Version: 13",
        ]
        lines += ["Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "", ""]
        slow.sendall("\r\n".join(lines).encode())
        wait_until(lambda: live._clients, "the connection")
        last = 20_000
        for k in range(last + 1):
            live.show(q, k)
        total = last * len(live._state)
        slow.settimeout(STALL)
        final = live._state.encode()
        assert json.loads(final)["time"] == last
        received, tail = 0, b""
        while tail != final:
            chunk = slow.recv(2**20)
            assert chunk, "it ended before the last state"
            received += len(chunk)
            tail = (tail + chunk)[-len(final) :]
    assert received < total / 2


def test_an_occupied_port_is_one_line(live, robots):
    with any_wording(), pytest.raises(fflin.InputError, match=f"{live.port}"):
        fflin.visualize(robots["ets_vii"], open=False, port=live.port)
    for port in (-1, 65536, "8000", True):
        with pytest.raises(fflin.InputError, match="port"):
            fflin.visualize(robots["ets_vii"], open=False, port=port)


def test_it_ends_with_close_and_leaves_no_thread(robots):
    before = threading.active_count()
    live = fflin.visualize(robots["cubesat"], open=False)
    live.close()
    live.close()
    assert threading.active_count() == before
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.1", live.port), 1.0).close()
    live.show(robots["cubesat"].neutral())  # nobody watches


PROGRAM = """
import fflin
live = fflin.visualize(fflin.load("cubesat"), open=False)
server = live._thread
join = server.join
def say_that_it_waits(*seconds):
    server.join = join
    print(live.port, flush=True)
    join(*seconds)
server.join = say_that_it_waits
live.wait()
"""


@pytest.mark.process
@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_nothing_is_left_when_its_process_is_killed(ending):
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    with finishing(process):
        port = int(process.stdout.readline())
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as answer:
            assert answer.status == 200
        process.send_signal(ending)
        out, error = process.communicate()
    if ending == signal.SIGINT:  # Ctrl-C is the way to end it
        assert (process.returncode, out, error) == (0, "", "")
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.1", port), 1.0).close()
    with pytest.raises(ProcessLookupError):  # nobody of its session is left
        os.killpg(process.pid, 0)


@pytest.mark.browser
def test_the_page_follows_in_a_browser(live, robots, browser):
    robot = robots["ets_vii"]
    with Watched(browser, live.url, size=(960, 600), painted=True) as watched:
        watched.wait("fflin.state !== null")
        assert watched.page.locator("#panel input[type=range]").count() == robot.n
        still = watched.picture()
        slider = watched.page.locator("#panel input[type=range]").nth(1)
        assert slider.bounding_box()["width"] > 80  # enough to aim with
        slider.fill("1.25")
        watched.wait("fflin.state.joints[1] === 1.25")
        assert live.robot.joint("joint_2").value(live.q) == pytest.approx(1.25)
        q = fflin.configuration(robot, {"joint_1": 0.3, "joint_4": -0.5})
        live(0.25, q)
        watched.wait("fflin.state.time === 0.25")
        data = robot.model.createData()
        pin.forwardKinematics(robot.model, data, q)
        for name, placement in zip(
            list(robot.model.names)[ROOT:], data.oMi[ROOT:], strict=True
        ):
            pose = watched.pose(["meshcat", "robot", name])
            assert pin.XYZQUATToSE3(np.array(pose)).isApprox(placement, 1e-6)
        moved = watched.picture()
        assert (np.abs(moved - still).max(axis=2) > 30).mean() > 1e-3
        assert not watched.errors
        host = live.url.rstrip("/").partition("://")[2]
        assert all(url.partition("://")[2].startswith(host) for url in watched.requests)
        live.close()
        watched.page.wait_for_selector("#problem:not([hidden])")
        watched.errors.clear()  # of the connection that is gone


def test_a_notebook_shows_the_address_and_the_page_of_a_local_kernel(live, monkeypatch):
    for name in html._REMOTE:
        monkeypatch.delenv(name, raising=False)
    assert repr(live) == f"Live('ets_vii', {live.url})"
    local = Parsed(live._repr_html_())
    (frame,) = local.frames
    assert frame["src"] == live.url and live.url in local.text
    monkeypatch.setenv("SSH_CONNECTION", "192.0.2.1 50000 192.0.2.2 22")
    remote = Parsed(live._repr_html_())
    assert not remote.frames and live.url in remote.text
    assert "on the machine of this kernel" in remote.text
