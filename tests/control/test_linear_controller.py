"""Controllers of other tools in the loop: what they are read as, and what they do there."""

from shutil import which

import control
import numpy as np
import pytest
import scipy.signal
from scipy.io import savemat
from scipy.linalg import expm

import fflin
from tests.support.messages import says
from tests.support.patience import finished
from tests.support.robots import random_point

RNG = np.random.default_rng(7)
SEEN = (fflin.BasePose(), fflin.Gyroscope("base"))


@pytest.fixture(scope="module")
def lin():
    return fflin.linearize(fflin.load("cubesat", outputs=SEEN))


@pytest.fixture(scope="module")
def arm():
    robot = fflin.load(
        "planar_detumble", outputs=[fflin.BasePose(), fflin.JointPositions()]
    )
    lin = fflin.linearize(robot)
    return robot, lin, fflin.lqr(lin), fflin.kalman(lin, 1e-2, 1e-3)


def matrices(lin, nz=4):
    shapes = (nz, nz), (nz, len(lin.y0)), (len(lin.u0), nz), (len(lin.u0), len(lin.y0))
    A, *rest = (RNG.normal(size=shape) for shape in shapes)
    return A - 3.0 * np.eye(nz), *rest


def apart(policy, A, B, C, D, dt=0.0):
    matrices_of_law = policy.system
    pairs = zip(matrices_of_law[:4], (A, B, C, D), strict=True)
    assert matrices_of_law.dt == dt
    return max(np.abs(a - b).max(initial=0.0) for a, b in pairs)


def foreign(lin, dt):
    """The same system as every tool has it."""
    matrices_of_law = matrices(lin)
    record = dict(zip("ABCD", matrices_of_law, strict=True))
    names = {"inputs": [n.replace(".", "_") for n in lin.output_names]}
    names["outputs"] = [n.replace(".", "_") for n in lin.input_names]
    scipys = (
        scipy.signal.dlti(*matrices_of_law, dt=dt)
        if dt
        else scipy.signal.lti(*matrices_of_law)
    )
    yield matrices_of_law, (*matrices_of_law, dt)
    yield matrices_of_law, control.ss(*matrices_of_law, dt)
    yield matrices_of_law, control.ss(*matrices_of_law, dt, **names)
    yield matrices_of_law, scipys
    yield matrices_of_law, record | {"Ts": dt}
    yield matrices_of_law, record | {"dt": dt, "input_names": [*lin.output_names]}
    yield matrices_of_law, {"K": record | {"Ts": dt}}


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_every_tools_system_is_read_as_it_is(lin, tmp_path, dt):
    for matrices_of_law, given in foreign(lin, dt):
        if not isinstance(given, dict):
            assert (
                apart(fflin.LinearController(given, lin), *matrices_of_law, dt) == 0.0
            )
            continue
        savemat(tmp_path / "K.mat", given)
        assert (
            apart(fflin.LinearController(tmp_path / "K.mat", lin), *matrices_of_law, dt)
            == 0.0
        )
        if "K" not in given:
            np.savez(tmp_path / "K.npz", **given)
            assert (
                apart(
                    fflin.LinearController(str(tmp_path / "K.npz"), lin),
                    *matrices_of_law,
                    dt,
                )
                == 0.0
            )


def test_names_put_signals_where_they_belong(lin, tmp_path):
    rows, columns = [4, 1], [7, 0, 5]
    A, B, C, D = matrices(lin)
    part = (A, B[:, columns], C[rows], D[np.ix_(rows, columns)])
    inputs, outputs = (
        [source[k] for k in places]
        for source, places in ((lin.output_names, columns), (lin.input_names, rows))
    )
    expected = [A, np.zeros_like(B), np.zeros_like(C), np.zeros_like(D)]
    expected[1][:, columns], expected[2][rows] = part[1], part[2]
    expected[3][np.ix_(rows, columns)] = part[3]
    plain = [[name.replace(".", "_") for name in names] for names in (inputs, outputs)]
    given = control.ss(*part, inputs=plain[0], outputs=plain[1])
    assert apart(fflin.LinearController(given, lin), *expected) == 0.0
    cells = {
        "InputName": np.array(inputs, object),
        "OutputName": np.array(outputs, object),
    }
    savemat(tmp_path / "K.mat", dict(zip("ABCD", part, strict=True)) | cells)
    assert apart(fflin.LinearController(tmp_path / "K.mat", lin), *expected) == 0.0


@pytest.mark.process
@pytest.mark.skipif(not which("octave"), reason="needs Octave")
def test_octave_writes_one(lin, tmp_path):
    A, B, C, D = matrices(lin)
    savemat(tmp_path / "given.mat", {"A": A, "B": B, "C": C, "D": D})
    script = "load given.mat; Ts = 0.1; save('-v7', 'K.mat', 'A', 'B', 'C', 'D', 'Ts');"
    command = ["octave", "--no-gui", "--quiet", "--eval", script]
    finished(command, cwd=tmp_path, check=True, capture_output=True)
    assert (
        apart(fflin.LinearController(tmp_path / "K.mat", lin), A, B, C, D, 0.1) == 0.0
    )


def test_transfer_functions_are_realised():
    lin = fflin.linearize(fflin.load("cubesat", outputs=[fflin.BasePose()]))
    names = {"inputs": ["r_b_x"], "outputs": ["tau_b_x"]}
    notch = control.tf([1, 0.2, 4], [1, 2, 4], **names)
    w = 2.7
    for given, z in (
        (notch, 1j * w),
        (control.c2d(notch, 0.1, "tustin"), np.exp(0.1j * w)),
    ):
        matrices_of_law = fflin.LinearController(given, lin).system
        result = (
            matrices_of_law.C
            @ np.linalg.solve(z * np.eye(2) - matrices_of_law.A, matrices_of_law.B)
            + matrices_of_law.D
        )
        assert result[0, 3] == pytest.approx(given(z), rel=1e-10)
        assert not result[:, [0, 1, 2, 4, 5]].any()


@pytest.mark.exhaustive
def test_a_gain_comes_back_as_the_state_feedback_it_was():
    robot = fflin.load("ets_vii")
    lin = fflin.linearize(robot, fflin.configuration(robot, {"joint_2": 0.4}))
    gain, x0 = fflin.lqr(lin), lin.x0 + 0.05
    expected = fflin.simulate(
        robot, fflin.StateFeedback(lin, gain.K), x0=x0, duration=2.0
    )
    nothing = ((), (), ())
    for system in (
        gain.to_control(),
        -gain.K,
        (*nothing, -gain.K, True),
        (*nothing, -gain.K, 0),
    ):
        result = fflin.simulate(
            robot, fflin.LinearController(system, lin), x0=x0, duration=2.0
        )
        assert np.abs(result.x - expected.x).max() < 1e-13
        assert np.abs(result.prediction - expected.prediction).max() < 1e-12
    turned = fflin.LinearController(gain.K, lin, sign=-1)
    assert np.array_equal(turned.system.D, -gain.K)


def test_a_compensator_comes_back_as_the_output_feedback_it_was(arm, tmp_path):
    robot, lin, *_ = arm
    sampled = lin.discretize(0.05)
    controller = fflin.lqg(fflin.lqr(sampled), fflin.kalman(sampled, 1e-4, 1e-4))
    controller.save(tmp_path / "K.mat")
    run = {"x0": lin.x0 + 0.02, "duration": 2.0, "dt": 0.01}
    expected = fflin.simulate(robot, fflin.OutputFeedback(sampled, controller), **run)
    for system in (controller, controller.to_control(), tmp_path / "K.mat"):
        for model in (lin, sampled):
            result = fflin.simulate(robot, fflin.LinearController(system, model), **run)
            assert np.abs(result.x - expected.x).max() < 1e-13


@pytest.mark.parametrize("dt", [0.0, 0.05])
def test_estimator_and_gain_make_the_compensator(arm, dt):
    _, lin, *_ = arm
    model = lin.discretize(dt) if dt else lin
    gain, seen = fflin.lqr(model), fflin.kalman(model, 1e-3, 1e-3)
    controller, filtered = fflin.lqg(gain, seen), seen.to_control()
    nu = len(lin.u0)
    K = gain.to_control()
    assert [*filtered.state_labels] == [*filtered.output_labels] == [*K.input_labels]
    assert filtered.A + filtered.B[:, :nu] @ K.D @ filtered.C == pytest.approx(
        controller.A, abs=1e-12
    )
    assert np.array_equal(filtered.B[:, nu:], controller.B) and np.array_equal(
        K.D, controller.C
    )


def test_the_loop_of_a_free_body_is_the_linear_one_to_order_four():
    """Pushed without turning, a body is linear: the exponential knows where it is."""
    robot = fflin.load("cubesat", outputs=[fflin.BasePose()])
    lin = fflin.linearize(robot)
    names = {"inputs": ["r_b_x"], "outputs": ["F_b_x"]}
    # A force against the displacement and, filtered, its rate.
    lead = control.tf([-30.0, -3.0], [1.0, 8.0], **names)
    policy = fflin.LinearController(lead, lin)
    assert np.linalg.eigvals(policy.loop).real.max() < 1e-9
    x0 = lin.x0 + np.where(np.array(lin.state_names) == "r_b.x", 0.3, 0.0)
    e0 = np.append(x0 - lin.x0, 0.0)
    errors = []
    for dt in (0.05, 0.025):
        motion = fflin.simulate(robot, policy, x0=x0, duration=4.0, dt=dt)
        exact = np.array([lin.x0 + (expm(policy.loop * t) @ e0)[:-1] for t in motion.t])
        errors.append(np.abs(motion.x - exact).max())
        assert np.abs(motion.prediction - exact).max() < 1e-12
    assert errors[1] < 1e-5 and errors[0] / errors[1] == pytest.approx(16.0, rel=0.25)
    # In samples y is held, and what is between them exact.
    A, B, C, D = policy.system[:4]
    held = fflin.simulate(robot, policy, x0=x0, duration=4.0, dt=0.05, sample=0.2)
    e, z, force = e0[:-1].copy(), 0.0, []
    step = lin.discretize(0.2)
    for _ in range(20):
        force.append((C[:, 0] * z + D @ (lin.C @ e))[3])
        z = (
            np.exp(A[0, 0] * 0.2) * z
            + (np.exp(A[0, 0] * 0.2) - 1.0) / A[0, 0] * (B @ lin.C @ e)[0]
        )
        e = step.A @ e + step.B[:, 3] * force[-1]
    assert held.u[:-1:4, 3] == pytest.approx(np.array(force), abs=1e-12)
    assert np.abs(held.prediction - held.x).max() < 1e-12


def test_the_fastest_pole_of_a_controller_chooses_the_step(arm):
    robot, lin, *_ = arm
    fast = (
        -400.0 * np.eye(1),
        np.zeros((1, len(lin.y0))),
        np.zeros((len(lin.u0), 1)),
        0.0,
    )
    motion = fflin.simulate(robot, fflin.LinearController(fast, lin), duration=0.1)
    assert motion.t[1] <= 1.0 / 400.0
    with pytest.raises(fflin.InputError, match="400"):
        fflin.simulate(robot, fflin.LinearController(fast, lin), duration=0.1, dt=0.05)


def test_poles_that_grow_are_reported(arm):
    robot, lin, gain, _ = arm
    state = fflin.linearize(robot.replace(outputs=[fflin.FullState()]))
    run = {"duration": 0.1}
    stable = fflin.LinearController(gain.to_control(), state)
    matrices_of_law = robot.replace(outputs=[fflin.FullState()])
    assert not fflin.simulate(matrices_of_law, stable, **run).notes
    wrong = fflin.LinearController(gain.to_control(), state, sign=-1)
    (note,) = fflin.simulate(matrices_of_law, wrong, **run).notes
    assert says(note, "unstable") and "1/s" in note
    assert says(note, "sign=-1 (--negative-feedback)")
    drifting = fflin.LinearController(
        np.zeros((len(lin.u0), len(state.y0))) + 1e-3, state
    )
    (note,) = fflin.simulate(matrices_of_law, drifting, **run).notes
    assert "unstable" in note
    zero = np.zeros((1, len(lin.y0))), np.zeros((len(lin.u0), 1)), 0.0, 0.1
    unstable = fflin.LinearController((1.25 * np.eye(1), *zero), lin)
    notes = fflin.simulate(robot, unstable, **run).notes
    assert says(notes[0], "unstable", "1.25+0j")


def test_accelerometers_are_fed_back_without_a_loop_in_themselves():
    felt = fflin.load(
        "planar_detumble", outputs=[fflin.BasePose(), fflin.Accelerometer("base")]
    )
    lin = fflin.linearize(felt)
    D = np.zeros((len(lin.u0), len(lin.y0)))
    D[3, 3] = -1.0
    low_pass = (-np.eye(1), np.eye(1, len(lin.y0), 6), -np.eye(len(lin.u0), 1, -3), D)
    policy, x0 = fflin.LinearController(low_pass, lin), lin.x0 + 1e-4
    motion = fflin.simulate(felt, policy, x0=x0, duration=2.0)
    assert motion.engine == "python"
    assert (
        np.abs(motion.prediction - motion.x).max() < 1e-6 < np.abs(motion.x - x0).max()
    )
    D[0, 7] = 1.0
    with pytest.raises(fflin.InputError, match=r"base\.acceleration\.y"):
        fflin.LinearController(D, lin)


def test_only_the_simulation_integrates_it(arm):
    robot, lin, gain, seen = arm
    policy = fflin.LinearController(fflin.lqg(gain, seen), lin)
    with pytest.raises(fflin.InputError, match="can integrate the states"):
        fflin.simulate(robot, policy.bind(robot).__call__, duration=0.1)


def test_it_may_ask_for_wrenches_that_thrusters_give(arm):
    design, lin, gain, seen = arm
    policy = fflin.LinearController(fflin.lqg(gain, seen), lin)
    run = {"x0": lin.x0 + 0.01, "duration": 1.0, "dt": 0.05}
    alone = fflin.simulate(design, policy, **run)
    shared = fflin.simulate(
        design, fflin.Allocation(policy, design), **run, engine="python"
    )
    assert np.abs(alone.x - shared.x).max() < 1e-6


@pytest.mark.parametrize(
    ("words", "change"),
    {
        r"\(3, 9\)": {"B": np.zeros((3, 9))},
        r"A of .*\[0, 0\] is nan": {"A": np.full((4, 4), np.nan)},
        "5 inputs": {
            "B": np.zeros((4, 5)),
            "D": 0,
        },
        "D .*shape": {"D": np.zeros((2, 2))},
        "dt": {"dt": True},
        "complex128": {"C": np.zeros((6, 4)) * 1j},
    }.items(),
)
def test_sizes_and_figures_that_do_not_fit_are_refused(lin, words, change):
    parts = (
        dict(zip(("A", "B", "C", "D"), matrices(lin), strict=True))
        | {"dt": 0.0}
        | change
    )
    with pytest.raises(fflin.InputError, match=words):
        fflin.LinearController(tuple(parts.values()), lin)


def test_a_controller_of_another_model_is_refused(lin, arm):
    robot, _, gain, seen = arm
    A, B, C, D = matrices(lin)
    improper, tall = (
        control.tf([1, 0, 0], [1, 1]),
        scipy.signal.TransferFunction([1, 0, 0], [1, 1]),
    )
    named = control.ss(A, B[:, :1], C, D[:, :1], inputs=["q_b_w"])
    twice = control.ss(A, B[:, :2], C, D[:, :2], inputs=["q_b_x", "q_b.x"[:3] + "_x_"])
    for words, given, sign in (
        ("proper", improper, 1),
        ("proper", tall, 1),
        ("'q_b_w'", named, 1),
        ("'q_b_x_'", twice, 1),
        (r"'tau_b\.x'", seen, 1),
        ("parts", (A, B, C), 1),
        ("type Gain", gain, 1),
        ("shape", np.zeros((2, 2, 2)), 1),
        ("sign", D, 2.0),
    ):
        with pytest.raises(fflin.FflinError, match=words) as error:
            fflin.LinearController(given, lin, sign=sign)
        assert "\n" not in str(error.value)
    with pytest.raises(fflin.InputError, match=r"0.2 s.*0.1 s"):
        fflin.LinearController((A, B, C, D, 0.2), lin.discretize(0.1))
    with pytest.raises(fflin.InputError, match="continuous"):
        fflin.LinearController((A, B, C, D, 0.0), lin.discretize(0.1))
    with pytest.raises(fflin.InputError, match="noise"):
        fflin.LinearController(D, lin, noise=3)
    policy = fflin.LinearController((A, B, C, D, 0.1), lin)
    cubesat = fflin.load("cubesat", outputs=SEEN)
    with pytest.raises(fflin.InputError, match=r"0\.2 s"):
        fflin.simulate(cubesat, policy, duration=1.0, dt=0.1, sample=0.2)
    with pytest.raises(fflin.InputError, match="multiple"):
        fflin.simulate(cubesat, policy, duration=1.0, dt=0.07)
    with pytest.raises(fflin.InputError, match=r"tau_m\.joint_1"):
        fflin.simulate(robot, policy, duration=1.0)
    with pytest.raises(fflin.InputError, match="base"):
        fflin.simulate(
            cubesat.replace(outputs=[fflin.BasePose()]), policy, duration=1.0
        )


def test_files_that_hold_none_are_refused(lin, tmp_path):
    A, B, C, D = matrices(lin)
    path = tmp_path / "K.mat"
    savemat(path, {"A": A, "B": B, "K": D})
    with pytest.raises(fflin.FileError, match="A, B, K"):
        fflin.LinearController(path, lin)
    savemat(path, {"A": A, "B": B, "C": C, "D": D[:, :3]})
    with pytest.raises(fflin.InputError, match=r"K\.mat.*\(6, 3\)"):
        fflin.LinearController(path, lin)
    savemat(path, {"A": A, "B": B, "C": C, "D": D, "Ts": np.array([0.1, 0.2])})
    with pytest.raises(fflin.FileError, match=r"K\.mat"):
        fflin.LinearController(path, lin)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(fflin.FileError, match=r"K\.mat"):
        fflin.LinearController(path, lin)
    with pytest.raises(fflin.FileError, match="No such file"):
        fflin.LinearController(tmp_path / "none.mat", lin)
    with pytest.raises(fflin.FileError, match="csv"):
        fflin.LinearController(tmp_path / "K.csv", lin)


def test_outputs_match_the_model_everywhere():
    kinds = (
        *SEEN,
        fflin.FramePose("hand"),
        fflin.Accelerometer("hand"),
        fflin.CenterOfMass(),
    )
    robot = fflin.load("planar_detumble", outputs=[*kinds, fflin.JointPositions()])
    q, v, u = random_point(robot, RNG, degrees=60.0)
    lin = fflin.linearize(robot, q, v, u)
    assert fflin.outputs(robot, lin, q, v, u) == pytest.approx(lin.y0, abs=1e-12)
    state = fflin.StateMap(robot, reference=lin.reference, frame=lin.frame)
    h = 1e-6
    for k in range(len(lin.x0)):
        e = h * np.eye(len(lin.x0))[k]
        ends = [
            fflin.outputs(robot, lin, *state.to_pinocchio(lin.x0 + s * e), u)
            for s in (1, -1)
        ]
        assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(
            lin.C[:, k], rel=1e-6, abs=1e-6
        )
    turned = q.copy()
    turned[3:7] *= -1.0  # the same attitude
    assert fflin.outputs(robot, lin, turned, v, u) == pytest.approx(lin.y0, abs=1e-12)
    pushed = fflin.outputs(robot, lin, q, v, u + 1e-3) - lin.y0
    assert pushed == pytest.approx(lin.D @ np.full(len(u), 1e-3), abs=1e-12)
    still = fflin.outputs(robot, fflin.linearize(robot), robot.neutral())
    assert still == pytest.approx(fflin.linearize(robot).y0, abs=1e-12)
    with pytest.raises(fflin.InputError, match="output"):
        fflin.outputs(robot.replace(outputs=[fflin.Momentum()]), lin, q)
    with pytest.raises(fflin.InputError, match="moving"):
        fflin.outputs(robot, fflin.linearize(robot, q, v, u, moving=True), q)
