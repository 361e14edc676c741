"""A motion that goes on through a capture and a jam: one record of all of it."""

from dataclasses import replace

import numpy as np
import pytest

import fflin
from tests.support.messages import says
from tests.support.phases import DEBRIS, TWIST, phases


@pytest.fixture(scope="module")
def flown():
    return phases()


def test_the_rows_match_the_phases_one_after_the_other(flown):
    robot, approach, _, held, _, after, whole = flown
    assert whole.phases == (
        "servicer_7dof",
        "payload of 500 kg caught",
        "joint_3 jammed",
    )
    assert whole.starts == pytest.approx([0.0, 4.0, 10.0])
    ends = np.cumsum([len(item.t) for item in (approach, held, after)])
    assert len(whole.t) == ends[-1] and whole.t[-1] == pytest.approx(13.0)
    assert (np.diff(whole.t) >= 0.0).all()
    assert (whole.q[: ends[0]] == approach.q).all() and (
        whole.q[ends[0] : ends[1]] == held.q
    ).all()
    # In the chart of the first phase, whose reference is another than that of the second.
    assert not held.reference.isApprox(whole.reference, 1e-3)
    state = fflin.StateMap(robot, reference=whole.reference)
    for k in (10, ends[0] + 7, ends[1] + 3):
        assert whole.x[k] == pytest.approx(
            state.to_state(whole.q[k], whole.v[k]), abs=1e-14
        )
    # A joint that jammed stands still, without a torque.
    column = robot.joint_names.index("joint_3")
    assert (
        np.ptp(whole.x[ends[1] :, 6 + column]),
        *np.abs(whole.u[ends[1] :, 6 + column]),
    ) == (*(0.0,) * (1 + len(after.t)),)
    assert whole.x[ends[1], 6 + column] == pytest.approx(
        held.x[-1, 6 + column], abs=1e-12
    )


def test_forces_are_turned_into_the_axes_of_the_first_phase(flown):
    *_, held, _, _, whole = flown
    k = len(flown.approach.t) + 20
    force, expected_value = (
        item.reference.rotation @ item.u[row, 3:6]
        for item, row in ((whole, k), (held, 20))
    )
    assert np.abs(expected_value).max() > 1e-3 and force == pytest.approx(
        expected_value, abs=1e-14
    )


def test_errors_are_counted_from_the_target_of_each_phase(flown):
    whole = flown.whole
    rows = np.cumsum(
        [0, *(len(item.t) for item in (flown.approach, flown.held, flown.after))]
    )
    for k, part in enumerate((flown.approach, flown.held, flown.after)):
        errors = whole.attitude_error[rows[k] : rows[k + 1]]
        assert errors == pytest.approx(part.attitude_error, abs=1e-9)


def test_momentum_and_energy_across_the_phases(flown):
    """What is lost of energy is what the impacts say, and no momentum."""
    _, approach, caught, held, jammed, _, whole = flown
    for impact in (caught, jammed):
        size = np.abs(impact.momentum).max()
        assert np.abs(impact.momentum - impact.momentum_after).max() < 1e-13 * size
    # Of the combined robot, before and after the joint jams, row to row.
    k = len(approach.t) + len(held.t)
    assert whole.momentum[k] == pytest.approx(whole.momentum[k - 1], rel=1e-12)
    assert whole.energy[k - 1] - whole.energy[k] == pytest.approx(
        jammed.energy_lost, rel=1e-6
    )
    came = 0.5 * caught.payload_v @ DEBRIS.matrix() @ caught.payload_v
    lost = approach.energy[-1] + came - held.energy[0]
    assert lost == pytest.approx(caught.energy_lost, rel=1e-9)
    message = str(whole)
    assert says(message, "4 s: payload of 500 kg")
    assert says(message, "10 s: joint_3 jammed", "N m s")
    assert says(message, "not settled")
    assert max(map(len, message.splitlines())) <= 80


def test_the_table_has_energy_and_momentum_at_both_ends_of_each_phase(flown):
    """And what of all together there was just before an impact, beside what there is after."""
    whole = flown.whole
    lines = str(whole).splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("phase "))
    assert lines[first].split() == [
        "phase",
        "t",
        "[s]",
        "energy",
        "[J]",
        "|p|",
        "[N",
        "s]",
        "|h|",
        "[N",
        "m",
        "s]",
    ]
    rows = [line.split()[-5:] for line in lines[first + 1 : first + 9]]
    assert [row[0] for row in rows] == ["start", "end", *("before", "after", "end") * 2]
    assert [float(row[1]) for row in rows] == [
        0.0,
        4.0,
        4.0,
        4.0,
        10.0,
        10.0,
        10.0,
        13.0,
    ]
    ends = np.cumsum(
        [len(item.t) for item in (flown.approach, flown.held, flown.after)]
    )
    for row, k in (
        (0, 0),
        (1, ends[0] - 1),
        (3, ends[0]),
        (4, ends[1] - 1),
        (7, ends[2] - 1),
    ):
        errors = (
            whole.energy[k],
            *(
                np.linalg.norm(whole.momentum[k, part])
                for part in ([3, 4, 5], [0, 1, 2])
            ),
        )
        assert [*map(float, rows[row][2:])] == pytest.approx(errors, rel=1e-3), row
    for before, impact in ((2, flown.caught), (5, flown.jammed)):
        assert rows[before][3:] == rows[before + 1][3:]
        lost = float(rows[before][2]) - float(rows[before + 1][2])
        assert lost == pytest.approx(
            impact.energy_lost, abs=2e-3 * float(rows[before][2])
        )
    # The robot alone had another momentum than it has with what it caught.
    assert rows[1][3:] != rows[2][3:]
    # What the momentum before has, the momenta of both impacts tell, not the motion.
    object.__setattr__(
        changed := replace(flown.caught), "momentum", 2.0 * flown.caught.momentum
    )
    other = str(flown.approach.then(changed, flown.held)).splitlines()
    at = next(k for k, line in enumerate(other) if " before " in line)
    assert other[at].split()[-2:] != other[at + 1].split()[-2:]


def test_it_is_saved_and_drawn(flown, tmp_path):
    whole = flown.whole
    for ending in (".npz", ".mat", ".json"):
        whole.save(tmp_path / f"whole{ending}")
        read = fflin.Motion.load(tmp_path / f"whole{ending}")
        assert read.phases == whole.phases and (read.starts == whole.starts).all()
        assert (read.x == whole.x).all()
    figure = whole.plot()
    marks = [
        x.get_xdata()[0] for x in figure.axes[0].get_lines() if x.get_label() == "_rest"
    ]
    assert {*marks} == {4.0, 10.0}
    with pytest.raises(fflin.InputError, match="robot"):
        read.then(flown.held)


def test_it_goes_on_step_by_step_and_under_another_policy(flown):
    robot, approach, caught, held, jammed, after, whole = flown
    again = approach.then(caught, held).then(jammed, after)
    assert (again.x == whole.x).all() and again.notes == whole.notes
    free = fflin.simulate(
        robot, None, q0=approach.q[-1], v0=approach.v[-1], duration=1.0
    )
    both = approach.then(free)
    assert both.phases == ("servicer_7dof", "servicer_7dof") and not both.target.size
    # A joint that goes limp makes no impact; the other motors go on as they did.
    limp, end = (
        robot.replace(passive=["joint_3"]),
        {"q0": approach.q[-1], "v0": approach.v[-1]},
    )
    lin = fflin.linearize(limp, end["q0"])
    K = fflin.line_up(fflin.lqr(fflin.linearize(robot, end["q0"])), lin)
    on = fflin.simulate(limp, fflin.StateFeedback(lin, K), **end, duration=1.0)
    both = approach.then(on)
    assert not both.u[-1, 8] and (both.u[-1, [6, 7]] == on.u[-1, [6, 7]]).all()


def test_a_file_that_cannot_be_continued_gives_a_one_line_error(flown):
    robot, approach, caught, held, jammed, after, whole = flown
    away = fflin.capture(robot, "tool", DEBRIS)
    turned = fflin.simulate(
        robot, None, q0=approach.q[-1], v0=approach.v[-1], duration=0.1, frame="world"
    )
    pushed = robot.replace(
        inputs=[*robot.inputs, fflin.Thruster("base", (0, 0, 0), (1, 0, 0), "jet")]
    )
    pushed = fflin.simulate(
        pushed, None, q0=approach.q[-1], v0=approach.v[-1], duration=0.1
    )
    for call, message in [
        (approach.then, "no later phase is given"),
        (lambda: approach.then(caught), "last phase"),
        (lambda: approach.then(3), "Motion"),
        (lambda: approach.then(away, held), "begin"),
        (lambda: approach.then(caught, after), "'joint_3 jammed'|caught'"),
        (lambda: approach.then(held), "begin"),
        (lambda: approach.then(jammed, after), "begin"),
        (lambda: approach.then(turned), "'world'"),
        (lambda: approach.then(pushed), "jet"),
        (whole.trajectory, "several phases"),
    ]:
        with pytest.raises(fflin.InputError, match=message) as error:
            call()
        assert "\n" not in str(error.value)


def test_in_orbit_phases_keep_momentum_and_their_frame():
    orbit = fflin.CircularOrbit(altitude=700e3)
    robot = fflin.load("servicer_7dof", lock=["panel_*"], orbit=orbit)
    q = fflin.configuration(robot, {"joint_2": 0.6, "joint_4": -1.2})
    v = fflin.velocity(robot, {"joint_3": 0.02, "omega_b.y": 0.01})
    first = fflin.simulate(robot, None, q0=q, v0=v, duration=1.0)
    end = {"q": first.q[-1], "v": first.v[-1]}
    caught = fflin.capture(robot, "tool", DEBRIS, **end, payload_v=TWIST)
    assert caught.robot.orbit == caught.payload.orbit == orbit
    jammed = fflin.jam(caught.robot, "joint_3", q=caught.q, v=caught.v)
    for impact in (caught, jammed):
        assert impact.robot.orbit == orbit and impact.energy_lost > 0.0
        size = np.abs(impact.momentum).max()
        assert np.abs(impact.momentum - impact.momentum_after).max() < 1e-13 * size
    start = {"q0": caught.q, "v0": caught.v, "duration": 1.0}
    held = fflin.simulate(caught.robot, None, **start)
    whole = first.then(caught, held)
    assert whole.orbit == orbit and whole.frame == "lvlh" and not len(whole.com_drift)
    with pytest.raises(fflin.InputError, match="'hill'"):
        first.then(caught, fflin.simulate(caught.robot, None, **start, frame="hill"))
    still = fflin.simulate(caught.robot.replace(orbit=None), None, **start)
    with pytest.raises(fflin.InputError, match="'hybrid'"):
        first.then(caught, still)
    with pytest.raises(fflin.InputError, match=r"orbit.*None"):
        fflin.capture(robot, "tool", fflin.load("ets_vii"))
