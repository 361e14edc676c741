"""Delayed commands in simulations: exact arrival times, default steps, laws and engines."""

import numpy as np
import pytest

import fflin
from tests.support.marks import exhaustive

H = 0.1  # sample time [s]


def satellite(inputs=None):
    """Return a rigid satellite and its model, a double integrator in each coordinate."""
    robot = fflin.load(
        "cubesat", inputs=inputs or [fflin.BaseTorque(), fflin.BaseForce()]
    )
    return robot, fflin.linearize(robot)


def commands_of(rows):
    """Return a policy that commands one of the rows after the other."""
    return lambda t, q, v: rows[round(t / H)]


def steps_of(model, commands):
    """Return the states (N + 1, nx) of the robot in a sampled model."""
    z = np.zeros(len(model.A))
    rows = [z]
    for u in commands:
        z = model.A @ z + model.B @ u
        rows.append(z)
    return np.array(rows)[:, : len(model.robot_states)]


@pytest.mark.parametrize(
    "delay", [0.03, 0.1, 0.27, {"tau_b": 0.15, "F_b": 0.27, "F_b.z": 0.0}]
)
def test_small_motions_are_those_of_the_sampled_model(delay):
    """Commands of 1e-10 N m give states below 1e-8, whose products are below rounding."""
    robot, lin = satellite()
    rng = np.random.default_rng(1)
    commands = 1e-10 * rng.normal(size=(30, 6))
    motion = fflin.simulate(
        robot, commands_of(commands), duration=3.0, sample=H, delay=delay
    )
    expected = steps_of(lin.discretize(H, delay), commands)
    at = np.arange(31) * round(H / motion.step)
    assert np.abs(expected).max() > 1e-10
    assert motion.x[at] == pytest.approx(expected, abs=1e-15)


def test_the_default_step_divides_all_delays():
    robot, _ = satellite()
    policy = commands_of(np.zeros((11, 6)))
    for delay, step in ((0.07, 0.01), ({"tau_b": 0.025, "F_b": 0.04}, 0.005)):
        motion = fflin.simulate(robot, policy, duration=1.0, sample=H, delay=delay)
        assert motion.step == pytest.approx(step)


def test_a_step_that_misses_the_arrivals_is_refused_with_the_nearest_one():
    robot, _ = satellite()
    policy = commands_of(np.zeros((11, 6)))
    settings = {"duration": 1.0, "sample": H, "dt": 0.02}
    with pytest.raises(fflin.InputError, match=r"the nearest step .* is dt=0\.0125 "):
        fflin.simulate(robot, policy, **settings, delay={"tau_b": 0.0125})
    with pytest.raises(fflin.InputError, match=r"nearest step .* is dt=0\.01 "):
        fflin.simulate(robot, policy, **settings, delay=0.07)
    irrational = 0.1 / np.pi
    with pytest.raises(fflin.InputError, match=r"the nearest delay .* is 0\.04 s"):
        fflin.simulate(robot, policy, **settings, delay=irrational)
    with pytest.raises(fflin.UnknownNameError, match="tau_c"):
        fflin.simulate(robot, policy, **settings, delay={"tau_c": 0.02})
    with pytest.raises(fflin.InputError, match="less than the duration"):
        fflin.simulate(robot, policy, **settings, delay={"tau_b": 1.0})


def test_one_delay_for_all_inputs_equals_equal_delays():
    robot, _ = satellite()
    rng = np.random.default_rng(2)
    policy = commands_of(1e-3 * rng.normal(size=(11, 6)))
    one, many = (
        fflin.simulate(robot, policy, duration=1.0, sample=H, delay=delay)
        for delay in (0.13, {"tau_b": 0.13, "F_b": 0.13})
    )
    assert (one.x == many.x).all() and (one.u == many.u).all()


def test_pulses_begin_when_their_command_arrives():
    """Thrusters with different delays fire at their own times."""
    thrusters = [
        fflin.Thruster(
            "base", (0, 0, 0), direction, name, max=1.0, on_off=True, least_impulse=1e-4
        )
        for name, direction in (("early", (1, 0, 0)), ("late", (0, 1, 0)))
    ]
    robot, _ = satellite(thrusters)
    motion = fflin.simulate(
        robot,
        lambda t, q, v: (0.5, 0.5) if t < 0.05 else (0.0, 0.0),
        duration=0.6,
        sample=H,
        delay={"late": 0.25},
    )
    early, late = (np.flatnonzero(motion.u[:-1, k]) for k in (0, 1))
    steps = round(H / motion.step)
    assert early.tolist() == list(range(steps // 2))
    assert late.tolist() == [k + round(0.25 / motion.step) for k in early]


def compensator(late):
    """Return the output feedback of a model with delayed inputs."""
    noise = {"tau_b": 1e-6, "F_b": 1e-6}
    estimator = fflin.kalman(late, noise, 1e-6, G=late.B)
    return fflin.OutputFeedback(late, fflin.lqg(fflin.lqr(late), estimator))


def state_feedback(late):
    """Return the state feedback of a model with delayed inputs."""
    return fflin.StateFeedback(late, fflin.lqr(late))


def integral_feedback(late):
    """Return the state feedback with integral action of a model with delayed inputs."""
    return fflin.StateFeedback(late, fflin.lqr(late, integral_action=["q_b"]))


DELAYS = [0.07, 0.1, {"tau_b": 0.15, "F_b": 0.27}]


@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("make", [compensator, state_feedback, integral_feedback])
def test_laws_of_a_delayed_model_fly_with_its_delay(make, delay):
    """From 1e-8, the nonlinear motion is that of the sampled linear loop."""
    robot, lin = satellite()
    late = lin.discretize(H, delay)
    law = make(late)
    loop, dt = law.closed_loop()
    assert dt == H
    assert np.abs(np.linalg.eigvals(loop)).max() < 1.0
    x0 = 1e-8 * np.random.default_rng(3).normal(size=12)
    motion = fflin.simulate(robot, law, x0=x0, duration=8.0)
    z = np.zeros(len(loop))
    z[:12] = x0
    for k in range(80):
        at = k * round(H / motion.step)
        assert motion.x[at] == pytest.approx(z[:12], abs=1e-14)
        z = loop @ z
    assert len(motion.prediction)
    assert motion.prediction == pytest.approx(motion.x, abs=1e-14)


@pytest.mark.compiled
@pytest.mark.parametrize("make", [compensator, state_feedback, integral_feedback])
def test_both_engines_fly_delayed_laws(make):
    robot, lin = satellite()
    law = make(lin.discretize(H, DELAYS[-1]))
    x0 = 0.1 * np.random.default_rng(4).normal(size=12)
    python, compiled = (
        fflin.simulate(robot, law, x0=x0, duration=5.0, engine=engine)
        for engine in ("python", "compiled")
    )
    assert compiled.x == pytest.approx(python.x, abs=1e-12)
    assert compiled.u == pytest.approx(python.u, abs=1e-12)


@pytest.mark.compiled
@pytest.mark.parametrize("make", [compensator, state_feedback])
def test_campaigns_fly_delayed_laws(make):
    """The drawn delay changes the delays of all inputs."""
    robot, lin = satellite()
    law = make(lin.discretize(H, DELAYS[-1]))
    spreads = {"q_b": 0.05, "delay": 0.03}
    campaigns = [
        fflin.monte_carlo(
            robot, law, spreads, runs=4, duration=3.0, seed=5, engine=engine
        )
        for engine in ("python", "compiled")
    ]
    one, other = (campaign.largest for campaign in campaigns)
    assert one == pytest.approx(other, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("make", [compensator, state_feedback])
def test_the_law_remembers_the_inputs_after_limits(make):
    """The motion is that of the sampled model, whose inputs and memory are clipped."""
    robot, lin = satellite()
    late = lin.discretize(H, 0.15)
    law = make(late)
    most = 1e-9
    x0 = 1e-8 * np.random.default_rng(6).normal(size=12)
    motion = fflin.simulate(robot, law, x0=x0, duration=4.0, limits=most)
    plant = np.append(x0, np.zeros(12))
    K = fflin.lqr(late).K
    terms = law.terms()
    z = np.zeros(len(terms.A))
    cut = 0
    for k in range(40):
        at = k * round(H / motion.step)
        assert motion.x[at] == pytest.approx(plant[:12], abs=1e-14)
        if make is state_feedback:
            commanded = -K @ plant
        else:
            commanded, z = terms.step(z, lambda _, x=plant: x[:12])
        u = np.clip(commanded, -most, most)
        cut += (u != commanded).sum()
        if make is compensator:
            known = law.compensator.state_names
            rows = [late.state_names.index(name) for name in known]
            z = z + late.B[rows] @ (u - commanded)
        plant = late.A @ plant + late.B @ u
    assert cut > 20


def test_allocated_commands_of_a_delayed_law():
    """Inputs in another order give the same motion."""
    design, _ = satellite()
    pushed, _ = satellite([fflin.BaseForce(), fflin.BaseTorque()])
    late = fflin.linearize(design).discretize(H, 0.15)
    law = state_feedback(late)
    x0 = 0.01 * np.random.default_rng(7).normal(size=12)
    direct = fflin.simulate(design, law, x0=x0, duration=3.0)
    allocated = fflin.simulate(
        pushed, fflin.Allocation(law, design), x0=x0, duration=3.0
    )
    assert allocated.x == pytest.approx(direct.x, abs=1e-10)
    different = fflin.linearize(design).discretize(H, {"tau_b": 0.15})
    with pytest.raises(fflin.InputError, match="different delays"):
        fflin.simulate(
            pushed,
            fflin.Allocation(state_feedback(different), design),
            x0=x0,
            duration=3.0,
        )


def test_accelerometers_that_feel_delayed_inputs_are_refused():
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseForce()],
        outputs=[fflin.FullState(), fflin.Accelerometer("base")],
    )
    late = fflin.linearize(robot).discretize(H, 0.15)
    system = np.zeros((3, len(late.output_names)))
    with pytest.raises(fflin.InputError, match="accelerometer"):
        fflin.LinearController(system, late)


def test_an_explicit_delay_replaces_that_of_the_model():
    robot, lin = satellite()
    law = state_feedback(lin.discretize(H, 0.15))
    x0 = 0.01 * np.random.default_rng(8).normal(size=12)
    default, same, other = (
        fflin.simulate(robot, law, x0=x0, duration=2.0, **given)
        for given in ({}, {"delay": 0.15}, {"delay": 0.05})
    )
    assert (default.x == same.x).all()
    assert not np.allclose(default.x, other.x)


@pytest.mark.exhaustive
def test_the_default_step_is_accurate_for_the_delayed_loop():
    """A flexible mode shortens the step, as without a delay."""
    arm = fflin.load("planar_detumble", stiffness=1e5)
    lin = fflin.linearize(arm)
    x0 = np.zeros(18)
    x0[6] = 0.01
    steps = []
    for delay in (0.0, 0.05):
        late = lin.discretize(H, delay)
        law = fflin.StateFeedback(late, fflin.lqr(late))
        steps.append(fflin.simulate(arm, law, x0=x0, duration=1.0).step)
    assert steps[0] < 0.01
    assert steps[1] == pytest.approx(steps[0])


@exhaustive
def test_integral_action_of_a_delayed_law():
    """The integrals remove the error under a constant torque; the poles are those of the gain."""
    robot, lin = satellite()
    late = lin.discretize(H, 0.15)
    gain = fflin.lqr(late, integral_action=["q_b"])
    assert gain.state_names[12:15] == (
        "past_1.tau_b.x",
        "past_2.tau_b.x",
        "past_1.tau_b.y",
    )
    law = fflin.StateFeedback(late, gain)
    poles = np.linalg.eigvals(law.closed_loop()[0])
    for pole in gain.poles[np.abs(gain.poles) > 0.05]:
        assert np.abs(poles - pole).min() < 1e-6
    assert fflin.margins(law, late).disk == pytest.approx(
        fflin.margins(gain, late).disk
    )
    torque = {"tau_b": (1e-6, 0.0, 0.0)}
    errors = [
        np.abs(
            fflin.simulate(
                robot,
                feedback,
                x0=np.zeros(12),
                duration=200.0,
                dt=0.05,
                disturbance=torque,
            ).x[-1, :3]
        ).max()
        for feedback in (law, state_feedback(late))
    ]
    assert errors[0] < 1e-3 * errors[1]


@pytest.mark.parametrize(
    ("delay", "words"),
    [
        (None, None),
        (0.4, None),
        (0.2, "delay of 0.4 s of the inputs, but the motion has 0.2 s"),
        (0.0, "but the motion has 0 s"),
        ({"tau_b": 0.2}, "but the motion has 0 to 0.2 s"),
    ],
)
def test_a_delay_that_the_law_does_not_expect_is_noted(delay, words):
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot).discretize(0.2, delay=0.4)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin))
    motion = fflin.simulate(robot, policy, duration=2.0, dt=0.1, delay=delay)
    notes = [note for note in motion.notes if "designed for a delay" in note]
    assert len(notes) == (words is not None)
    assert all(words in note for note in notes)


def test_a_delay_is_noted_for_a_law_without_one():
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot).discretize(0.2)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin))
    motion = fflin.simulate(robot, policy, duration=2.0, dt=0.1, delay=0.2)
    (note,) = (note for note in motion.notes if "designed for a delay" in note)
    assert "of 0 s" in note and note.endswith("has 0.2 s")
