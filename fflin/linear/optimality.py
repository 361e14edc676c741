"""How nearly a planned trajectory satisfies the conditions of a local minimum of its effort."""

from dataclasses import dataclass

from fflin.base import html
from fflin.base.tables import counted

# Largest stationarity and complementarity, and largest violation [rad, m, s], of a plan that counts
# as stationary. If the effort is a quadratic function of the inputs, at most STATIONARY**2 of the
# effort can be saved.
STATIONARY, FEASIBLE = 1e-2, 1e-7


@dataclass(frozen=True, repr=False)
class Optimality(html.Reported):
    r"""Residuals of the Karush-Kuhn-Tucker conditions of a plan, evaluated at the plan.

    The Lagrangian is the sum of the effort and of the limits and goals times their multipliers. Its
    gradient with respect to the inputs includes the effect of the inputs on the states.

    Attributes
    ----------
    effort : float
        :math:`\int u^T R\,u\;dt`.
    stationarity : float
        Norm of the gradient of the Lagrangian, relative to the norm of the gradient of the effort.
        Both are weighted by R. A component that pushes an input beyond its limit does not count.
        If the effort is a quadratic function of the inputs and no limit is active, at most the
        fraction ``stationarity**2`` of the effort can be saved.
    feasibility : float
        Largest error at the goal, or largest violation of a limit at a knot [rad, m, s].
    complementarity : float
        Sum of the products of the multipliers of state limits and the distances from these limits,
        relative to the effort.
    iterations : int
        Number of iterations of the search.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", lock=["joint_2", "joint_3"])
    >>> goal = fflin.configuration(robot, {"joint_1": 0.1})
    >>> motion = fflin.plan(robot, (goal, None), 20.0, knots=11, limits=None)
    >>> motion.optimality.stationary
    True
    """

    effort: float
    stationarity: float
    feasibility: float
    complementarity: float
    iterations: int

    @property
    def stationary(self) -> bool:
        """Whether the residuals are small: the plan may be a local minimum of the effort."""
        conditions = max(self.stationarity, self.complementarity)
        return conditions <= STATIONARY and self.feasibility <= FEASIBLE

    def __str__(self) -> str:
        iterations = counted(self.iterations, "iteration")
        return (
            f"effort {self.effort:.4g}, KKT residuals after {iterations}: "
            f"stationarity {self.stationarity:.1e}, feasibility {self.feasibility:.1e}, "
            f"complementarity {self.complementarity:.1e}"
        )
