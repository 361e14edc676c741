"""The closed form on accelerations: Yang's regulator, and the general solver's solution."""

import numpy as np
import pytest

import fflin
from fflin.control.optimal.riccati import solve
from tests.support.robots import BUNDLED, random_point

# The spacecraft of Yang (2012), section 7 of the specification.
J = np.array([0.01520407970002, 0.01462135261765, 0.0062377583131])
YANG_KW, YANG_KQ = (0.79813525, 0.7978466, 0.79368217), 0.79056942

CUBE = """<robot name="yang"><link name="base"><inertial><mass value="1"/>
<inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


@pytest.fixture
def yang(tmp_path):
    path = tmp_path / "yang.urdf"
    path.write_text(CUBE.format(*J))
    return fflin.linearize(fflin.load(path))


def test_yangs_attitude_regulator_by_both_routes(yang):
    weights = (
        {"q_b": 5.0, "r_b": 1.0, "omega_b": 5.0, "v_b": 1.0},
        {"tau_b": 8.0, "F_b": 1.0},
    )
    general = fflin.lqr(yang, *weights)
    closed = fflin.acceleration_lqr(
        yang,
        {"q_b": 5.0, "r_b": 1.0},
        {"omega_b": 5.0, "v_b": 1.0},
        [*(8.0 * J**2), 1, 1, 1],
    )
    for gain in (general, closed):
        assert gain.K[:3, 6:9] == pytest.approx(np.diag(YANG_KW), abs=5e-9)
        assert gain.K[:3, :3] == pytest.approx(YANG_KQ * np.eye(3), abs=5e-9)
        assert gain.residual < 1e-15
    assert closed.R == pytest.approx(np.diag([8.0] * 3 + [1.0] * 3))
    # His formula.
    kw = np.sqrt((5.0 + J * np.sqrt(8.0 * 5.0)) / 8.0)
    assert closed.K[:3, 6:9] == pytest.approx(np.diag(kw), rel=1e-14)


@pytest.mark.parametrize("name", BUNDLED)
def test_closed_form_solves_the_riccati_equation(robots, name):
    rng = np.random.default_rng(4)
    lin = fflin.linearize(robots[name], random_point(robots[name], rng)[0])
    m = len(lin.A) // 2
    qp, qv, ra = 10 ** rng.uniform(-1, 1, (3, m))
    gain = fflin.acceleration_lqr(lin, qp, qv, ra)
    assert gain.method == "closed form" and gain.dt == 0.0
    assert gain.residual < 1e-15
    # The general route with the accelerations as inputs, u = M a.
    B = np.eye(2 * m)[:, m:]
    result = solve(lin.A, B, np.diag([*qp, *qv]), np.diag(ra))
    # P agrees to what M M^-1 rounds to, which the closed form does without.
    assert gain.P == pytest.approx(
        result.P, rel=1e-8, abs=1e-12 * np.abs(result.P).max()
    )
    expected = lin.M @ result.K
    assert gain.K == pytest.approx(
        expected, rel=1e-7, abs=1e-9 * np.abs(expected).max()
    )
    # Its poles are those of the loop with the inertia divided out.
    loop = np.linalg.eigvals(lin.A - B @ result.K)
    for pole in gain.poles:
        near = np.abs(loop - pole).min()
        assert near < 1e-7 * abs(pole) + 1e-9


def test_its_cost_sampled_gives_a_regulator_that_tends_to_it(robots):
    lin = fflin.linearize(robots["ets_vii"])
    gain = fflin.acceleration_lqr(lin, 2.0, 1.0, 0.5)
    held = [
        fflin.lqr(lin.discretize(h), *fflin.sampled_cost(lin, h, gain.Q, gain.R))
        for h in (1e-2, 1e-3)
    ]
    errors = [np.abs(item.K - gain.K).max() for item in held]
    assert errors[1] == pytest.approx(errors[0] / 10.0, rel=0.05)


def test_redundant_thrusters_share_the_least_forces():
    thrusters = [
        x for x in fflin.load_inputs("cubesat") if isinstance(x, fflin.Thruster)
    ]
    robot = fflin.load("cubesat", inputs=thrusters)
    lin = fflin.linearize(robot)
    gain = fflin.acceleration_lqr(lin, 1.0, 1.0, 1.0)
    full = fflin.acceleration_lqr(fflin.linearize(fflin.load("cubesat")), 1.0, 1.0, 1.0)
    assert lin.B @ gain.K == pytest.approx(
        np.vstack((np.zeros((6, 12)), full.B[6:] @ full.K))
    )
    assert gain.K == pytest.approx(np.linalg.pinv(lin.B[6:]) @ lin.B[6:] @ gain.K)


def test_a_guess_without_a_closed_form_is_refused():
    robot = fflin.load("ets_vii")
    lin = fflin.linearize(robot)
    joints = robot.replace(
        inputs=[fflin.JointTorque(name) for name in robot.joint_names]
    )
    for model in (joints, joints.replace(stiffness=0.0)):
        with pytest.raises(fflin.StabilizabilityError, match="angular momentum"):
            fflin.acceleration_lqr(fflin.linearize(model), 1, 1, 1)
    springs = fflin.linearize(robot.replace(stiffness=1.0))
    with pytest.raises(fflin.InputError, match="integrators"):
        fflin.acceleration_lqr(springs, 1, 1, 1)
    for words, weights in {
        "Qp": (np.eye(12), 1, 1),
        "Qp .*q_b.x": (0, 1, 1),
        "Ra": (1, 1, 0),
        "Qv": (1, -1, 1),
        r"\(3,\)": (1, 1, np.ones(3)),
        "r_b.x": ({"q_b": 1}, 1, 1),
        "overflow": (1e300, 1, 1e-300),
    }.items():
        with pytest.raises(fflin.InputError, match=words):
            fflin.acceleration_lqr(lin, *weights)
    with pytest.raises(fflin.InputError, match="overflow"):
        fflin.acceleration_lqr(lin, 1e-160, 1e160, 1e160)
    with pytest.raises(fflin.InputError, match="sampled_cost"):
        fflin.acceleration_lqr(lin.discretize(0.1), 1, 1, 1)
