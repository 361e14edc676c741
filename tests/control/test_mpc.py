"""Model predictive control: the regulator where no limit is near, and the best within limits."""

import sys

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import linprog, nnls

import fflin
from fflin.control import mpc as predictive
from fflin.control.mpc import Receding, condensed
from fflin.simulation.report import motion_report
from tests.support.messages import says

pytest.importorskip("daqp")
piqp = pytest.importorskip("piqp")

WEIGHTS = (
    {"q_b": 0.05, "r_b": 0.1, "q_m": 0.1},
    {"tau_b": 20.0, "F_b": 20.0, "tau_m": 5.0},
)
# The base may be turned harder than the joints can bear.
WEAK = {"tau_b": 60.0, "F_b": 20.0, "tau_m": 1.0}


def weights(lin):
    return [fflin.bryson(lin, weight) for weight in WEIGHTS]


def turned(robot, degrees):
    turn = pin.AngleAxis(np.radians(degrees), np.array([1.0, 0.0, 0.0])).matrix()
    return fflin.configuration(robot, None, pin.SE3(turn, np.zeros(3)))


@pytest.fixture(scope="module")
def servicer():
    robot = fflin.load("servicer_7dof")
    return robot, fflin.linearize(robot)


@pytest.fixture(scope="module")
def planned():
    """A servicer that slows its tumble, with springs, and the models along that."""
    robot = fflin.load("planar_detumble", damping="urdf", stiffness={"joint_1": 0.5})
    v0 = fflin.velocity(robot, {"omega_b.y": 0.1, "joint_1": -0.05})
    goal = fflin.configuration(robot, {"joint_2": 0.5})
    motion = fflin.plan(
        robot, (goal, None), 20.0, v0=v0, knots=21, limits={"qdot_m": 0.3}
    )
    return robot, fflin.linearize_trajectory(robot, motion)


def exactly(m):
    """The solution of a program with its soft limits hard, by another method, and its prices."""
    solver = piqp.DenseSolver()
    for name in ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"):
        setattr(solver.settings, name, 1e-11)
    # Scaled, as its method asks for.
    size = m.H.diagonal() ** -0.5
    G = m.G * size
    rows = np.linalg.norm(G, axis=1)
    none = np.zeros((0, len(size)))
    solver.setup(
        *(size[:, None] * m.H * size, m.g * size, none, np.zeros(0)),
        *(G / rows[:, None], m.low / rows, m.high / rows),
    )
    assert solver.solve() == piqp.PIQP_SOLVED
    return solver.result.x * size


def planned_by(policy, e, t=0.0):
    """All deviations of the inputs that a controller plans."""
    ahead = Receding(policy.horizon, None)
    first = ahead.step(t, e)
    stages = policy.horizon.window(t)
    z, flag = ahead._solved(ahead._free @ e)
    _, to_d, _ = condensed(stages, planned=False)
    size = len(z)
    d = np.linalg.solve(to_d[:, :size], z - to_d[:, size:] @ e)
    assert flag > 0 and d[: len(first)] == pytest.approx(
        first, abs=1e-9 * np.abs(d).max()
    )
    return d


@pytest.mark.parametrize("name", ["servicer_7dof", "cubesat", "planar_detumble"])
@pytest.mark.parametrize("given", [True, False])
def test_without_limits_it_is_the_regulator(name, given):
    robot = fflin.load(name, stiffness=3.0, damping=0.3)
    lin = fflin.linearize(robot)
    cost = (1.0, 2.0) if given else (None, None)
    policy = fflin.mpc(lin, *cost, horizon=7, dt=0.1, limits=None)
    sampled = lin.discretize(0.1)
    gain = fflin.lqr(sampled, *(fflin.sampled_cost(lin, 0.1, *cost) if given else ()))
    e = np.random.default_rng(1).normal(size=len(lin.x0))
    m = policy.matrices(e)
    first = np.linalg.solve(m.H, -m.g)[: len(lin.u0)]
    assert first == pytest.approx(-gain.K @ e, abs=1e-10 * np.abs(gain.K @ e).max())
    assert Receding(policy.horizon, None).step(0.0, e) == pytest.approx(
        -gain.K @ e, rel=1e-10
    )


@pytest.mark.parametrize("Qf", ["steady", 30.0])
def test_the_matrices_are_cost_and_prediction(servicer, Qf):
    """Of any inputs: the sum over the samples of the model, term by term."""
    _, lin = servicer
    Q, R = weights(lin)
    policy = fflin.mpc(
        lin, Q, R, horizon=5, dt=0.2, limits={"tau_m": 9.0, "q_m": 0.3}, Qf=Qf
    )
    rng, sampled = np.random.default_rng(2), lin.discretize(0.2)
    start, (Qd, Rd, Nd) = rng.normal(size=30), fflin.sampled_cost(lin, 0.2, Q, R)
    end = fflin.lqr(sampled, Qd, Rd, Nd).P if Qf == "steady" else Qf * np.eye(30)
    m = policy.matrices(start)

    def cost(d):
        e, total = start, 0.0
        for k, u in enumerate(d.reshape(5, -1)):
            total += e @ Qd @ e + 2.0 * e @ Nd @ u + u @ Rd @ u
            e = sampled.A @ e + sampled.B @ u
            rows = (m.G @ d).reshape(5, -1)[k]
            assert rows[:9] == pytest.approx(u[6:]) and rows[9:] + (
                m.Phi[k + 1] @ start
            )[6:15] == pytest.approx(e[6:15])
            assert m.Phi[k + 1] @ start + m.Gamma[k + 1] @ d == pytest.approx(e)
        return total + e @ end @ e

    none, d = np.zeros(75), rng.normal(size=75)
    assert cost(d) - cost(none) == pytest.approx(0.5 * d @ m.H @ d + m.g @ d, rel=1e-9)
    assert m.inputs[15] == "tau_b.x[1]" and m.limits[9] == "q_m.joint_1[0]"
    assert m.soft.reshape(5, -1)[0].tolist() == [False] * 9 + [True] * 9
    assert (m.high[:9] == 9.0).all() and m.low[9:18] == pytest.approx(
        -0.3 - (m.Phi[1] @ start)[6:15]
    )


@pytest.mark.parametrize("size", [0.05, 0.3, 0.8])
def test_within_limits_it_is_the_best(servicer, size):
    """As another solver has it, and by the conditions of optimality: what the limits that are met
    push back with, all outwards, balances the slope of the cost."""
    _, lin = servicer
    policy = fflin.mpc(
        lin,
        *weights(lin),
        horizon=15,
        dt=0.2,
        limits=["urdf", {"tau_b": 40.0, "tau_m": 9.0}],
    )
    e = np.zeros(30)
    e[:3], e[6:13] = (
        size * np.array([0.25, -0.2, 0.3]),
        size * np.array([8, -6, 7, -9, 5, 4, -3]) / 10,
    )
    m, d = policy.matrices(e), planned_by(policy, e)
    best, G, unit = exactly(m), m.G @ d, np.linalg.norm(m.G, axis=1)
    assert d == pytest.approx(best, abs=1e-6 * np.abs(best).max())
    assert (np.maximum(m.low - G, G - m.high) <= 1e-7 * unit * np.abs(d).max()).all()
    met = [(G >= m.high - 1e-7 * unit), (G <= m.low + 1e-7 * unit)]
    outwards = np.vstack((m.G[met[0]], -m.G[met[1]])).T
    assert outwards.shape[1] > (0 if size > 0.1 else -1)
    slope, scale = m.H @ d + m.g, m.H.diagonal() ** -0.5
    left = (
        nnls(scale[:, None] * outwards, -scale * slope)[1]
        if outwards.size
        else np.abs(slope).max()
    )
    assert left <= 1e-6 * np.abs(scale * m.g).max()


def test_an_infeasible_limit_is_violated_by_the_least(servicer):
    """From a speed beyond its limit, with torques that take samples to slow it down."""
    _, lin = servicer
    limits = {
        "tau_b": 40.0,
        "F_b": 20.0,
        "tau_m": 2.0,
        "qdot_m.joint_1": 0.1,
        "qdot_m.joint_2": 0.1,
    }
    policy = fflin.mpc(lin, *weights(lin), horizon=12, dt=0.1, limits=limits)
    e = np.zeros(30)
    e[21:23] = 0.4, -0.3
    m, d = policy.matrices(e), planned_by(policy, e)
    excess = np.maximum(np.maximum(m.low - m.G @ d, m.G @ d - m.high), 0.0)
    assert excess[m.soft].max() > 0.1 and excess[~m.soft].max() < 1e-9 * 40.0
    # What is passed counts by what it takes to mend it, the norm of its row in z.
    _, to_d, _ = condensed(policy.horizon.window(0.0), planned=False)
    price = 1.0 / np.linalg.norm(m.G @ np.linalg.inv(to_d[:, : len(d)]), axis=1)[m.soft]
    slack = np.eye(len(m.soft))[:, m.soft]
    rows = np.vstack((np.hstack((m.G, -slack)), np.hstack((-m.G, -slack))))
    least = linprog(
        np.concatenate((np.zeros(len(d)), price)),
        *(rows, np.concatenate((m.high, -m.low))),
        bounds=[(None, None)] * len(d) + [(0, None)] * len(price),
    )
    assert price @ excess[m.soft] == pytest.approx(least.fun, rel=0.02)
    ahead = Receding(policy.horizon, None)
    ahead.step(0.0, e)
    assert says(ahead.notes[0], "each of 12 samples of 0.1 s: 1", "qdot_m.joint")


def test_violations_of_the_robot_are_reported_even_if_no_plan_has_them(servicer):
    """Far from the point the inertia is another, and rates pass their limit."""
    robot, lin = servicer
    rates = np.flatnonzero([name.startswith("qdot_m") for name in lin.state_names])
    for far, passes in ((0.3, False), (1.0, True)):
        policy = fflin.mpc(lin, dt=0.1, limits={"qdot_m": 0.1})
        x0 = np.zeros(30)
        x0[6:15] = far * (-1.0) ** np.arange(9)
        motion = fflin.simulate(robot, policy, x0=x0, duration=20.0, dt=0.02)
        sampled = np.abs(motion.x[5::5, rates])
        over = (sampled > 0.1 + 2e-4).any(axis=1)
        assert over.any() == passes == ("robot" in motion.notes[0])
        if passes:
            assert f"exceeds a soft limit: {over[:-1].sum()} (" in motion.notes[0]
            at = motion.t[5::5][sampled[:-1].max(axis=1).argmax()]
            largest = f" by {sampled[:-1].max() - 0.1:.2g} at {at:.4g} s"
            assert largest in motion.notes[0]


def test_the_worst_violation_is_the_largest_relative_to_the_range_of_its_limit(
    servicer,
):
    _, lin = servicer
    limits = {"qdot_m.joint_1": 0.1, "qdot_m.joint_2": 1.0}
    ahead = Receding(fflin.mpc(lin, dt=0.1, limits=limits).horizon, None)
    e = np.zeros(30)
    ahead.step(0.0, e)
    e[21:23] = 0.3, 1.5  # beyond by 100 % and by 25 % of the ranges
    ahead.step(0.1, e)
    assert "(worst: qdot_m.joint_1 by 0.2 at 0.1 s)" in ahead.notes[0]


def test_an_output_that_the_inputs_act_on_exceeds_its_limit_by_its_value(servicer):
    """At the end of a sample, y = C e + D d with the inputs d of this sample."""
    robot = servicer[0].replace(stiffness=10.0, outputs=[fflin.Accelerometer("base")])
    lin = fflin.linearize(robot)
    name, limit = lin.output_names[0], 1e-3
    ahead = Receding(fflin.mpc(lin, dt=0.1, limits={name: limit}).horizon, None)
    start, end = np.zeros((2, 30))
    start[3] = -0.1
    d = ahead.step(0.0, start)
    by_inputs = lin.D[0] @ d
    end[6:15] = lin.C[0, 6:15] * by_inputs / (lin.C[0, 6:15] @ lin.C[0, 6:15])
    ahead.step(0.1, end)
    excess = abs(lin.C[0] @ end + by_inputs) - limit
    assert abs(by_inputs) > 0.5 * limit
    assert f"(worst: {name} by {excess:.2g} at 0.1 s)" in ahead.notes[0]


@pytest.mark.exhaustive
def test_slews_that_break_the_regulator_are_held(servicer):
    """The base turns hard while the joints are weak: under the regulator arm and panels swing
    beyond their travels, and it has not settled after a minute; the controller turns no harder than
    they can follow, and passes nothing."""
    robot, lin = servicer
    limits = ["urdf", WEAK]
    policy = fflin.mpc(lin, *weights(lin), horizon=20, dt=0.25, limits=limits)
    regulator = fflin.StateFeedback(policy.lin, policy.gain.K)
    options = {
        "q0": turned(robot, 90.0),
        "duration": 60.0,
        "dt": 0.05,
        "limits": limits,
    }
    flown, swung = (
        fflin.simulate(robot, item, **options) for item in (policy, regulator)
    )
    beyond = {item.name for item in swung.passed}
    assert (
        beyond > {"q_m.panel_left", "q_m.panel_right", "q_m.joint_3"}
        and not flown.passed
    )
    assert flown.attitude_error[-1] < 2.0 and swung.attitude_error[-1] > 10.0
    joints = [np.abs(item.error[:, 6:15]).max(axis=0) for item in (flown, swung)]
    assert joints[0].max() < 0.5 and joints[1].max() > 3.0 and flown.saturated
    assert says(flown.notes[-1], "each of 20 samples of 0.25 s: 240")
    assert says(motion_report(flown), "each of 20 samples of 0.25 s: 240")
    # The same again, to the last bit.
    again = fflin.simulate(robot, policy, **options)
    assert (again.u == flown.u).all() and (again.q == flown.q).all()


def test_where_it_begins_the_search_changes_nothing(servicer):
    _, lin = servicer
    policy = fflin.mpc(lin, *weights(lin), horizon=20, dt=0.25, limits=["urdf", WEAK])
    e, warm = np.zeros(30), Receding(policy.horizon, None)
    e[:3] = 0.3, -0.24, 0.32
    for k in range(40):
        d = warm.step(0.25 * k, e)
        assert d == pytest.approx(
            Receding(policy.horizon, None).step(0.25 * k, e), abs=1e-6
        )
        e = policy.lin.A @ e + policy.lin.B @ d


@pytest.mark.exhaustive
def test_along_a_trajectory_without_limits_it_is_the_schedule(planned):
    robot, along = planned
    policy = fflin.mpc(along, horizon=6, dt=0.5, limits=None)
    schedule = fflin.tvlqr(along, sample=0.5)
    e = 0.1 * np.random.default_rng(3).normal(size=18)
    for t in (0.0, 7.5, 18.5, 19.5, 25.0):
        m = policy.matrices(e, t)
        K = schedule.gain(t) if t < 20.0 else policy.end_gain
        first = np.linalg.solve(m.H, -m.g)[:9]
        assert first == pytest.approx(-K @ e, abs=1e-9 * np.abs(K @ e).max())
    q0, v0 = policy.beside({"pitch": 3.0, "q_m": 0.05})
    options = {"q0": q0, "v0": v0, "duration": 21.0, "dt": 0.1}
    one, other = (fflin.simulate(robot, item, **options) for item in (policy, schedule))
    assert one.q == pytest.approx(other.q, abs=1e-9) and one.tracked
    assert one.prediction == pytest.approx(other.prediction, abs=1e-9)


@pytest.mark.exhaustive
def test_along_a_trajectory_it_keeps_within_limits(planned):
    """Of the values themselves: of u = u* + d, of joints and rates about those that are planned."""
    robot, along = planned
    state = fflin.StateMap(robot, frame="local")
    q_m, most = (
        state.joint_positions(along.q)[:, 1],
        np.abs(along.u_base).reshape(-1, 3, 3),
    )
    limits = dict(
        zip(("tau_b", "F_b", "tau_m"), 1.1 * most.max(axis=(0, 2)), strict=True)
    )
    limits |= {"q_m.joint_2": (q_m.min() - 0.02, q_m.max() + 0.02)}
    limits |= {"qdot_m": 1.1 * np.abs(along.v[:, 6:]).max()}
    policy = fflin.mpc(along, horizon=8, dt=0.5, limits=limits)
    q0, v0 = policy.beside({"pitch": 4.0, "q_m.joint_2": 0.01, "r_b.x": 0.1})
    options = {"q0": q0, "v0": v0, "duration": 30.0, "limits": limits, "dt": 0.05}
    flown, cut = (
        fflin.simulate(robot, item, **options) for item in (policy, policy.schedule)
    )
    assert not flown.passed and flown.saturated and flown.attitude_error[-1] < 0.2
    assert "qdot_m.joint_2" in {item.name for item in cut.passed}
    joint = robot.joint_names.index("joint_2")
    for t in (0.0, 3.0, 18.5):
        e = np.zeros(18)
        e[1], e[7] = 0.03, 0.01
        d = planned_by(policy, e, t)
        assert d == pytest.approx(
            exactly(policy.matrices(e, t)), abs=1e-6 * np.abs(d).max()
        )
        m, reference = policy.matrices(np.zeros(18), t), along.point(t)
        assert m.high[:9] + reference[2] == pytest.approx(
            np.repeat(list(limits.values())[:3], 3)
        )
        later = along.point(min(t + 0.5, 20.0))
        row = m.limits.index("q_m.joint_2[0]")
        at = state.joint_positions(later[0])[joint]
        assert m.high[row] + at == pytest.approx(limits["q_m.joint_2"][1])


def test_outputs_have_limits_by_name(servicer):
    """The tool keeps above a plane, by the model's C: absolute, about y0."""
    robot, _ = servicer
    seen = robot.replace(outputs=[fflin.FramePose("tool"), fflin.FullState()])
    lin = fflin.linearize(seen)
    name = next(
        x for x in lin.output_names if x.endswith("position.x") or x.endswith("r.x")
    )
    row = lin.output_names.index(name)
    low = lin.y0[row] - 0.01
    policy = fflin.mpc(
        lin, *weights(lin), dt=0.25, limits=["urdf", {name: (low, 1e3), "q_m": 1.0}]
    )
    m = policy.matrices()
    assert f"{name}[0]" in m.limits and "q_m.joint_1[0]" in m.limits
    first = m.limits.index(f"{name}[0]")
    assert m.G[first] == pytest.approx(lin.C[row] @ m.Gamma[1])
    assert m.low[first] == pytest.approx(-0.01)
    e = np.zeros(30)
    e[6:13] = 0.1
    d, m = planned_by(policy, e), policy.matrices(e)
    tool = np.array(
        [lin.C[row] @ (m.Phi[k] @ e + m.Gamma[k] @ d) for k in range(1, 21)]
    )
    free = np.array(
        [
            lin.C[row] @ np.linalg.matrix_power(policy.gain.closed_loop, k) @ e
            for k in range(1, 21)
        ]
    )
    assert tool.min() >= -0.01 - 1e-9 or free.min() >= -0.01


def test_thrusters_do_not_pull_and_motors_may_have_failed():
    robot = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    lin = fflin.linearize(robot)
    policy = fflin.mpc(lin, 1.0, 1.0, horizon=10, dt=0.5, limits=None)
    e = np.zeros(len(lin.x0))
    e[:6] = 0.1
    thrust = [i for i, unit in enumerate(lin.input_units) if unit == "N"]
    d = Receding(policy.horizon, None).step(0.0, e)
    assert (d[thrust] >= 0.0).all() and (d[thrust] > 0.0).any()
    wheels = fflin.mpc(
        lin, 1.0, 1.0, horizon=10, dt=0.5, limits={"thrust": 0.01, "wheel_x": 0.0}
    )
    u = planned_by(wheels, e).reshape(10, -1)
    assert np.abs(u[:, lin.input_names.index("wheel_x")]).max() < 1e-12
    assert u[:, thrust].min() > -1e-9 and u[:, thrust].max() == pytest.approx(0.01)


@pytest.mark.exhaustive
def test_a_part_of_the_states_and_allocated_inputs_will_do():
    robot = fflin.load("servicer_7dof")
    arm = robot.replace(inputs=[fflin.JointTorque(name) for name in robot.joint_names])
    part = fflin.momentum_reduction(fflin.linearize(arm))
    policy, q0 = fflin.mpc(part, dt=0.2), fflin.configuration(arm, {"joint_2": 0.3})
    motion = fflin.simulate(arm, policy, q0=q0, duration=20.0, limits="urdf")
    assert np.abs(motion.error[-1, 6:15]).max() < 0.05 and not motion.passed
    cubesat = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    wheels = [item for item in cubesat.inputs if isinstance(item, fflin.ReactionWheel)]
    bounded = [fflin.BaseTorque(max=0.05), fflin.BaseForce(max=0.05), *wheels]
    design = cubesat.replace(inputs=bounded)
    policy = fflin.Allocation(fflin.mpc(fflin.linearize(design), dt=0.5), design)
    motion = fflin.simulate(cubesat, policy, x0=0.05 * np.ones(18), duration=60.0)
    assert motion.attitude_error[0] > 9.0 and motion.attitude_error[-1] < 0.01


@pytest.mark.compiled
def test_campaigns_fly_it_and_the_compiled_loop_says_why_not(servicer):
    robot, lin = servicer
    policy = fflin.mpc(lin, *weights(lin), horizon=8, dt=0.25, limits=["urdf", WEAK])
    options = {"duration": 2.0, "dt": 0.05, "limits": ["urdf", WEAK]}
    campaign = fflin.monte_carlo(
        robot, policy, {"q_b": 0.05, "*.mass": 0.05}, runs=3, **options
    )
    again = campaign.replay(1)
    assert len(campaign) == 3 and "each of 8 samples of 0.25 s: 8" in again.notes[-1]
    with pytest.raises(fflin.InputError, match="Mpc"):
        fflin.simulate(robot, policy, engine="compiled", **options)
    with pytest.raises(fflin.InputError, match="`sample`"):
        fflin.simulate(robot, policy, sample=0.5, **options)
    with pytest.raises(fflin.InputError, match="linear"):
        fflin.simulate(robot, policy, linear=True, **options)


def test_a_plan_that_is_not_found_is_reported_and_not_applied(servicer, monkeypatch):
    robot, lin = servicer
    limits = ["urdf", WEAK]
    policy = fflin.mpc(lin, *weights(lin), dt=0.25, limits=limits)
    monkeypatch.setattr(predictive, "_MOST", 1)
    with pytest.warns(fflin.FflinWarning, match="DAQP") as message:
        options = {"q0": turned(robot, 60.0), "duration": 1.0, "limits": limits}
        flown = fflin.simulate(robot, policy, **options)
    assert len(message) == 1
    regulator = fflin.StateFeedback(policy.lin, policy.gain.K)
    cut = fflin.simulate(robot, regulator, **options)
    assert flown.u[0] == pytest.approx(cut.u[0], rel=1e-9, abs=1e-12)
    assert "LQR command" in flown.notes[-1]


@pytest.mark.exhaustive
def test_unsupported_uses_are_refused_in_one_line(
    servicer, planned, monkeypatch, tmp_path
):
    robot, lin = servicer
    _, along = planned
    weighed = weights(lin)
    wrong = {
        "no input or state named 'tau_x'": {"limits": {"tau_x": 1.0}},
        "limit of 'tau_b' is": {"limits": {"tau_b": (1.0, -1.0)}},
        "horizon is 0": {"horizon": 0},
        "horizon is 1000000 samples": {"horizon": 1_000_000},
        "sample is missing": {"dt": None},
        "dt is -1 s": {"dt": -1.0},
        "the point exceeds the limits of q_m.joint_1": {
            "limits": {"q_m.joint_1": (0.1, 0.2)}
        },
        "the point exceeds the limits of tau_b.x": {"limits": {"tau_b": (0.1, 0.2)}},
        "Qf is 'nosuch'": {"Qf": "nosuch"},
        "limits is 'nosuch'": {"limits": "nosuch"},
        "both Q and R": {"R": None},
    }
    for message, given in wrong.items():
        with pytest.raises(fflin.FflinError, match=message):
            fflin.mpc(lin, **{"Q": weighed[0], "R": weighed[1], "dt": 0.1} | given)
    sampled = lin.discretize(0.1)
    assert fflin.mpc(sampled, *weighed).lin.dt == 0.1
    lin.save(tmp_path / "model.npz")
    for message, source, dt in (
        ("sampled", sampled, 0.2),
        ("sampled", along.discretize(0.5), 0.5),
        ("dict", {}, 0.1),
        ("file", fflin.LinearModel.load(tmp_path / "model.npz"), 0.1),
        ("moving", fflin.linearize(robot, moving=True), 0.1),
        ("0.3 s", along, 0.3),
    ):
        with pytest.raises(fflin.InputError, match=message):
            fflin.mpc(source, 1.0, 1.0, dt=dt)
    policy = fflin.mpc(lin, *weighed, dt=0.1)
    with pytest.raises(fflin.InputError, match=r"\(3,\)"):
        policy.matrices(np.zeros(3))
    with pytest.raises(fflin.InputError, match="'ets_vii'"):
        fflin.simulate(fflin.load("ets_vii"), policy, duration=1.0)
    monkeypatch.setitem(sys.modules, "daqp", None)
    with pytest.raises(fflin.MissingPackageError, match=r"'fflin\[mpc\]'"):
        fflin.simulate(robot, policy, duration=1.0)


def test_it_prints_how_much_is_limited(servicer):
    robot, lin = servicer
    model = fflin.linearize(robot.replace(outputs=[fflin.FramePose("tool")]))
    limits = ["urdf", {"tau_b": 60.0, "q_b": 0.2, model.output_names[0]: (-9.0, 9.5)}]
    policy = fflin.mpc(model, dt=0.25, limits=limits)
    assert repr(policy) == "Mpc('servicer_7dof', 20 samples of 0.25 s, 34 limits)"
    assert str(fflin.mpc(lin, dt=0.25, limits=None)).endswith("0 limits)")


@pytest.mark.exhaustive
def test_it_prints_how_much_is_limited_along_a_trajectory(planned):
    along = planned[-1]
    follows = fflin.mpc(along, dt=0.25, horizon=4, limits={"tau_b": 80.0, "q_b": 0.2})
    head = f"TrajectoryMpc('{along.robot.name}', 4 samples of 0.25 s, 6 limits)"
    assert repr(follows) == head


def test_a_joint_that_has_a_torque_means_that(servicer):
    _, lin = servicer
    assert fflin.mpc(lin, dt=0.25, limits={"joint_2": 0.7}).horizon.limited == (
        "tau_m.joint_2",
    )
    assert fflin.mpc(lin, dt=0.25, limits={"q_m.joint_2": 0.7}).horizon.limited == (
        "q_m.joint_2",
    )
