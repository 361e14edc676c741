"""A motion by knots: what holds, what does not and why, and files of other programs."""

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.io import savemat

import fflin
from tests.support.messages import says
from tests.support.motions import motion


def arrays(along):
    return along.t, along.q, along.v, along.u


@pytest.fixture(scope="module")
def loop():
    """A loop around a robot with continuous joints, from a state off its point."""
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    x0 = 0.1 * np.random.default_rng(0).normal(size=len(lin.x0))
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)

    def run(**options):
        return fflin.simulate(robot, policy, x0=x0, duration=2.0, dt=0.01, **options)

    return robot, run


@pytest.mark.parametrize("knots", [3, 11, 101])
def test_one_step_of_torque_holds_at_every_spacing(knots):
    robot = fflin.load("planar_detumble")
    u = np.zeros((knots, 6 + robot.n))
    u[knots // 2 :, -1] = 0.02
    times = np.linspace(0.0, 2.0, knots)

    def policy(t, q, v):
        return u[min(int(t / times[1] + 1e-9), knots - 1)]

    run = fflin.simulate(
        *(robot, policy),
        duration=2.0,
        dt=0.005,
        sample=times[1],
        every=round(times[1] / 0.005),
    )
    held = fflin.Trajectory(robot, run.t, run.q, run.v, u[:-1], frame="hybrid")
    assert held.hold == "previous"
    assert held.residual.max() < 1e-8
    assert fflin.linearize_trajectory(robot, held, strict=True).A.shape == (
        knots,
        18,
        18,
    )
    # And only so: the step is no slope.
    assert replace(held, hold="linear").residual.max() > 1e-2


@pytest.mark.parametrize(
    ("options", "hold", "largest"),
    [
        ({}, "linear", 1e-4),
        ({"every": 5}, "linear", 2.5e-3),
        ({"sample": 0.1}, "previous", 1e-8),
        ({"sample": 0.1, "every": 10}, "previous", 1e-8),
        ({"sample": 0.1, "every": 5, "delay": 0.05}, "previous", 1e-8),
        ({"sample": 0.4, "every": 40}, "previous", 1e-6),
    ],
)
def test_the_simulated_loop_holds_the_point(loop, options, hold, largest):
    """Held inputs to the integrator's order; of others the knots have what is linear between."""
    _, run = loop
    result = run(**options)
    along = result.trajectory()
    assert (along.hold, along.frame) == (hold, "hybrid")
    assert along.residual.max() < largest
    if hold == "linear":
        every = {"every": 2 * options.get("every", 1)}
        coarse = run(**every).trajectory().residual.max()
        assert coarse / along.residual.max() == pytest.approx(4.0, abs=0.8)


@pytest.mark.exhaustive
def test_axes_of_inputs_match_the_frame():
    robot = fflin.load("ets_vii")
    reference = pin.SE3(pin.rpy.rpyToMatrix(0.4, -0.2, 0.9), np.array([1.0, 2.0, 3.0]))
    v0 = fflin.velocity(robot, {"omega_b.x": 0.5, "omega_b.y": -0.3, "v_b.z": 0.1})
    u = np.r_[3.0, -2.0, 1.0, 5.0, -3.0, 2.0, 0.2 * np.ones(robot.n)]
    for frame in ("local", "hybrid", "world"):
        run = fflin.simulate(
            *(robot, lambda t, q, v: u),
            v0=v0,
            duration=2.0,
            dt=0.005,
            sample=0.5,
            every=50,
            frame=frame,
            reference=reference,
        )
        along = run.trajectory()
        assert along.residual.max() < 1e-8
        for other in {"local", "hybrid", "world"} - {frame}:
            assert replace(along, frame=other).residual.max() > 1e-3
        q, _, u_base = along.point(1.1)
        of_world = pin.Quaternion(q[3:7]).matrix() @ u_base[3:6]
        expected = reference.rotation @ u[3:6]
        if frame == "local":
            assert u_base == pytest.approx(u)
        else:
            assert of_world == pytest.approx(expected)


def test_knots_that_are_no_motion_say_where_how_many_and_the_usual_causes():
    robot = fflin.load("astrobee_arm")
    t, q, v, u = motion(robot)
    jump = v.copy()
    jump[40, 0] += 0.1
    given = fflin.Trajectory(robot, t, q, jump, u)
    with pytest.warns(fflin.FflinWarning, match="and 2 of 80 intervals") as result:
        along = fflin.linearize_trajectory(robot, given)
    message = str(result[0].message)
    k = int(given.interval_errors.argmax())
    assert k in (39, 40) and f"from t = {t[k]:g} to {t[k + 1]:g} s" in message
    assert (
        f"the error is {given.residual.max():.2g}" in message
        and "usual causes" in message
    )
    assert message in " ".join(str(given).split()) and message in " ".join(
        str(along).split()
    )


def test_intervals_are_integrated_once(monkeypatch):
    robot = fflin.load("astrobee_arm")
    t, q, v, u = motion(robot)
    given, ends = fflin.Trajectory(robot, t, q, v, 1.1 * u), []
    end = fflin.Trajectory.end
    monkeypatch.setattr(
        fflin.Trajectory, "end", lambda *item: ends.append(item[1]) or end(*item)
    )
    with pytest.warns(fflin.FflinWarning, match="not a motion"):
        along = fflin.linearize_trajectory(robot, given)
    count = len(ends)
    assert (
        "not a motion" in str(along)
        and "not a motion" in str(given)
        and len(ends) == count
    )
    assert 80 <= count <= 8 * 80


@pytest.mark.parametrize(
    ("name", "row", "value", "where"),
    [
        ("v", 20, 1e200, "at t = 0.1 s: v has an entry of 1e+200"),
        ("v", 20, 1e45, "from t = 0.1 to 0.105 s the integration overflows"),
        ("u", 20, 1e200, "from t = 0.095 to 0.1 s the integration overflows"),
        ("t", 80, 1e300, "from t = 0.395 to 1e+300 s the integration overflows"),
    ],
)
def test_an_overflow_is_refused_with_its_index(name, row, value, where, monkeypatch):
    robot = fflin.load("astrobee_arm")
    given = dict(zip("tqvu", map(np.array, motion(robot)), strict=True))
    given[name][row if name == "t" else (row, 2)] = value
    ends, end = [], fflin.Trajectory.end
    monkeypatch.setattr(
        fflin.Trajectory, "end", lambda *item: ends.append(item[1]) or end(*item)
    )
    with pytest.raises(fflin.InputError, match=re.escape(where)):
        fflin.linearize_trajectory(robot, *given.values())
    # An interval that overflows is left at once.
    assert len(ends) <= 8 * 80


def test_continuous_joints_may_be_angles(loop):
    robot, run = loop
    along = run(sample=0.1).trajectory()
    angles = fflin.StateMap(robot).joint_positions(along.q)
    narrow = np.column_stack((along.q[:, :7], angles))
    again = fflin.Trajectory(robot, along.t, narrow, along.v, along.u)
    assert again.q == pytest.approx(along.q, abs=1e-15)
    message = (
        r"q has shape \(201, 11\), expected \(201, 13\), or \(201, 10\) with one angle "
        r"for each continuous joint"
    )
    with pytest.raises(fflin.InputError, match=message):
        fflin.linearize_trajectory(robot, along.t, along.q[:, 2:], along.v, along.u)


def test_resampled_is_the_same_motion(loop):
    robot, run = loop
    along = run(sample=0.1, every=10).trajectory()
    fine = along.resampled(0.05)
    assert (fine.hold, fine.frame, len(fine.t)) == ("previous", "hybrid", 41)
    assert (fine.u[::2] == along.u).all()
    assert (fine.u[1::2] == along.u[:-1]).all()
    assert fine.q[::2] == pytest.approx(along.q, abs=1e-15)
    assert fine.residual.max() < 1e-3  # what the cubics miss
    expected = run(sample=0.1, every=5)
    apart = [
        pin.difference(robot.model, *pair)
        for pair in zip(fine.q, expected.q, strict=True)
    ]
    assert np.abs(apart).max() < 1e-5
    uneven = along.resampled(0.3)
    assert uneven.t == pytest.approx([0.0, 0.3, 0.6, 0.9, 1.2, 1.5, 1.8, 2.0])
    for dt in (0.0, -1.0, 1e-12, "x"):
        with pytest.raises(fflin.InputError, match="dt"):
            along.resampled(dt)


def test_a_fast_wheel_turns_between_knots():
    wheel = fflin.ReactionWheel((0, 0, 1), inertia=0.001)
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(), wheel])
    v0 = fflin.velocity(robot, {"wheel_1": 500.0})
    run = fflin.simulate(robot, v0=v0, duration=0.2, dt=0.001, every=20)
    # Not midway, where two turns more are one: the same angle.
    at = run.trajectory().point(0.025)[0]
    exact = fflin.simulate(robot, v0=v0, duration=0.025, dt=0.001).q[-1]
    assert np.abs(pin.difference(robot.model, at, exact)).max() < 1e-9


def test_points_between_knots_are_of_order_four():
    robot = fflin.load("astrobee_arm")
    t, q, v, u = motion(robot)
    assert np.abs(v[:, 3:6]).max() > 0.1  # the base rotates

    def missed(every):
        along = fflin.Trajectory(robot, *(item[::every] for item in (t, q, v, u)))
        midway = range(every // 2, len(t), every)
        apart = [
            pin.difference(robot.model, along.point(t[k])[0], q[k]) for k in midway
        ]
        return np.abs(apart).max(axis=0)

    assert np.log2(missed(16) / missed(8)) == pytest.approx(
        np.full(robot.nv, 4.0), abs=0.5
    )


def test_a_bad_interval_is_reported_at_both_its_knots(loop):
    _, run = loop
    along = run(sample=0.1, every=10).trajectory()
    u = along.u.copy()
    u[7, 2] += 10.0 * np.abs(u).max()
    assert np.flatnonzero(replace(along, u=u).residual > 1e-6).tolist() == [7, 8]


@pytest.mark.parametrize("ending", ["npz", "mat", "json", "csv"])
def test_saved_results_are_read_bit_for_bit(loop, tmp_path, ending):
    robot, run = loop
    along = run(sample=0.1, every=10).trajectory()
    along.save(tmp_path / f"a.{ending}")
    again = fflin.Trajectory.load(tmp_path / f"a.{ending}", robot)
    for name in ("t", "q", "v", "u"):
        assert (getattr(again, name) == getattr(along, name)).all()
    assert (again.hold, again.frame) == ("previous", "hybrid")
    assert again.verified and "not verified" not in str(again)


def test_a_changed_csv_is_refused_and_one_of_another_program_is_not_verified(
    loop, tmp_path
):
    robot, run = loop
    path = tmp_path / "a.csv"
    along = run(sample=0.1, every=10).trajectory()
    along.save(path)
    lines = path.read_text().splitlines()
    header, rows = lines[0].split(","), [line.split(",") for line in lines[1:]]
    assert header[-1] == "sha256" and {len(row[-1]) for row in rows} == {64}

    def load(*table):
        path.write_text("\n".join(map(",".join, table)) + "\n")
        return fflin.Trajectory.load(path, robot)

    assert load(header, *rows).verified
    row, at = rows[3], header.index("v[8]")
    changed = [*row[:at], repr(2.0 * float(row[at])), *row[at + 1 :]]
    swapped = [*header[:at], header[at + 1], header[at], *header[at + 2 :]]
    refused = r"a\.csv.*does not match its sha256.*delete the column sha256"
    for table in (
        (header, *rows[:3], changed, *rows[4:]),
        (header, *rows[:3], [*row[:-1], ""], *rows[4:]),
        (header, *rows[:-1]),
        (header,),
        (swapped, *rows),
    ):
        with pytest.raises(fflin.FileError, match=refused):
            load(*table)
    foreign = load(*(item[:-1] for item in (header, *rows[:3], changed, *rows[4:])))
    assert "not verified" in str(foreign) and foreign.v[3, 8] == 2.0 * along.v[3, 8]
    foreign.save(path)
    assert "sha256" not in path.read_text()
    assert not fflin.Trajectory.load(path, robot).verified


def test_files_of_other_programs_are_read(loop, tmp_path):
    robot, run = loop
    result = run(sample=0.1, every=10)
    along = result.trajectory()
    state = fflin.StateMap(robot, frame="world")
    x = np.array([state.to_state(*item) for item in zip(along.q, along.v, strict=True)])
    turned = replace(along, frame="world", u=_of_world(along))

    # An input that does nothing may be left out.
    along, turned = (
        replace(item, u=item.u * (np.arange(9) != 7)) for item in (along, turned)
    )

    def same(path, **options):
        again = fflin.Trajectory.load(path, robot, **options)
        assert again.q == pytest.approx(along.q, abs=1e-12)
        assert again.v == pytest.approx(along.v, abs=1e-12)
        assert again.hold == "previous"
        assert again.u_base[:-1] == pytest.approx(along.u_base[:-1], abs=1e-12)
        assert not again.verified

    columns = {"t": along.t} | dict(zip(state.names, x.T, strict=True))
    acting = zip(result.input_names, turned.u.T, strict=True)
    columns |= {name: u for name, u in acting if name != "tau_m.joint_2"}
    path = tmp_path / "by_hand.csv"

    def write(columns, last=None):
        with path.open("w", newline="", encoding="utf-8-sig") as file:
            rows = [
                list(map(repr, map(float, row)))
                for row in zip(*columns.values(), strict=True)
            ]
            if last is not None:
                rows[-1][19:] = [last] * (len(columns) - 19)
            csv.writer(file).writerows([columns, *rows])

    write(columns, last="")
    same(path, frame="world")
    write(columns)
    same(path, frame="world", hold="previous")

    savemat(
        tmp_path / "a.mat", {"t": along.t, "x": x, "u": turned.u[:-1], "frame": "world"}
    )
    same(tmp_path / "a.mat")
    struct = {
        "t": along.t,
        "q": along.q,
        "v": along.v,
        "u": along.u_base,
        "hold": "previous",
    }
    savemat(tmp_path / "b.mat", {"traj": struct})
    same(tmp_path / "b.mat", frame="local")
    np.savez(tmp_path / "c.npz", t=along.t, q=along.q, v=along.v, u=along.u[:-1])
    same(tmp_path / "c.npz", frame="hybrid")
    plain = {"t": along.t, "x": x, "u": turned.u, "hold": "previous", "frame": "world"}
    lists = {
        name: x.tolist() if isinstance(x, np.ndarray) else x
        for name, x in plain.items()
    }
    (tmp_path / "d.json").write_text(json.dumps(lists))
    same(tmp_path / "d.json")

    result.save(tmp_path / "motion.npz")
    again = fflin.Trajectory.load(tmp_path / "motion.npz", robot, hold="previous")
    assert again.residual.max() < 1e-8
    with pytest.raises(fflin.InputError, match="file"):
        fflin.Motion.load(tmp_path / "motion.npz").trajectory()
    assert (
        fflin.Motion.load(tmp_path / "motion.npz").trajectory(robot).residual.max()
        < 1e-8
    )

    write(columns | {"tau_m.nosuch": along.t})
    with pytest.raises(fflin.UnknownNameError, match=r"by_hand\.csv.*'tau_m"):
        fflin.Trajectory.load(path, robot)
    write({name: x for name, x in columns.items() if name != "r_b.y"})
    with pytest.raises(fflin.UnknownNameError, match=r"'r_b\.y'"):
        fflin.Trajectory.load(path, robot)
    beside = columns["q_m.joint_2"].copy()
    beside[3] = np.nan
    write(columns | {"q_m.joint_2": beside})
    with pytest.raises(fflin.InputError, match=r"column q_m.joint_2\[3\] is nan"):
        fflin.Trajectory.load(path, robot)
    path.write_text(path.read_text().replace("nan", "much"))
    with pytest.raises(
        fflin.InputError, match=r"column q_m\.joint_2: .*'much'; expected"
    ):
        fflin.Trajectory.load(path, robot)
    path.write_text("t,tau_b.x\n1,2\n3\n")
    with pytest.raises(fflin.FileError, match="row 3"):
        fflin.Trajectory.load(path, robot)
    path.write_text("t,t\n1,2\n")
    with pytest.raises(fflin.FileError, match="columns"):
        fflin.Trajectory.load(path, robot)
    np.savez(tmp_path / "e.npz", t=along.t, u=along.u)
    with pytest.raises(fflin.FileError, match="t, u"):
        fflin.Trajectory.load(tmp_path / "e.npz", robot)
    with pytest.raises(fflin.FileError, match=r"\.npz"):
        fflin.Trajectory.load(tmp_path / "e.txt", robot)
    np.savez(tmp_path / "e.npz", t=along.t, x=x[:, 1:], u=along.u)
    with pytest.raises(fflin.InputError, match=r"\(21, 17\)"):
        fflin.Trajectory.load(tmp_path / "e.npz", robot)


def _of_world(along):
    """Inputs held in world axes that are, at the knots, those of the trajectory."""
    u = along.u_base.copy()
    for row, q in zip(u, along.q, strict=True):
        R = pin.Quaternion(q[3:7]).matrix()
        row[:3], row[3:6] = R @ row[:3], R @ row[3:6]
    return u


def test_rows_that_miss_the_samples_are_reported():
    robot = fflin.load("cubesat")
    options = {"duration": 2.0, "dt": 0.01, "sample": 0.1}
    run = fflin.simulate(robot, lambda t, q, v: np.zeros(6), every=7, **options)
    assert says(run.notes[0], "7 steps", "10")
    for every in (1, 2, 5, 10, 20):
        assert not fflin.simulate(
            robot, lambda t, q, v: np.zeros(6), every=every, **options
        ).notes


def test_a_base_that_turns_too_far_between_knots_is_reported():
    robot = fflin.load("cubesat")
    for speed, far in ((3.3, True), (2.0, False)):
        v0 = fflin.velocity(robot, {"omega_b.z": speed})
        spin = fflin.simulate(
            robot, v0=v0, duration=4.0, dt=0.01, every=100
        ).trajectory()
        assert ("the base rotates by 3.3 rad from t = 0 to 1 s" in str(spin)) == far


@pytest.mark.parametrize("name", ["hinge ", " hinge", "hinge\rof", "a\nb"])
def test_a_csv_with_odd_joint_names_is_read_back(name, tmp_path):
    model = pin.Model()
    root = model.addJoint(
        0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint"
    )
    model.appendBodyToJoint(root, pin.Inertia.Random(), pin.SE3.Identity())
    joint = model.addJoint(root, pin.JointModelRX(), pin.SE3.Identity(), name)
    model.appendBodyToJoint(joint, pin.Inertia.Random(), pin.SE3.Identity())
    robot = fflin.from_model(model)
    rows = [
        np.tile(x, (2, 1))
        for x in (robot.neutral(), np.zeros(robot.nv), np.arange(7.0))
    ]
    before = fflin.Trajectory(robot, [0.0, 1.0], *rows)
    before.save(tmp_path / "a.csv")
    after = fflin.Trajectory.load(tmp_path / "a.csv", robot)
    assert (after.u == before.u).all() and after.verified
