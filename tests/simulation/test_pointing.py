"""Pointing errors of motions that are known in closed form."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

import fflin
from fflin.base.errors import InputError


@pytest.fixture(scope="module")
def flown():
    """Return a robot, its law and a settled motion."""
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(), fflin.BaseForce()])
    lin = fflin.linearize(robot)
    law = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    spin = fflin.velocity(robot, {"omega_b.z": 0.05})
    return fflin.simulate(robot, law, v0=spin, duration=100.0, dt=0.1)


def turned(flown, angles, t):
    """Return a motion whose base is turned about z by angles [rad] at times t [s]."""
    rows = len(t)
    x = np.zeros((rows, flown.x.shape[1]))
    x[:, 2] = np.sin(0.5 * angles)
    repeated = {
        name: np.repeat(getattr(flown, name)[:1], rows, axis=0)
        for name in ("q", "v", "u", "momentum")
    }
    single = {name: np.zeros(rows) for name in ("energy", "momentum_drift")}
    return replace(
        flown,
        t=t,
        x=x,
        target=np.zeros(x.shape[1]),
        prediction=np.zeros((0, x.shape[1])),
        com_drift=np.zeros(0),
        **repeated,
        **single,
    )


def test_errors_of_an_oscillation_about_an_offset(flown):
    t = np.linspace(0.0, 40.0, 8001)
    offset, size, period = np.radians([0.3, 0.1, 2.0])
    period = 2.0
    motion = turned(flown, offset + size * np.sin(2.0 * np.pi * t / period), t)
    found = motion.pointing(period, after=0.0)
    for column in (2, 3):
        assert found.absolute.largest[column] == pytest.approx(0.4, rel=1e-6)
        assert found.mean.largest[column] == pytest.approx(0.3, rel=1e-6)
        assert found.relative.largest[column] == pytest.approx(0.1, rel=1e-5)
        assert found.relative.rms[column] == pytest.approx(0.1 / 2**0.5, rel=2e-3)
        assert found.drift.largest[column] < 1e-6
    assert found.absolute.rms[2] == pytest.approx(np.hypot(0.3, 0.1 / 2**0.5), rel=1e-4)
    # A sine is below sin(level * pi / 2) of its size in the share `level` of the time.
    level = 0.3 + 0.1 * np.sin(np.pi * (0.95 - 0.5))
    assert found.absolute.p95[2] == pytest.approx(level, rel=1e-4)
    assert np.all(found.absolute.largest[:2] == 0.0)


def test_errors_of_a_ramp(flown):
    # Rows at irregular times: means must not depend on them.
    rng = np.random.default_rng(0)
    t = np.unique(np.concatenate(((0.0, 30.0), rng.uniform(0.0, 30.0, 3000))))
    rate = np.radians(0.02)
    found = turned(flown, rate * t, t).pointing(4.0, after=0.0, apart=7.0)
    assert found.drift.largest[2] == pytest.approx(0.02 * 7.0, rel=1e-9)
    assert found.drift.rms[3] == pytest.approx(0.02 * 7.0, rel=1e-9)
    assert found.relative.largest[2] == pytest.approx(0.02 * 2.0, rel=1e-9)
    assert found.mean.largest[2] == pytest.approx(0.02 * 28.0, rel=1e-3)
    late = turned(flown, rate * t, t).pointing(4.0)
    assert late.after == 15.0
    assert turned(flown, rate * t, t).pointing(4.0, after=20.0).drift.largest.max() > 0
    short = turned(flown, rate * t, t).pointing(4.0, after=24.0)
    assert short.drift is None


def _not_exceeded(sizes, durations, level):
    """Return the smallest size that is not exceeded in a fraction of the time, exactly."""
    weights = [round(duration * 2**60) for duration in durations.tolist()]
    least = Fraction(level) * (1 - Fraction(1, 10**9)) * sum(weights)
    lasting = 0
    for row in np.argsort(sizes):
        lasting += weights[row]
        if lasting >= least:
            return sizes[row]
    raise AssertionError


@pytest.mark.parametrize("regular", [True, False])
def test_relative_errors_follow_their_definition_window_by_window(flown, regular):
    rng = np.random.default_rng(3)
    # With 21 rows in each of 20 windows, 95 % of the time end exactly at one of the sizes.
    steps = np.full(40, 0.25) if regular else rng.uniform(0.1, 0.4, 40)
    t = np.concatenate(([0.0], np.cumsum(steps)))
    window = 5.0
    rotations = np.zeros((41, 3))
    rotations[:, 2] = rng.normal(size=41)
    motion = turned(flown, np.radians(rotations[:, 2]), t)
    found = motion.pointing(window, after=0.0).relative
    starts = t[t <= t[-1] - window]
    lasting = np.gradient(starts, edge_order=1)
    lasting[[0, -1]] *= 0.5
    sizes, durations = list[float](), list[float]()
    for start, length in zip(starts, lasting, strict=True):
        end = start + window
        times = np.unique((*t[(t >= start) & (t <= end)], end))
        mean = np.trapezoid(np.interp(times, t, rotations[:, 2]), times) / window
        rows = np.flatnonzero((t >= start - 1e-9) & (t <= end + 1e-9))
        sizes += [*np.abs(rotations[rows, 2] - mean)]
        of_rows = np.gradient(t[rows], edge_order=1)
        of_rows[[0, -1]] *= 0.5
        durations += [*(length * of_rows / of_rows.sum())]
    sizes, durations = np.array(sizes), np.array(durations)
    near = {"rel": 1e-12}
    assert found.largest[2] == pytest.approx(sizes.max(), **near)
    rms = np.sqrt(durations @ sizes**2 / durations.sum())
    assert found.rms[2] == pytest.approx(rms, **near)
    for values, level in ((found.p95, "0.95"), (found.p997, "0.997")):
        expected = _not_exceeded(sizes, durations, level)
        assert values[2] == pytest.approx(expected, **near)
        assert values[3] == pytest.approx(expected, **near)


def test_a_window_shorter_than_a_step_is_refused(flown):
    t = np.linspace(0.0, 10.0, 101)
    motion = turned(flown, np.radians(np.sin(t)), t)
    with pytest.raises(
        InputError, match=r"window is 0\.05 s, but rows .* 0\.1 s apart"
    ):
        motion.pointing(0.05)
    # In a window of one step, the error differs from its mean by half of its change.
    found = motion.pointing(0.1, after=0.0)
    change = np.abs(np.diff(np.sin(t))).max()
    assert found.relative.largest[2] == pytest.approx(0.5 * change, rel=1e-9)


def test_a_line_of_sight_is_judged_by_its_own_angle(flown):
    t = np.linspace(0.0, 10.0, 101)
    motion = turned(flown, np.full(101, np.radians(3.0)), t)
    along = motion.pointing(1.0, line_of_sight=(0.0, 0.0, 2.0))
    across = motion.pointing(1.0, line_of_sight=(1.0, 0.0, 0.0))
    between = motion.pointing(1.0, line_of_sight=(1.0, 0.0, 1.0))
    assert along.axes == ("line of sight",) and along.absolute.largest[0] == 0.0
    assert across.absolute.largest[0] == pytest.approx(3.0, rel=1e-12)
    slanted = 2.0 * np.arcsin(np.sin(np.radians(1.5)) / 2**0.5)
    assert between.absolute.largest[0] == pytest.approx(np.degrees(slanted), rel=1e-12)


def test_the_settling_time_is_that_after_which_the_error_stays_small(flown):
    t = np.linspace(0.0, 50.0, 2501)
    angles = np.radians(5.0) * np.exp(-0.2 * t)
    motion = turned(flown, angles, t)
    found = motion.pointing(5.0, accuracy=0.1)
    assert found.settled == pytest.approx(5.0 * np.log(50.0), abs=0.02)
    assert found.after == found.settled
    assert motion.pointing(5.0, accuracy=1e-9).settled is None
    # It must stay for at least a window.
    assert motion.pointing(40.0, accuracy=0.1, after=0.0).settled is None
    late = replace(motion, x=motion.x[::-1])
    assert late.pointing(5.0, accuracy=0.1).settled is None


def test_pointing_of_a_flown_motion_agrees_with_its_attitude_error(flown):
    found = flown.pointing(10.0, after=0.0)
    assert found.absolute.largest[3] == pytest.approx(flown.attitude_error.max())
    text = str(found)
    assert "absolute" in text and "angle" in text
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.exhaustive
def test_wheels_report_the_used_fractions_of_their_limits():
    robot = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    design = robot.replace(
        inputs=[item for item in robot.inputs if isinstance(item, fflin.ReactionWheel)]
    )
    lin = fflin.linearize(design)
    law = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    q0 = fflin.configuration(design, base=None)
    q0[3:7] = (0.0, 0.0, np.sin(0.05), np.cos(0.05))
    motion = fflin.simulate(design, law, q0=q0, duration=60.0)
    found = motion.pointing(5.0)
    assert found.torque_used and all(0 <= x <= 1 for x in found.torque_used.values())
    limits = dict(zip(motion.limit_names, motion.limits[:, 1], strict=True))
    column = {name: i for i, name in enumerate(motion.input_names)}
    for wheel, share in found.torque_used.items():
        name = next(name for name in column if name.endswith(wheel))
        expected = np.abs(motion.u[:, column[name]]).max() / limits[name]
        assert share == pytest.approx(expected)


def test_a_line_of_sight_that_moves_on_a_cone_is_unsteady(flown):
    """A constant angle from the target, whose direction turns: all of it is relative error."""
    t = np.linspace(0.0, 40.0, 4001)
    motion = turned(flown, np.zeros(4001), t)
    x = motion.x.copy()
    half = np.sin(np.radians(0.5))
    x[:, 0] = half * np.cos(2.0 * np.pi * t / 5.0)
    x[:, 1] = half * np.sin(2.0 * np.pi * t / 5.0)
    cone = replace(motion, x=x)
    result = cone.pointing(10.0, after=0.0, line_of_sight=(0, 0, 1))
    assert result.absolute.largest[0] == pytest.approx(1.0, rel=1e-9)
    assert result.mean.largest[0] < 1e-3
    assert result.relative.rms[0] == pytest.approx(1.0, rel=1e-3)
    whole = cone.pointing(10.0, after=0.0)
    assert whole.relative.rms[3] == pytest.approx(1.0, rel=1e-3)


def test_statistics_are_over_time_and_not_over_rows(flown):
    early, late = np.linspace(0.0, 20.0, 2001), np.linspace(20.1, 40.0, 200)
    t = np.concatenate((early, late))
    angles = np.radians(np.where(t <= 20.0, 4.0, 2.0))
    result = turned(flown, angles, t).pointing(1.0, after=0.0)
    assert result.absolute.rms[2] == pytest.approx(
        np.sqrt((16.0 + 4.0) / 2.0), rel=5e-3
    )
    assert result.absolute.p95[2] == pytest.approx(4.0)
    fine = turned(flown, np.radians(0.1 * t), t).pointing(1.0, after=0.0)
    assert fine.absolute.p95[2] == pytest.approx(0.1 * 38.0, rel=5e-3)


@pytest.mark.exhaustive
def test_long_windows_of_many_rows_need_little_memory(flown):
    t = np.linspace(0.0, 4000.0, 200_001)
    motion = turned(flown, np.radians(np.sin(t)), t)
    result = motion.pointing(1000.0, after=-1e9)
    assert result.after == 0.0 and result.relative.rms[2] == pytest.approx(
        0.707, rel=1e-2
    )


def test_wrong_arguments_are_refused(flown):
    with pytest.raises(fflin.InputError, match="window is 0 s, expected more than 0"):
        flown.pointing(0.0)
    with pytest.raises(fflin.InputError, match="only 50 s of the motion follow 50 s"):
        flown.pointing(60.0)
    with pytest.raises(fflin.InputError, match="line_of_sight is zero"):
        flown.pointing(1.0, line_of_sight=(0, 0, 0))
    free = fflin.simulate(fflin.load("cubesat"), duration=1.0)
    with pytest.raises(fflin.InputError, match="the motion has no target"):
        free.pointing(0.1)
