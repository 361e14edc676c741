"""Balance of the forces on a robot with constraints at rest, in its independent coordinates."""

from collections.abc import Mapping

import numpy as np

from fflin.base.errors import EquilibriumError, InputError, listed
from fflin.base.validation import Array, numbers
from fflin.dynamics.coordinates import PIN_ANGULAR, PIN_LINEAR, forces_of
from fflin.linear.least_norm import TOLERANCE, least_norm
from fflin.linear.linearization import Linearizer
from fflin.robot.outputs import FORCES, ConstraintForce
from fflin.robot.robot import Robot


class ConstrainedBalance:
    """Minimum-norm inputs that balance the forces, and the residual forces (d,).

    Inputs and forces on the base are in base axes. `wrench` (6,) is a disturbance of the base, in
    Pinocchio's order. `forces` {component: value} are forces that constraints must exert.

    Attributes
    ----------
    lin : LinearModel
        Model without inputs.
    u : ndarray (nu,)
    left, residual : ndarray (d,)
        Residual generalised forces, with and without scaling to comparable units.
    names : dict
        Names and units of the residual.
    """

    def __init__(
        self, robot: Robot, q: Array, wrench: Array, forces: Mapping[str, float]
    ) -> None:
        linearizer = Linearizer(robot, moving=True)
        self.lin = lin = linearizer(q)
        d = len(lin.M)
        nv = 6 + robot.n
        assert lin._all_states is not None
        # The virtual work of forces in all coordinates gives the forces in the independent ones.
        basis = lin._all_states[nv:, d:]
        pushes = forces_of(robot)
        named = dict(zip(linearizer.prepared.map.names, pushes.items(), strict=False))
        self.names = dict(named[name] for name in lin.state_names[:d])
        disturbance: Array = np.zeros(nv)
        disturbance[:3], disturbance[3:6] = wrench[PIN_ANGULAR], wrench[PIN_LINEAR]
        acceleration = lin.rate[d:]
        wanted = -lin.M @ acceleration - basis.T @ disturbance
        self._mobility = np.sqrt(np.linalg.inv(lin.M).diagonal())
        rows = self._mobility[:, None] * (lin.M @ lin.B[d:])
        target = self._mobility * wanted
        for index, _, _ in linearizer.prepared.actuation.torquers:
            rows[:, index] = 0.0
        given = numbers("forces", forces, "constraint force", "value")
        if given:
            if disturbance.any():
                raise InputError(
                    "forces and disturbed=True are given together; leave out one of them"
                )
            squeeze, missing = _constraint_forces(robot, lin.independent, q, given)
        thrusts = linearizer.prepared.actuation.groups.get("thrust", [])
        self.u, self.left = least_norm(rows, target, thrusts)
        self.residual = self.left / self._mobility
        self._allowed = TOLERANCE * float(np.linalg.norm(target))
        if not (given and self.holds):
            return
        C = np.vstack((rows, squeeze))
        self.u, left = least_norm(C, np.append(target, missing), thrusts)
        self.left = left[:d]
        self.residual = self.left / self._mobility
        exact = np.abs(left[d:]) <= TOLERANCE * (1.0 + np.abs(missing))
        if not (self.holds and exact.all()):
            raise EquilibriumError(
                f"the inputs of '{robot.name}' cannot hold the robot with the constraint forces "
                f"{listed(given)}; leave some of them out, or add inputs that squeeze the loop"
            )

    @property
    def holds(self) -> bool:
        """Whether the residual forces, or their accelerations, count as zero."""
        rates = np.linalg.solve(self.lin.M, self.residual)
        small = float(np.linalg.norm(self.left)) <= self._allowed
        return small or bool(np.abs(rates).max() <= self.lin.bound(TOLERANCE))


def _constraint_forces(
    robot: Robot,
    independent: tuple[str, ...] | None,
    q: Array,
    given: Mapping[str, float],
) -> tuple[Array, Array]:
    """Return the rows (k, nu) of given constraint forces by u, and their missing values (k,).

    Each row is divided by its norm.
    """
    outputs = list[ConstraintForce]()
    for name in given:
        component = next((key for key in FORCES if name.endswith(f".{key}")), None)
        if component is None:
            raise InputError(
                f"'{name}' in forces is no component of a constraint force; give names such as "
                f"'{robot.constraints[0].title}.force.x'"
            )
        title = name.removesuffix(f".{component}")
        outputs.append(ConstraintForce(title, (component,)))
    measured = robot.replace(outputs=outputs)
    lin = Linearizer(measured, moving=True, independent=independent)(q)
    size = np.maximum(np.linalg.norm(lin.D, axis=1), np.finfo(float).tiny)
    missing = np.array(list(given.values())) - lin.y0
    return lin.D / size[:, None], missing / size
