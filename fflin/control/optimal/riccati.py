"""Algebraic Riccati equations, solved by an eigenproblem of half the usual size or by SciPy."""

from __future__ import annotations

import math
import warnings
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from fflin.base.validation import Array, Values

_EPS = float(np.finfo(float).eps)
_TINY = 1e-300

# A solution with at most this relative residual is accepted, and no other method is tried. If
# rounding alone causes a larger residual (see `_Trial`), this larger residual is accepted, because
# no method can reduce it.
_SOUND = 1e-11
_STEPS = 25

# A residual below _ROUNDED, or below the rounding error of `_Trial`, cannot be reduced if a Newton
# step does not halve it. If the residual is below _NEAR, a Newton step is accepted only if it
# reduces the residual.
_ROUNDED = 1e-12
_NEAR = 1e-3

_APART = 1e-5

# A pole is near the stability boundary if its distance from the boundary, relative to the largest
# pole magnitude, is below this. An undamped mode without weight in Q has its pole exactly on the
# boundary, but rounding errors move the computed pole by up to this distance.
_NEAR_BOUNDARY = 1e-6

# The modes V of a sampled loop are not used if |V| |V^-1| is at least this. Powers of the loop, of
# at most 2^_DOUBLINGS samples, then replace them.
_INDEPENDENT = 1e10
_DOUBLINGS = 60


class Solution(NamedTuple):
    """Solution P of a Riccati equation, with its gain K, residual and method.

    `poles` are the sorted poles of A - B K. `margin` is the distance of the nearest pole from the
    stability boundary. `rounding` is the part of the residual that rounding may cause.
    """

    P: Array
    K: Array
    poles: Values
    residual: float
    method: str
    margin: float
    rounding: float = 0.0

    @property
    def sound(self) -> bool:
        """Whether no other method can find a much more accurate solution."""
        return self.residual <= max(_SOUND, self.rounding)


def solved(
    P: Array,
    K: Array,
    poles: Values,
    residual: float,
    method: str,
    *,
    rounding: float = 0.0,
    discrete: bool = False,
) -> Solution:
    """Return a `Solution` with sorted poles and with the margin of the poles."""
    poles = poles[np.lexsort((poles.imag, poles.real))]
    margin = float(-poles.real.max())
    if discrete:
        margin = float(1.0 - np.abs(poles).max())
    return Solution(P, K, poles, residual, method, margin, rounding)


def rates_of(poles: Values, dt: float) -> Values:
    """Convert poles to continuous-time rates [1/s]; dt [s] is 0 if the poles are continuous."""
    if not dt:
        return poles
    return np.log(np.where(poles == 0.0, 1e-300, poles) + 0j) / dt


class _Trial(NamedTuple):
    """Approximate solution P, with its residual matrix and the relative norm of this matrix.

    `rounding` is the relative norm that the rounding errors of the residual matrix have if the
    errors of single products are independent of each other. It exceeds machine epsilon if a product
    cancels. For example, B and P of a long chain are an inverse inertia and almost an inertia.
    """

    P: Array
    defect: Array
    residual: float
    rounding: float


class Riccati:
    """Algebraic Riccati equation, in its sampled form if dt > 0.

    In continuous time, it is ``A' P + P A - (P B + N) R^-1 (P B + N)' + Q = 0``.
    """

    def __init__(
        self, A: Array, B: Array, Q: Array, R: Array, N: Array | None, dt: float
    ) -> None:
        if N is not None and not N.any():
            N = None
        self.A, self.B, self.Q, self.R, self.N = A, B, Q, R, N
        self.discrete = bool(dt)
        # For a sampled system, the equation is written in A - I, because A' P A - P would lose
        # accuracy by cancellation.
        self.rate = A
        if dt:
            self.rate = A - np.eye(len(A))
        self.R_factor, indefinite = dpotrf(R, lower=1)
        self.definite = not indefinite
        self._inputs = B.T
        if not dt:
            self._inputs = dtrtrs(self.R_factor, B.T, lower=1)[0]
            self.cross = None if N is None else dtrtrs(self.R_factor, N.T, lower=1)[0]

    def gain(self, P: Array) -> Array:
        """Return the gain K (nu, nx) of the feedback u = -K x, from P (nx, nx)."""
        factor, Y = self._factored(P)
        K: Array = dtrtrs(factor, Y, lower=1, trans=1)[0]
        return K

    def trial(self, P: Array) -> _Trial:
        """Return P with its residual matrix and the norms of `_Trial`."""
        factor, Y = self._factored(P)
        change = P @ self.rate
        spent = Y.T @ Y
        defect = change + change.T - spent + self.Q
        size = 2.0 * _norm(change) + _norm(spent) + _norm(self.Q)
        if self.discrete:
            second = self.rate.T @ change
            defect += 0.5 * (second + second.T)
            size += _norm(second)
        residual = _norm(defect) / max(size, _TINY)
        if not math.isfinite(residual + size):
            raise np.linalg.LinAlgError("the weights or the model overflow")
        return _Trial(
            P, defect, residual, self._rounding(P, factor, Y) / max(size, _TINY)
        )

    def _rounding(self, P: Array, factor: Array, Y: Array) -> float:
        """Return the norm of the rounding errors of the residual matrix; see `_Trial`."""
        # If each product in X Z has an independent error of EPS times itself, the squared errors of
        # an entry sum to EPS^2 (X^2 Z^2), with squares entry by entry. The norm needs only the sums
        # of rows.
        squares = P**2
        right = squares.sum(axis=1)
        inputs = self._inputs
        if self.discrete:
            right = squares @ (self.A**2).sum(axis=1)
            inputs = dtrtrs(factor, self.B.T, lower=1)[0]
        of_Y = inputs**2 @ right
        spent = (Y**2).sum(axis=1) @ of_Y
        change = squares.sum(axis=0) @ (self.rate**2).sum(axis=1)
        return 2.0 * _EPS * math.sqrt(spent + change)

    def _factored(self, P: Array) -> tuple[Array, Array]:
        """Return the Cholesky factor L of W, and Y = L' K with the gain K.

        W is R in continuous time, and R + B' P B for a sampled system.
        """
        if not self.discrete:
            Y = self._inputs @ P
            if self.cross is not None:
                Y = Y + self.cross
            return self.R_factor, Y
        PB = P @ self.B
        W = self.R + self.B.T @ PB
        factor, indefinite = dpotrf(0.5 * (W + W.T), lower=1)
        if indefinite:
            raise np.linalg.LinAlgError("R + B' P B is not positive definite")
        right = PB.T @ self.A
        if self.N is not None:
            right = right + self.N.T
        return factor, dtrtrs(factor, right, lower=1)[0]


def solve(
    A: Array, B: Array, Q: Array, R: Array, N: Array | None = None, dt: float = 0.0
) -> Solution:
    """Return the stabilising solution of an algebraic Riccati equation.

    SciPy is used only if the half-size method fails or is inaccurate; see `best_solution`.
    """
    equation = Riccati(A, B, Q, R, N, dt)
    return best_solution(equation, structured(equation))


def half_size(
    A: Array, B: Array, Q: Array, R: Array, N: Array | None = None, dt: float = 0.0
) -> Solution | None:
    """Return the solution of the half-size method, or None if it is not reliable."""
    solution = structured(Riccati(A, B, Q, R, N, dt))
    if is_reliable(solution, dt):
        return solution
    return None


def is_reliable(solution: Solution | None, dt: float) -> bool:
    """Return whether a solution is accurate and has no pole near the stability boundary."""
    if solution is None or not solution.sound:
        return False
    distances = solution.poles - 1.0 if dt else solution.poles
    size = np.abs(distances).max()
    return bool(solution.margin >= _NEAR_BOUNDARY * size)


def best_solution(equation: Riccati, start: Solution | None) -> Solution:
    """Return the most accurate of `start`, the result of `structured`, and SciPy's solutions.

    SciPy is not used if `start` is accurate. If there is no solution, raise `LinAlgError`. Newton's
    method refines the solutions (D. L. Kleinman, IEEE Trans. Automatic Control 13(1), 1968).
    """
    solutions = list[Solution]()
    if start is not None:
        if start.sound:
            return start
        solutions.append(start)
    for unit in (False, True):
        # SciPy raises one of these errors if it finds no finite solution, if R is singular, or if
        # it cannot reorder the eigenvalues of the pencil.
        with suppress(np.linalg.LinAlgError, ValueError), np.errstate(all="ignore"):
            refined = _refined(equation, _general(equation, unit), None)
            if (general := _finished(equation, *refined, "general")) is not None:
                solutions.append(general)
                if general.sound:
                    break
    if not solutions:
        raise np.linalg.LinAlgError("the weights or the model are too badly scaled")
    return min(solutions, key=lambda solution: solution.residual)


def structured(equation: Riccati, apart: float = 0.0) -> Solution | None:
    """Solve by the half-size method, or return None if the method fails.

    Newton's method starts from the loop of a modified Q: the rows and columns of the velocities are
    multiplied by 1 + `apart`.
    """
    solution = None
    with suppress(np.linalg.LinAlgError), np.errstate(all="ignore"):
        source = _bilinear(equation) if equation.discrete else equation
        if source is None:
            return None
        A, Q, cross = source.A, source.Q, source.cross
        if cross is not None:
            # If u + R^-1 N' x is regarded as the input, the cost has no cross term. `cross` is
            # L^-1 N' with R = L L', so A becomes A - B R^-1 N', and Q becomes Q - N R^-1 N'.
            A = A - source.B @ dtrtrs(source.R_factor, cross, lower=1, trans=1)[0]
            Q = Q - cross.T @ cross
        scale = np.ones(len(A))
        scale[len(A) // 2 :] += apart
        Q = scale[:, None] * Q * scale
        loop = second_order_loop(A, source.B, Q, source.R_factor)
        if loop is None:
            return None
        modes, cost = loop
        P = modes.lyapunov_modal(cost)
        if equation.discrete:
            modes = modes.sampled()
        refined = _refined(equation, P, modes)
        solution = _finished(equation, *refined, "structured")
    if apart or (solution is not None and solution.sound):
        return solution
    # If modes coincide, as in critical damping, the matrix V of the modes is singular. Newton's
    # method then starts from the loop of a slightly different Q.
    return structured(equation, _APART) or solution


def _bilinear(equation: Riccati) -> Riccati | None:
    """Convert a sampled equation to the continuous equation (10.6) with the same solution P.

    Return None if R of the continuous equation is not positive definite.
    """
    A, B, Q = equation.A, equation.B, equation.Q
    N = np.zeros_like(B) if equation.N is None else equation.N
    F = np.linalg.inv(A + np.eye(len(A)))
    FB = F @ B
    R = equation.R - N.T @ FB - FB.T @ N + FB.T @ Q @ FB
    Bc = 2.0**0.5 * FB
    # The half-size method requires that the position rows of Bc are exactly zero. Rows that contain
    # only rounding errors are therefore set to zero. Newton's method corrects the effect on P,
    # because it uses the original equation.
    Bc[np.abs(Bc).max(axis=1) <= 1e-12 * np.abs(Bc).max()] = 0.0
    N = 2.0**0.5 * F.T @ (N - Q @ FB)
    # The equation is sampled, so `equation.rate` is A - I.
    continuous = Riccati(F @ equation.rate, Bc, 2.0 * F.T @ Q @ F, R, N, 0.0)
    if not continuous.definite:
        return None
    return continuous


def _finished(
    equation: Riccati, trial: _Trial, modes: ModalMatrix | Powers | None, method: str
) -> Solution | None:
    K = equation.gain(trial.P)
    F = equation.A - equation.B @ K
    poles = modes.poles(F) if modes else np.linalg.eigvals(F)
    solution = solved(
        trial.P,
        K,
        poles,
        trial.residual,
        method,
        rounding=trial.rounding,
        discrete=equation.discrete,
    )
    if solution.margin > 0.0:
        return solution
    return None


def _refined(
    equation: Riccati, P: Array, modes: ModalMatrix | Powers | None
) -> tuple[_Trial, ModalMatrix | Powers | None]:
    """Refine P by Newton steps; `modes` belong to a loop near the closed loop of P, or are None."""
    enough = 0.5 * _EPS * len(P) ** 0.5
    trial = best = equation.trial(P)
    fresh = False
    for _ in range(_STEPS):
        if best.residual <= enough:
            break
        if modes is None:
            F = equation.A - equation.B @ equation.gain(trial.P)
            modes = _solver_of(F, equation.discrete)
            fresh = True
        better = equation.trial(trial.P + modes.lyapunov(trial.defect))
        gain = trial.residual / max(better.residual, _TINY)
        # Far from the solution, a Newton step may improve P although the residual rises. Such a
        # step is accepted.
        if gain > 1.0 or (fresh and trial.residual > _NEAR):
            trial = better
        if trial.residual < best.residual:
            best = trial
        if trial.residual < max(_ROUNDED, trial.rounding):
            if gain < 2.0:
                break
        elif gain < 10.0:
            # Progress is slow if the modes belong to a loop that differs too much from the loop of
            # the current P. New modes are then computed. If the modes were computed here before,
            # and the latest step was still rejected, the refinement ends.
            if fresh and trial is not better:
                break
            modes = None
    return best, modes


def _general(equation: Riccati, unit: bool) -> Array:
    """Return the solution P from SciPy.

    If `unit` is True, scale the inputs so that R is I, because SciPy treats a badly scaled R as
    singular.
    """
    from scipy.linalg import solve_continuous_are, solve_discrete_are

    solver = solve_discrete_are if equation.discrete else solve_continuous_are
    B, R, N = equation.B, equation.R, equation.N
    if unit:
        B = dtrtrs(equation.R_factor, B.T, lower=1)[0].T
        if N is not None:
            N = dtrtrs(equation.R_factor, N.T, lower=1)[0].T
        R = np.eye(len(R))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ill-conditioning shows in the residual
        P: Array = solver(equation.A, B, equation.Q, R, s=N)
    return 0.5 * (P + P.T)


def _norm(matrix: Array) -> float:
    flat = matrix.ravel()
    return float(np.sqrt(flat.dot(flat)))


class ModalMatrix:
    """Modes V (n, n) of a real matrix F; conjugate modes are adjacent columns."""

    def __init__(
        self, V: Values, poles: Values, discrete: bool, inverse: Values | None = None
    ) -> None:
        self.V = V
        self.inverse = np.linalg.inv(V) if inverse is None else inverse
        self.values = poles
        across = poles.conj()[:, None]
        sums = across + poles
        if discrete:
            sums = across * poles - 1.0
        self._factors = -1.0 / sums

    @classmethod
    def of(cls, F: Array, discrete: bool) -> ModalMatrix:
        """Compute the modes of a matrix."""
        poles, V = np.linalg.eig(F)
        return cls(V, poles, discrete)

    def sampled(self) -> ModalMatrix:
        """Return the modes of the sampled loop, if these are the modes after `_bilinear`.

        By (10.6), both loops have the same modes. A pole s becomes (1 + s) / (1 - s).
        """
        poles = (1.0 + self.values) / (1.0 - self.values)
        return ModalMatrix(self.V, poles, discrete=True, inverse=self.inverse)

    def lyapunov(self, r: Array) -> Array:
        """Return D with F' D + D F = -r (discrete: F' D F - D = -r); r (n, n) must be symmetric."""
        return self.lyapunov_modal(self.V.conj().T @ r @ self.V)

    def lyapunov_modal(self, r: Values) -> Array:
        """Return the same D as `lyapunov`, but from r in modal coordinates, which is V^H r V."""
        # In modal coordinates, each entry of D is the corresponding entry of r times a factor.
        D: Array = (self.inverse.conj().T @ (r * self._factors) @ self.inverse).real
        return 0.5 * (D + D.T)

    def poles(self, F: Array) -> Values:
        """Return the eigenvalues of F, without an eigenproblem if the modes V decouple F."""
        M = self.inverse @ F @ self.V
        values = M.diagonal().astype(complex)
        M.flat[:: len(M) + 1] = 0.0
        # The diagonal entries approximate the eigenvalues. Divide each column of the off-diagonal
        # part M by its approximate eigenvalue. By the Bauer-Fike theorem, the norm of the result
        # bounds the relative errors of the eigenvalues.
        # A zero on the diagonal gives NaN, which fails the comparison too.
        if not np.linalg.norm(M / np.abs(values)) <= 1e-7:
            return np.linalg.eigvals(F)
        real = self.values.imag == 0.0
        first = np.flatnonzero(self.values.imag)[::2]
        values[real] = values[real].real
        values[first + 1] = values[first].conj()
        return values


class Powers:
    """Solver for the Lyapunov equation of a sampled loop F (n, n), from powers of F.

    Unlike `ModalMatrix`, it is accurate if F has multiple poles without as many modes, such as the
    poles at zero of delayed inputs.
    """

    def __init__(self, F: Array) -> None:
        self.F = F

    def lyapunov(self, r: Array) -> Array:
        """Return the sum D of (F')^k r F^k over all k >= 0, so that F' D F - D = -r."""
        D, power = r, self.F
        for _ in range(_DOUBLINGS):
            D = D + power.T @ D @ power
            power = power @ power
            if not _norm(power) > _EPS:
                break
        return 0.5 * (D + D.T)

    def poles(self, F: Array) -> Values:
        """Return the eigenvalues of F."""
        return np.linalg.eigvals(F)


def _solver_of(F: Array, discrete: bool) -> ModalMatrix | Powers:
    """Return the modes of a loop, or its powers if the modes of a sampled loop nearly coincide."""
    if not discrete:
        return ModalMatrix.of(F, discrete)
    try:
        modes = ModalMatrix.of(F, discrete)
    except np.linalg.LinAlgError:
        return Powers(F)
    if np.linalg.norm(modes.V) * np.linalg.norm(modes.inverse) < _INDEPENDENT:
        return modes
    return Powers(F)


def _inverse(matrix: Array) -> Array | None:
    """Return the inverse of a matrix, or None if the matrix is singular or nearly singular."""
    diagonal = matrix.diagonal()
    if np.count_nonzero(matrix) == np.count_nonzero(diagonal):
        if not diagonal.all():
            return None
        return np.diag(1.0 / diagonal)
    if not np.linalg.cond(matrix) <= 1e8:
        return None
    return np.linalg.inv(matrix)


def second_order_loop(
    A: Array, B: Array, Q: Array, R_factor: Array
) -> tuple[ModalMatrix, Values] | None:
    """Return the loop that is optimal if the odd powers of the poles in (10.5) are neglected.

    The results are the modes V of the closed loop, and the cost matrix V^H (Q + K' R K) V for the
    gain K of this loop. Return None if there is no such loop, for example because the model is not
    of second order.
    """
    nx = len(A)
    m = nx // 2
    if nx != 2 * m or B[:m].any():
        return None
    white = _lower(R_factor, B[m:].T)
    # Ls Ls' is the effect B R^-1 B' of the inputs on the velocities. Ls is computed without this
    # product, because the product would square the condition number.
    triangle = np.asarray(np.linalg.qr(white, mode="r"))
    Ls = triangle.T
    sizes = np.abs(Ls.diagonal())
    singular = len(white) < m or sizes.min() <= 1e-14 * sizes.max()
    A11, A12 = A[:m, :m], A[:m, m:]
    inverse = _inverse(A12)
    if singular or inverse is None:
        return None
    # x = T (p, dp/dt)
    T = np.zeros((nx, nx))
    T[:m, :m] = A12 @ Ls
    T[m:, m:] = Ls
    plain = not (A11.any() or A[m:].any())
    if not plain:
        T[m:, :m] = -inverse @ A11 @ T[:m, :m]
    weight = T.T @ Q @ T
    S, D = weight[:m, :m], weight[m:, m:]
    if not plain:
        F = _lower(Ls, A[m:] @ T[:, :m])
        H = _lower(Ls, inverse @ A11 @ T[:m, :m] + A[m:, m:] @ Ls)
        S, D = S + F.T @ F, D + H.T @ H + F + F.T
    G, indefinite = dpotrf(S, lower=1)
    if indefinite:
        return None
    squares, W = np.linalg.eig(np.block([[np.zeros((m, m)), G.T], [-G, D]]))
    if ((squares.imag == 0.0) & (squares.real <= 0.0)).any():
        return None
    poles = -np.sqrt(squares)
    # The lower half of each eigenvector is the acceleration a of a mode. The position is a divided
    # by `squares`, and the rate is a divided by `poles`.
    a = W[m:]
    motion = np.concatenate((a / squares, a / poles))
    if not plain:
        a = a - F @ motion[:m] - H @ motion[m:]
    cost = motion.conj().T @ weight @ motion + a.conj().T @ a
    return ModalMatrix(T @ motion, poles, discrete=False), cost


def _lower(factor: Array, right: Array) -> Array:
    solution: Array = dtrtrs(factor, right, lower=1)[0]
    return solution
