"""A linearizer whose accelerations the compiled kernel gives, against one by Python."""

import pickle

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.linear import linearization
from tests.batch.test_equations import TILTED, operating_points
from tests.support.robots import random_point

pytest.importorskip("numba")
pytestmark = pytest.mark.compiled

FIELDS = ("A", "B", "C", "D", "f0", "x0", "u0", "y0", "q", "v", "placement")
OUTPUTS = [
    fflin.FramePose("tool"),
    fflin.Accelerometer("tool"),
    fflin.JointPositions(),
    fflin.Momentum(),
]


def both(robot, **options):
    return (fflin.Linearizer(robot, engine=each, **options) for each in ("compiled", "python"))


@pytest.mark.parametrize("outputs", [None, OUTPUTS])
@pytest.mark.parametrize(
    "options", [{}, {"moving": True}, {"frame": "world", "reference": TILTED}], ids=str
)
def test_every_field_is_that_of_the_other_route_to_rounding(robots, outputs, options):
    robot = robots["servicer_7dof"].replace(gravity=(0.3, -1.0, 2.0), stiffness=0.5)
    if outputs:
        robot = robot.replace(outputs=outputs)
    quick, slow = both(robot, **options)
    (q,), (v,), (u,) = operating_points(robot, 1)
    for point in ((q, v, u), (q, v), (q, None, u), (q,), (list(q), list(v), list(u))):
        lin, expected = quick(*point), slow(*point)
        for key in FIELDS:
            found, true = getattr(lin, key), getattr(expected, key)
            assert not found.flags.writeable, key
            assert found.shape == true.shape, key
            scale = max(1.0, np.abs(true).max(initial=0.0))
            assert np.abs(found - true).max(initial=0.0) < 1e-11 * scale, key
        assert (lin.drift is None) is (expected.drift is None)
        assert lin.state_names == expected.state_names
        assert fflin.check(robot, lin).ok


def test_a_model_keeps_its_numbers_when_the_next_one_is_made(robots):
    robot = robots["ets_vii"].replace(outputs=[fflin.CenterOfMass()])
    quick, _ = both(robot)
    q, v, u = operating_points(robot, 2)
    before = quick(q[0], v[0], u[0])
    kept = {key: getattr(before, key).copy() for key in FIELDS}
    given = q[0].copy(), v[0].copy(), u[0].copy()
    quick(q[1], v[1], u[1])
    for key in FIELDS:
        assert (getattr(before, key) == kept[key]).all(), key
    for argument, original in zip((q[0], v[0], u[0]), given, strict=True):
        assert argument.flags.writeable
        assert (argument == original).all()


def test_what_the_kernel_cannot_vouch_for_is_refused_in_the_same_words(robots):
    robot = robots["servicer_7dof"]
    quick, slow = both(robot, reference=pin.SE3.Identity())
    (q,), (v,), (u,) = operating_points(robot, 1)
    turned, far = q.copy(), v.copy()
    turned[3:7], far[2] = (1.0, 0.0, 0.0, 0.0), 1e160
    for point in ((turned, v, u), (q, far, u), (q, v, np.full_like(u, np.nan)), (q[:-1], v, u)):
        said = []
        for linearizer in (quick, slow):
            with pytest.raises(fflin.FflinError) as caught:
                linearizer(*point)
            said.append((type(caught.value), str(caught.value)))
        assert said[0] == said[1]
    # Beyond the kernel's sines the other route takes over.
    q[7] = 2e6
    assert (quick(q, v, u).A == slow(q, v, u).A).all()


def test_one_point_goes_by_python_unless_asked_otherwise(robots):
    robot = robots["planar_detumble"]
    (q,), (v,), (u,) = operating_points(robot, 1)
    quick, plain = both(robot)
    assert (fflin.Linearizer(robot)(q, v, u).A == plain(q, v, u).A).all()
    again = pickle.loads(pickle.dumps(quick))
    assert (again(q, v, u).A == quick(q, v, u).A).all()


def test_an_engine_that_cannot_is_refused(robots, monkeypatch):
    with pytest.raises(fflin.UnknownNameError, match="'fast'"):
        fflin.Linearizer(robots["cubesat"], engine="fast")
    monkeypatch.setattr(linearization, "numba_is_there", lambda: False)
    with pytest.raises(fflin.InputError, match=r"'compiled'.*fflin\[fast"):
        fflin.Linearizer(robots["cubesat"], engine="compiled")
    monkeypatch.undo()
    orbiting = robots["cubesat"].replace(orbit=fflin.CircularOrbit(500e3))
    with pytest.raises(fflin.InputError, match=r"'cubesat'.*orbit"):
        fflin.Linearizer(orbiting, engine="compiled")


def test_one_model_is_the_same_to_the_last_bit_where_the_kernel_is_loaded(robots):
    robot = robots["canadarm2"]
    q, v, u = random_point(robot, np.random.default_rng(7))
    fflin.Linearizer(robot, engine="compiled")(q, v, u)
    one, plain = fflin.linearize(robot, q, v, u), fflin.Linearizer(robot, engine="python")(q, v, u)
    assert (one.A == plain.A).all() and (one.B == plain.B).all() and (one.f0 == plain.f0).all()
