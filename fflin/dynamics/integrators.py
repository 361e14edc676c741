"""Integrators: fixed steps on the configuration manifold, and exact sampling of linear models."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import ClassVar, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base.errors import unknown
from fflin.base.validation import Array, Values
from fflin.dynamics.methods import CF4, DEFAULT_METHOD, SEMI_IMPLICIT_EULER

Acceleration: TypeAlias = Callable[[float, Array, Array], Array]

_integrate = pin.integrate


def integrate_rows(model: pin.Model, q: Array, way: Array) -> Array:
    """Return configurations q (N, nq) after displacements by the tangent vectors `way` (N, nv)."""
    return np.array([*map(partial(_integrate, model), q, way)])


class Integrator(ABC):
    """Integrator of one model with a fixed step size, for one q and v, or for N rows of q and v."""

    # A step of length h starts at q and v. The accelerations at its stages are l1, l2, and so on.

    # Times of the stages after the start of a step, divided by h.
    nodes: ClassVar[tuple[float, ...]]
    # Weights of l1, l2, ... in the integral of the acceleration: the step changes v by h times the
    # weighted sum.
    weights: ClassVar[tuple[float, ...]]
    # Weights of l1, l2, ... in the double integral of the acceleration: the step changes the
    # position of a point by h v plus h^2 times the weighted sum.
    moments: ClassVar[tuple[float, ...]]
    # Stability limit: a negative real pole is integrated stably up to this value of h |pole|.
    reach: ClassVar[float]
    # After each stage, a displacement leads to the next configuration. For each displacement,
    # `origins` contains the index of the stage at whose configuration the displacement starts. The
    # first stage has the index 0.
    origins: ClassVar[tuple[int, ...]]
    # Weights of h v, h^2 l1, h^2 l2, ... in each displacement. The last displacement has no
    # entry in `origins`, because it starts from the result of the displacement before it.
    displacements: ClassVar[tuple[tuple[float, ...], ...]]
    # Weights of v, h l1, h l2, ... in the velocity after each stage.
    speeds: ClassVar[tuple[tuple[float, ...], ...]]

    def __init__(self, model: pin.Model, dt: float, rows: int | None = None) -> None:
        self.model, self.dt = model, dt
        self._displacement, self._speed = self.step_weights(dt)
        self._integrate = _integrate if rows is None else integrate_rows
        shape: tuple[int, ...] = (1 + len(self.nodes), model.nv)
        if rows is not None:
            shape = (rows, *shape)
        # The rows v, l1, l2, ... of a step.
        self._stages = np.zeros(shape)

    @classmethod
    def step_weights(cls, dt: float) -> tuple[Array, Array]:
        """Return the weights of v, l1, l2, ... for a step of dt [s].

        The first result has one row of weights for each displacement of q. The second result has
        one row for the velocity after each stage.
        """
        displacement, speed = np.array(cls.displacements), np.array(cls.speeds)
        displacement[:, 0] *= dt
        displacement[:, 1:] *= dt * dt
        speed[:, 1:] *= dt
        return displacement, speed

    @classmethod
    @abstractmethod
    def growth(cls, z: Values) -> Array:
        """Return ln|R(z)| for poles times the step, z = lambda h.

        A step multiplies the amplitude of the mode with the pole lambda by |R(z)|. The exact factor
        is exp(Re z).
        """

    @classmethod
    def held(cls, A: Array, driven: Array, h: float) -> tuple[Array, Array] | None:
        """Return the two matrices of `held_exponential` as a step computes them.

        The result is None for a method for which they are not known. The time step is then not
        checked against the poles of sampled loops.
        """
        return None

    @classmethod
    def vector_step(
        cls, rate: Callable[[float, Array], Array], h: float, z: Array
    ) -> Array:
        """Return z one step later for dz/dt = rate, as a step computes the velocity.

        `rate(node, z)` returns the derivative of z at the time `node` after the start of the step,
        divided by h.
        """
        rates = list[Array]()
        at = z
        for k, node in enumerate(cls.nodes):
            rates.append(rate(node, at))
            change = np.zeros_like(z)
            for weight, one in zip(cls.speeds[k][1:], rates, strict=False):
                if weight:
                    change += weight * one
            at = z + h * change
        return at

    def step(
        self, f: Acceleration, t: float, q: Array, v: Array
    ) -> tuple[Array, Array]:
        """Return q and v one step later; `f(t, q, v)` returns the acceleration."""
        model = self.model
        stages = self._stages
        begins = list[Array]()
        integrate = self._integrate
        stages[..., 0, :] = v
        for k, node in enumerate(self.nodes, start=1):
            stages[..., k, :] = f(t + node * self.dt, q, v)
            done = stages[..., : k + 1, :]
            begins.append(q)
            q = integrate(
                model,
                begins[self.origins[k - 1]],
                self._displacement[k - 1, : k + 1].dot(done),
            )
            v = self._speed[k - 1, : k + 1].dot(done)
        return integrate(model, q, self._displacement[-1].dot(stages)), v


class CommutatorFree4(Integrator):
    """Commutator-free method CF4 of Celledoni, Marthinsen and Owren, of order 4 (11.1).

    Two exponentials, one after the other, lead to the configuration at the end of a step.
    """

    nodes = (0.0, 0.5, 0.5, 1.0)
    weights = (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)
    moments = (1.0 / 6.0, 1.0 / 6.0, 1.0 / 6.0, 0.0)
    reach = 2.78
    origins = (0, 0, 1, 0)
    displacements = (
        (0.5, 0.0, 0.0, 0.0, 0.0),
        (0.5, 0.25, 0.0, 0.0, 0.0),
        (0.5, 0.0, 0.5, 0.0, 0.0),
        (0.5, 1.0 / 12.0, 1.0 / 12.0, -1.0 / 12.0, 0.0),
        (0.5, 1.0 / 12.0, 1.0 / 12.0, 0.25, 0.0),
    )
    speeds = (
        (1.0, 0.5, 0.0, 0.0, 0.0),
        (1.0, 0.0, 0.5, 0.0, 0.0),
        (1.0, 0.0, 0.0, 1.0, 0.0),
        (1.0, *weights),
    )

    @classmethod
    def factor(cls, z: Values) -> Values:
        """Return R(z), the Taylor polynomial of exp(z) of order 4; see `Integrator.growth`."""
        return 1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0)))

    @classmethod
    def growth(cls, z: Values) -> Array:
        """Return ln|R(z)|; see `Integrator.growth`."""
        with np.errstate(divide="ignore"):
            growth: Array = np.log(np.abs(cls.factor(z)))
        return growth

    @classmethod
    def held(cls, A: Array, driven: Array, h: float) -> tuple[Array, Array]:
        """Return the matrices of `held_exponential` as Taylor polynomials; see `Integrator.held`.

        For a linear system, CF4 is the classical Runge-Kutta method.
        """
        one = np.eye(len(A))
        Z = A * h
        mean = one + Z / 2.0 @ (one + Z / 3.0 @ (one + Z / 4.0))
        return one + Z @ mean, h * mean @ driven


class SemiImplicitEuler(Integrator):
    """Semi-implicit Euler method of order 1: the new velocity displaces the configuration."""

    nodes, weights, moments = (0.0,), (1.0,), (1.0,)
    reach = 2.0
    origins = (0,)
    displacements, speeds = ((1.0, 1.0), (0.0, 0.0)), ((1.0, 1.0),)

    @classmethod
    def growth(cls, z: Values) -> Array:
        """Return ln|R(z)|; see `Integrator.growth`.

        For a complex pole, R is the larger eigenvalue of the step of the oscillator with the
        characteristic polynomial s^2 - 2 Re(z) s + |z|^2. For a real pole, R = 1 + z.
        """
        determinant = 1.0 + 2.0 * z.real
        half_trace = 0.5 * (1.0 + determinant - np.abs(z) ** 2)
        root = np.sqrt((half_trace**2 - determinant).astype(complex))
        pair = np.maximum(np.abs(half_trace + root), np.abs(half_trace - root))
        with np.errstate(divide="ignore"):
            growth: Array = np.log(np.where(z.imag == 0.0, np.abs(1.0 + z.real), pair))
        return growth


INTEGRATORS: dict[str, type[Integrator]] = {
    CF4: CommutatorFree4,
    SEMI_IMPLICIT_EULER: SemiImplicitEuler,
}
DEFAULT_INTEGRATOR = INTEGRATORS[DEFAULT_METHOD]


def integrator(name: str) -> type[Integrator]:
    """Return the integrator of a given name; raise `UnknownNameError` if there is none."""
    if str(name) not in INTEGRATORS:
        raise unknown("method", str(name), INTEGRATORS)
    return INTEGRATORS[str(name)]


# Commutator-free method of order four (10.3): its two Gauss points, and the weights alpha (HEAVY)
# and beta (LIGHT). In the exponential that acts first, the first Gauss point has the weight HEAVY.
# In the other exponential, the second Gauss point has this weight.
GAUSS = (0.5 - 3.0**0.5 / 6.0, 0.5 + 3.0**0.5 / 6.0)
HEAVY, LIGHT = 0.5 + 3.0**0.5 / 3.0, 0.5 - 3.0**0.5 / 3.0


def held_exponential(A: Array, driven: Array, h: float | Array) -> tuple[Array, Array]:
    r"""Return :math:`e^{A h}` (n, n) and :math:`\int_0^h e^{A s}\,ds\,B` (n, k) with B = `driven`.

    A (.., n, n), B (.., n, k) and the time h (..) [s] may have leading axes.
    """
    n, k = driven.shape[-2:]
    h = np.asarray(h)[..., None, None]
    with np.errstate(over="ignore", invalid="ignore"):
        if not (A @ A).any():
            # the exponential series ends after its linear term
            transition = np.eye(n) + A * h
            held = driven * h + A @ driven * (h * h / 2.0)
            return transition, held
        from scipy.linalg import expm

        block = np.zeros((*A.shape[:-2], n + k, n + k))
        block[..., :n, :n] = A
        block[..., :n, n:] = driven
        exponential = expm(block * h)
        return exponential[..., :n, :n], exponential[..., :n, n:]


def held_derivatives(
    A: Array, driven: Array, h: float, dA: Array, d_driven: Array
) -> tuple[Array, Array]:
    """Return the first-order changes of the two matrices that `held_exponential` returns.

    dA (.., n, n) is the change of A, and d_driven (.., n, k) is the change of `driven`.
    """
    # `held_exponential` solves dx/dt = A x + driven u. The change dx of the solution satisfies
    # d(dx)/dt = A dx + dA x + d_driven u. Both equations together are a linear system with the
    # state (dx, x).
    n = len(A)
    both = np.zeros((*dA.shape[:-2], 2 * n, 2 * n))
    both[..., :n, :n] = A
    both[..., :n, n:] = dA
    both[..., n:, n:] = A
    forced = np.concatenate(
        (d_driven, np.broadcast_to(driven, d_driven.shape)), axis=-2
    )
    exponential, held = held_exponential(both, forced, h)
    return exponential[..., :n, n:], held[..., :n, :]


def held_cost(F: Array, W: Array, h: float | Array) -> Array:
    """Return the integral of e^(F^T t) W e^(F t) over t from 0 to h, for F (.., n, n) and h (..).

    W (n, n) must be symmetric.
    """
    # The integral follows from the exponential of the matrix `block`, which contains W and F. The
    # rounding errors of the exponential are relative to the largest entries of `block`. So W is
    # scaled to the norm of F.
    from scipy.linalg import expm

    h, n = np.asarray(h)[..., None, None], F.shape[-1]
    rate, weight = (float(np.abs(X).sum(axis=-2).max()) or 1.0 for X in (F, W))
    # The logarithms are added, because the product of the two numbers may overflow.
    longest = float(h.max())
    halvings = 0.0
    if longest:
        halvings = 1.0 + math.log2(rate) + math.log2(longest)
    doublings = max(math.ceil(halvings), 0)
    block = np.zeros((*F.shape[:-2], 2 * n, 2 * n))
    size = weight / rate
    block[..., :n, :n] = -F.mT
    block[..., :n, n:] = W / size
    block[..., n:, n:] = F
    with np.errstate(over="ignore", invalid="ignore"):
        exponential = expm(block * np.ldexp(h, -doublings))
        step = exponential[..., n:, n:]
        total: Array = step.mT @ exponential[..., :n, n:]
        for _ in range(doublings):
            total = total + step.mT @ total @ step
            step = step @ step
        return 0.5 * size * (total + total.mT)
