"""A flight in phases: approach, capture, second grasp, berthing and release, with a regulator each.

The dispersed flights use the regulators of the nominal robot.
"""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.simulation.test_constraints import off

pytestmark = pytest.mark.exhaustive

BOX = pin.Inertia.FromBox(60.0, 0.7, 0.9, 0.8)
# Placement of the box in the tool.
GRIP = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, 0.5), np.array([0.54, -0.26, 0.0]))
TWIST = [0.0, 0.0, 0.01, 0.01, 0.0, 0.02]
GRASP = fflin.Weld("tool_right", "payload", name="grasp")
DOCK = fflin.Weld("payload", "base", name="dock")


class Flight:
    """Phases of one flight.

    `laws` are the regulators of the phases, or None to design them on the way.
    """

    def __init__(self, robot, box, laws=None):
        self.laws, self.motions, self.impacts = [], [], []
        self._given = laws
        start = fflin.configuration(
            robot, {"left_2": 0.3, "right_2": -0.3}, rpy=(3.0, 0.0, 2.0)
        )
        self._fly(robot, start, np.zeros(robot.nv), robot.neutral())
        caught = fflin.capture(
            robot, "tool_left", GRIP.act(box), payload_v=TWIST, **self.end
        )
        self._after(caught)
        self._after(fflin.latch(caught.robot, GRASP, **self.end))
        berthed = fflin.latch(self.motions[-1]._robot, DOCK, **self.end)
        self._after(berthed)
        released = berthed.robot.replace(constraints=berthed.robot.constraints[1:])
        self._fly(released, self.end["q"], self.end["v"], berthed.q)
        first, *later = self.motions
        parts = [
            part for pair in zip(self.impacts, later, strict=False) for part in pair
        ]
        self.whole = first.then(*parts, later[-1])

    @property
    def end(self):
        last = self.motions[-1]
        return {"q": last.q[-1], "v": last.v[-1]}

    def _after(self, impact):
        self.impacts.append(impact)
        self._fly(impact.robot, impact.q, impact.v, impact.q)

    def _fly(self, robot, q, v, target):
        if self._given is None:
            lin = fflin.linearize(robot, target)
            law = fflin.StateFeedback(lin, fflin.lqr(lin).K)
        else:
            law = self._given[len(self.laws)]
        self.laws.append(law)
        how = {"dt": 0.1, "limits": "urdf", "engine": "python"}
        self.motions.append(
            fflin.simulate(robot, law, q0=q, v0=v, duration=12.0, **how)
        )


@pytest.fixture(scope="module")
def nominal():
    return Flight(fflin.load("dual_arm"), BOX)


def require_exact(flight):
    """Check momentum and residuals in all phases, and the energies of the impacts."""
    for motion in flight.motions:
        assert motion.stopped == ""
        assert motion.momentum_drift.max() < 1e-12 and motion.com_drift.max() < 1e-12
        robot = motion._robot
        if robot.constraints:
            residual, rate = off(robot, motion)
            assert residual < 1e-10 and rate < 1e-10
    for impact in flight.impacts:
        assert impact.energy_lost >= 0.0
        np.testing.assert_allclose(impact.momentum_after, impact.momentum, atol=1e-12)


def test_the_stack_is_held_by_arm_and_latch_and_every_phase_is_exact(nominal):
    require_exact(nominal)
    assert nominal.whole.phases == (
        "dual_arm",
        "payload of 60 kg caught",
        "grasp latched",
        "dock latched",
        "grasp released",
    )
    sizes = [len(law.lin.state_names) for law in nominal.laws]
    assert sizes == [28, 28, 16, 12, 20]
    # The regulators bring each phase to rest.
    rates = [np.abs(motion.v[-1]).max() for motion in nominal.motions]
    assert rates[-1] < 1e-3 and max(rates) < 0.02


def test_flights_with_other_masses_settle_with_the_nominal_regulators(nominal):
    for seed in range(3):
        mass = 1.0 + 0.05 * np.random.default_rng(seed).uniform(-1.0, 1.0)
        box = pin.Inertia(mass * BOX.mass, BOX.lever, mass * BOX.inertia)
        robot = fflin.load("dual_arm").perturbed(
            mass=0.05, com=0.05, inertia=0.05, seed=seed
        )
        flight = Flight(robot, box, nominal.laws)
        require_exact(flight)
        assert np.abs(flight.motions[-1].v[-1]).max() < 2e-3


def test_the_page_of_the_flight_lists_all_phases(nominal, tmp_path):
    page = tmp_path / "flight.html"
    robot = nominal.motions[0]._robot
    fflin.visualize(robot, nominal.whole, html=page, fps=2, open=False)
    text = page.read_text("utf-8")
    for name in (*nominal.whole.phases[1:], "grasp", "dock"):
        assert name in text
