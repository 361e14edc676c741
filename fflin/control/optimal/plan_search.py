"""Search for a plan by sequential quadratic programming with multiple shooting."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from fflin.base.errors import InputError, optional_package
from fflin.base.validation import Array, Indices, Mask
from fflin.control.optimal.shooting import Charts, Point, Shooting
from fflin.linear.optimality import Optimality

# A plan is accepted if the sum of its violations of the goal and the limits [rad, m, s] is at most
# this.
_ENDS = 1e-8

# Within the intervals, a limit applies only where it is needed. If an iterate exceeds the limit at
# a point within an interval by more than _LIMITED times the limit, the limit applies at this point
# and its neighbours from then on. At these points, the limit is tightened by the fraction _TIGHTER,
# because the motion may exceed the limit between the points.
_LIMITED, _TIGHTER = 0.002, 0.005

# If no gap between intervals exceeds this, the gaps count as closed, and the plan is integrated as
# one motion.
_MEETS = 1e-10

# Gaps of a plan that is integrated as one motion, relative to the largest velocity plus 1.
_JOINED = 1e-13

# After a plan is first integrated as one motion, its violations are corrected only if their sum
# is at most half of this value. Later sums must be at most half of the previous sum.
_NEARLY = 1e-3

# Accuracy [rad, m, s] of the integration over an interval: _SEEKS during the search, and _FLIES
# while the gaps are closed.
_SEEKS, _FLIES = 1e-6, 1e-8

# The search ends after _MOST iterations, or if _MOST_TRIES steps fail to reduce the merit function.
# It ends earlier if an iteration adds no limit within the intervals, and the predicted reduction of
# the merit function is at most _SAVED times its value, with a small Levenberg-Marquardt cost. The
# gaps are closed in at most _MOST_CLOSING iterations.
_SAVED, _MOST, _MOST_TRIES, _MOST_CLOSING = 1e-6, 100, 8, 20

# A step is corrected up to _MOST_CORRECTIONS times, until the merit function falls by _ENOUGH times
# the predicted reduction. It is accepted if the merit function falls by _SOME times the predicted
# reduction. A step that is not predicted to reach the goal is not corrected.
_MOST_CORRECTIONS, _ENOUGH, _SOME = 4, 0.5, 0.1

# The Levenberg-Marquardt cost is multiplied by _LESS after a step that reduces the merit function
# by _MUCH times the predicted reduction, and by _MORE after a step that fails. It is at least
# _LEAST times its first value, because the solver may fail without it.
_LESS, _MUCH, _MORE, _LEAST = 0.2, 0.75, 4.0, 1e-4

# Levenberg-Marquardt cost of a step of the wheel angles and rates, relative to this cost for the
# other states. It is small, because wheels may turn far and fast.
_OF_WHEELS = 1e-6

# After each quadratic program, the predicted violations of the goal and of the limits at the knots
# are summed [rad, m, s]. The search fails if this sum stays above _HOPELESS for _STAGNANT
# iterations without falling by a tenth. Smaller violations are due to the finite penalty, and
# vanish when the gaps are closed.
_STAGNANT, _HOPELESS = 10, 1e-2

# Cost of a violation of the goal or a limit, per unit of the sum of violations [rad, m, s]. For
# comparison, the effort of the initial guess costs 1/2. If a search ends with violations, because
# they cost less than the effort that avoids them, it is repeated from there with a cost that is
# _RAISE times larger, up to _LARGEST_PRICE.
_PRICE, _RAISE, _LARGEST_PRICE = 1e3, 30.0, 1e8


class Trial(NamedTuple):
    """Knots and inputs of a trial, with gaps between intervals and distances from the limits."""

    q: Array  # (N + 1, nq)
    v: Array  # (N + 1, nv)
    u: Array  # (N + 1, nu)
    missed: Array  # gaps between intervals (N, nx)
    knots: Array  # how far the knots may move down and up (2, N + 1, nx)
    inside: Array  # the same for points within intervals (2, N, parts - 1, nx)

    @property
    def gap(self) -> float:
        """Largest gap between intervals."""
        return float(np.abs(self.missed).max())

    def outside(self, limited: Mask) -> float:
        """Return the sum of the violations of the goal and the limits.

        Limits are checked at the knots, and at the points within intervals in the mask `limited`.
        """
        return float(excess(self.knots).sum() + excess(self.inside)[limited].sum())


class Models(NamedTuple):
    """Linear models along a trial, and its limits as rows of the quadratic program."""

    charts: Charts  # independent coordinates of the steps of the knots
    ends: Array  # Jacobians of the interval ends (N, nz, nz + 2 nu)
    rows: sp.csr_array  # one row for each limit
    at_knots: tuple[Indices, Indices]  # knot and state of the first rows
    # interval, part and state of the other rows
    within: tuple[Indices, Indices, Indices]

    def distances(self, trial: Trial) -> Array:
        """Return how far the limited states may move down and up (2, m), in the order of `rows`."""
        knot, state = self.at_knots
        at_knots = trial.knots[:, knot, state]
        interval, part, state = self.within
        inside = trial.inside[:, interval, part, state]
        distances: Array = np.hstack((at_knots, inside))
        return distances


class Step(NamedTuple):
    """Steps to the solution of a quadratic program, with its multipliers."""

    z: Array  # steps of the knots (N + 1, nx)
    du: Array  # steps of the inputs (N + 1, nu)
    gaps: Array  # multipliers of the gaps (N, nx)
    outside: float  # sum of the violations of the goal and the limits after the step
    # of the Lagrangian before the step, with respect to the inputs (N + 1, nu)
    gradient: Array
    # sum of products of multipliers and distances from the limits
    complementarity: float
    moved: Array  # displacements of the rows of the limits (m,)


class Search(NamedTuple):
    """Search for the inputs of least effort from a start state to an end state."""

    # The Hessian is the Gauss-Newton approximation. As in the Levenberg-Marquardt method, a step of
    # the states has an additional cost, which is reduced after a step that keeps its promise and
    # raised after a step that does not. The linear models miss the curvature of the motion, so that
    # a long step opens gaps. Second-order corrections close them; without them, the merit function
    # would only accept short steps (Maratos effect).

    shooting: Shooting
    start: Point
    end: Point
    asked: Mask  # states whose value at the end is prescribed (nx,)
    # An error of a state at the end counts this many times (nx,).
    importance: Array
    determining: Mask  # prescribed states (nx,) that determine all of them near the end
    bounds: Array  # limits of states (2, nx)
    limits: Array  # limits of inputs (2, nu)
    size: Array  # magnitudes of the limits of states (nx,), 0 for states without limits
    cost: Array  # weights of squared inputs (N + 1, nu)
    # number of equal parts per interval; limits can apply at the end of each part
    parts: int
    report: Callable[[str], None]  # receives a line of text in each iteration
    price: float = _PRICE

    def best(
        self, q: Array, v: Array, u: Array, iterations: int = 0
    ) -> tuple[Trial, Optimality | None]:
        """Return the trial of least effort, and how nearly it is stationary.

        The search begins at the knots q, v and the inputs u. If the search fails, return the motion
        under the last inputs, and None. The effort is the sum of ``cost * u**2``. `iterations` is
        the number of earlier iterations.
        """
        shooting = self.shooting
        cost = self.cost
        u = np.clip(u, *self.limits)
        shooting.refine(q, v, u, _SEEKS)
        near = self._damping_of_steps() / len(q)
        first = near
        trial = self._trial(q, v, u)
        limited = self._exceeding(trial)
        price = 0.0 * trial.missed
        left = list[float]()
        iteration = 0
        for iteration in range(_MOST):
            self._report(f"iteration {iteration + 1}", trial, limited)
            models = self._models(trial, limited)
            if models is None:
                return self._flown(trial.u), None
            moved = step = None
            small = False
            for attempt in range(_MOST_TRIES):
                step = self._step(trial, models, near, cost * trial.u)
                if step is None:  # the solver failed
                    near = _MORE * near
                    continue
                if attempt == 0 and self._is_hopeless(trial, step, left):
                    return self._flown(trial.u), None
                # Powell's rule sets the penalty on gaps from the multipliers.
                y = np.abs(step.gaps)
                price = np.maximum(y, 0.5 * (price + y))
                saved = self._merit(trial, price, limited) - self._promised(trial, step)
                moved, gain, exceeding = self._corrected(
                    trial, models, near, step, price, limited, saved
                )
                if moved is None and (exceeding & ~limited).any():
                    # repeat the step with more limits within the intervals
                    moved = trial
                small = saved <= _SAVED * self._merit(trial, price, limited)
                if moved is not None or small:
                    break
                near = _MORE * near
            if moved is None:
                # After failed attempts, the reduction is small only because the cost was raised.
                if (
                    not small
                    or attempt > 0
                    or bool((near <= 1.1 * _LEAST * first).all())
                ):
                    break
                near = np.maximum(_LESS * near, _LEAST * first)
                continue
            # With a large Levenberg-Marquardt cost, a small reduction does not indicate a minimum.
            converged = small and bool((near <= 1.1 * _LEAST * first).all())
            if small or gain >= _MUCH * saved:
                near = np.maximum(_LESS * near, _LEAST * first)
            trial = moved
            known = limited
            limited = limited | exceeding
            if converged and (limited == known).all():
                break
        iterations += iteration + 1
        # A larger penalty does not help if the solver failed.
        final = self.price >= _LARGEST_PRICE or step is None
        if _ENDS < trial.outside(limited) <= _HOPELESS and not final:
            stricter = self._replace(price=_RAISE * self.price)
            return stricter.best(trial.q, trial.v, trial.u, iterations)
        trial = self._closed(trial, limited, first, left)
        return trial, self._optimality(trial, limited, first, iterations)

    def _damping_of_steps(self) -> Array:
        """Return the relative Levenberg-Marquardt cost of a step of each state (nx,)."""
        nx = self.shooting.state.nx
        wheels = list(self.shooting.wheels)
        wheels += [nx // 2 + i for i in wheels]
        return np.where(np.isin(range(nx), wheels), _OF_WHEELS, 1.0)

    def _optimality(
        self, trial: Trial, limited: Mask, near: Array, iterations: int
    ) -> Optimality | None:
        """Return how nearly a trial is stationary, or None if its multipliers are not found."""
        models = self._models(trial, limited | self._exceeding(trial))
        if models is None:
            return None
        step = self._step(trial, models, _LEAST * near, self.cost * trial.u)
        if step is None:
            return None
        effort = float((self.cost * trial.u**2).sum())
        return Optimality(
            effort=effort,
            stationarity=self._stationarity(trial.u, step.gradient),
            feasibility=max(trial.gap, float(excess(trial.knots).max())),
            complementarity=step.complementarity / (effort or 1.0),
            iterations=iterations,
        )

    def _stationarity(self, u: Array, gradient: Array) -> float:
        """Return the relative distance of the inputs from the minimum of the Lagrangian.

        The minimum is within the limits of the inputs. The curvature of the Lagrangian is taken as
        the curvature of the effort.
        """
        least = np.clip(u - gradient / self.cost, *self.limits)
        distance = float((self.cost * (u - least) ** 2).sum())
        effort = float((self.cost * u**2).sum()) or 1.0
        return float(np.sqrt(distance / effort))

    def _merit(self, trial: Trial, price: Array, limited: Mask) -> float:
        """Return the effort plus the costs of the gaps and the violations of a trial."""
        effort = float((self.cost * trial.u**2).sum()) / 2.0
        gaps = float((price * np.abs(trial.missed)).sum())
        return effort + gaps + self.price * trial.outside(limited)

    def _promised(self, trial: Trial, step: Step) -> float:
        """Return the merit function after a step, according to the linear models."""
        return (
            float((self.cost * (trial.u + step.du) ** 2).sum()) / 2.0
            + self.price * step.outside
        )

    def _corrected(
        self,
        trial: Trial,
        models: Models,
        near: Array,
        step: Step,
        price: Array,
        limited: Mask,
        saved: float,
    ) -> tuple[Trial | None, float, Mask]:
        """Return the trial after a step and its corrections, and how much the merit function falls.

        The third result is `limited` and the points within intervals at which a trial exceeds a
        limit. Return None if the merit function does not fall enough, compared with the predicted
        reduction `saved`.
        """
        # A correction solves the quadratic program again, with the gaps and violations at the end
        # of the step added to the models.
        before = self._merit(trial, price, limited)
        missed = trial.missed
        effort = self.cost * trial.u
        best = None
        most = -np.inf
        gap = np.inf
        exceeding = limited
        corrections = _MOST_CORRECTIONS if step.outside <= _HOPELESS else 0
        for correction in range(1 + corrections):
            u = np.clip(trial.u + step.du, *self.limits)
            end = self._trial(*self.shooting.moved(trial.q, trial.v, step.z), u)
            exceeding = exceeding | self._exceeding(end)
            gain = before - self._merit(end, price, exceeding)
            if gain >= _SOME * saved and gain > most:
                best, most = end, gain
            if (
                gain >= _ENOUGH * saved
                or not np.isfinite(gain)
                or correction == corrections
            ):
                break
            if end.gap > gap:  # the corrections do not converge
                break
            gap = end.gap
            missed = missed + end.missed
            room = models.distances(end) + step.moved
            again = self._step(trial, models, near, effort, missed, room)
            if again is None:
                break
            step = again
        return best, most, exceeding

    def _report(self, phase: str, trial: Trial, limited: Mask) -> None:
        """Report the cost relative to the cost of the guess, and the largest violation."""
        cost = float((self.cost * trial.u**2).sum())
        inside = excess(trial.inside)[limited]
        most = max(
            trial.gap, float(excess(trial.knots).max()), float(inside.max(initial=0.0))
        )
        self.report(
            f"{phase}: cost {cost:.4g} of the guess, largest violation {most:.2g}"
        )

    def _trial(self, q: Array, v: Array, u: Array) -> Trial:
        shooting = self.shooting
        motions = shooting.motions(q, v, u)
        knots = self.bounds[:, None] - shooting.limited_values(q, v)
        knots[0, 0] = -np.inf
        knots[1, 0] = np.inf
        to_end = shooting.between((q[-1], v[-1]), self.end)
        goal = self.determining
        knots[:, -1, goal] = np.clip(to_end, *knots[:, -1])[goal]
        knots[:, -1] *= self.importance
        tighter = self.bounds + _TIGHTER * np.array((self.size, -self.size))
        inside = tighter[:, None, None] - shooting.inside(motions, self.parts)[:, :-1]
        return Trial(q, v, u, shooting.missed(q, v, motions), knots, inside)

    def _exceeding(self, trial: Trial) -> Mask:
        """Return a mask (N, parts - 1, nx) of values that exceed a limit, and their neighbours."""
        beyond: Mask = excess(trial.inside) > (_LIMITED + _TIGHTER) * self.size
        near = beyond.copy()
        near[:, 1:] |= beyond[:, :-1]
        near[:, :-1] |= beyond[:, 1:]
        return near

    def _models(self, trial: Trial, limited: Mask) -> Models | None:
        """Return the linear models along a trial, or None if the motion diverges."""
        if not max(trial.outside(limited), trial.gap) < np.inf:
            return None
        try:
            charts = self.shooting.charts(trial.q, trial.v)
            ends, inside = self.shooting.jacobians(
                trial.q, trial.v, trial.u, self.parts, charts
            )
        except (InputError, np.linalg.LinAlgError):  # the motion has diverged
            return None
        # Soft limits apply to states at knots and to states within intervals. The latter depend on
        # x[k], u[k] and u[k + 1].
        knots, nu = trial.u.shape
        nz = charts.kept.shape[1]
        nw = (
            nz + nu
        )  # variables of a knot: the independent coordinates of its step, and u
        knot, state = np.nonzero(np.isfinite(trial.knots).any(axis=0))
        columns = knot[:, None] * nw + np.arange(nz)
        starts = np.arange(len(knot) + 1) * nz
        importance = np.where(knot == knots - 1, self.importance[state], 1.0)
        entries = importance[:, None] * charts.T[knot, state]
        at_knots = sp.csr_array(
            (entries.ravel(), columns.ravel(), starts),
            (len(knot), knots * nw),
        )
        at_knots.eliminate_zeros()
        k, part, inner_state = np.nonzero(limited)
        # A row of the compressed sparse matrix has nz + 2 nu entries.
        entries = inside[k, part, inner_state]
        columns = k[:, None] * nw + np.r_[:nw, nw + nz : 2 * nw]
        starts = np.arange(len(k) + 1) * (nz + 2 * nu)
        within = sp.csr_array(
            (entries.ravel(), columns.ravel(), starts), (len(k), knots * nw)
        )
        rows = sp.vstack((at_knots, within), format="csr")
        return Models(charts, ends, rows, (knot, state), (k, part, inner_state))

    def _step(
        self,
        trial: Trial,
        models: Models,
        near: Array,
        effort: Array,
        missed: Array | None = None,
        room: Array | None = None,
    ) -> Step | None:
        """Return the optimal steps of the knots and of the inputs, or None if there are none.

        `effort` is the gradient of the effort. The gaps `missed` and the distances `room` from the
        limits are by default the gaps and distances of the trial.
        """
        u = trial.u
        kept, T = models.charts
        nz = kept.shape[1]
        ends = models.ends
        rows = models.rows
        missed = trial.missed if missed is None else missed
        gaps_left = np.take_along_axis(missed, kept[1:], axis=1)
        room = models.distances(trial) if room is None else room
        prices, of_x = np.full(room.shape[1], self.price), np.zeros((len(u), nz))
        cost, g = np.hstack((of_x + near[kept], self.cost)), np.hstack((of_x, effort))
        scale = np.concatenate((np.ones(nz), self.cost.sum(axis=0) ** -0.5))
        limits = self.limits[:, None] - u
        solution = solve_stages(
            ends, gaps_left, cost, g, limits, rows, room, prices, scale
        )
        if solution is None:
            return None
        steps, du, prices_of_gaps, multipliers = solution
        moved = rows @ np.hstack((steps, du)).ravel()
        z = (T @ steps[:, :, None])[:, :, 0]
        gaps = np.zeros_like(missed)
        np.put_along_axis(gaps, kept[1:], prices_of_gaps, axis=1)
        outside = float(excess(room - moved).sum())
        forces = (rows.T @ multipliers).reshape(len(u), -1)
        gradient = effort + forces[:, nz:] + _by_costates(ends, forces[:, :nz])
        # A goal has equal limits. Its errors count as violations.
        slack = np.where(multipliers > 0.0, room[1], -room[0]) * (room[1] > room[0])
        products = np.abs(multipliers) * np.where(
            multipliers == 0.0, 0.0, np.abs(slack)
        )
        return Step(z, du, gaps, outside, gradient, float(products.sum()), moved)

    def _is_hopeless(self, trial: Trial, step: Step, left: list[float]) -> bool:
        """Return whether the violation at the knots does not fall, see `_STAGNANT`.

        The list `left` contains the predicted violation after each quadratic program; this method
        appends a value.
        """
        moved = step.z.copy()
        moved[-1] *= self.importance
        left.append(float(excess(trial.knots - moved).sum()))
        before = np.inf
        if len(left) > _STAGNANT:
            before = left[-1 - _STAGNANT]
        return min(left[-_STAGNANT:]) > max(_HOPELESS, 0.9 * before)

    def _closed(
        self, trial: Trial, limited: Mask, near: Array, left: list[float]
    ) -> Trial:
        """Close the gaps between intervals by the smallest steps of the knots and the inputs.

        The steps also remove the violations of the goal and the limits. If a gap remains, return
        the motion under the last inputs.
        """
        shooting = self.shooting
        last = _NEARLY
        shooting.refine(trial.q, trial.v, trial.u, _FLIES)
        trial = self._trial(*trial[:3])
        for _ in range(_MOST_CLOSING):
            limited = limited | self._exceeding(trial)
            self._report("closing the gaps", trial, limited)
            if trial.gap <= _MEETS and trial.outside(limited) <= _ENDS:
                one = self._joined(trial)
                limited = limited | self._exceeding(one)
                before = last
                last = one.outside(limited)
                if last <= _ENDS:
                    return one
                # `one` is the plan, integrated as one motion. If its violation is more than half of
                # the previous violation, errors grow too fast along the motion to be corrected, and
                # the trial with separate intervals is returned.
                if not last <= 0.5 * before:
                    return trial
                trial = one
            models = self._models(trial, limited)
            if models is None:
                break
            step = self._step(trial, models, near, 0.0 * trial.u)
            if step is None or self._is_hopeless(trial, step, left):
                break
            u = np.clip(trial.u + step.du, *self.limits)
            trial = self._trial(*shooting.moved(trial.q, trial.v, step.z), u)
        if trial.gap <= _MEETS:
            return trial
        return self._flown(trial.u)

    def _joined(self, trial: Trial) -> Trial:
        """Return the trial whose motion has no gaps, for a trial with small gaps."""
        joined = self.shooting.joined(self.start, *trial[:3], _JOINED)
        if joined is None:
            return self._flown(trial.u)
        one = self._trial(*joined, trial.u)
        return one._replace(missed=0.0 * one.missed)

    def _flown(self, u: Array) -> Trial:
        """Integrate the motion from the start under the inputs u, and return it as a trial."""
        trial = self._trial(*self.shooting.flown(self.start, u), u)
        return trial._replace(missed=0.0 * trial.missed)


def _by_costates(ends: Array, forces: Array) -> Array:
    """Return the derivative (N + 1, nu) of a function of the states with respect to the inputs.

    `forces` (N + 1, nx) contains the derivative of the function with respect to the states. For
    `ends`, see `solve_stages`.
    """
    N, nx, n = ends.shape
    nu = (n - nx) // 2
    slopes = np.zeros((N + 1, nu))
    costate = forces[N]
    for k in range(N - 1, -1, -1):
        by_end = costate @ ends[k]
        slopes[k] += by_end[nx : nx + nu]
        slopes[k + 1] += by_end[nx + nu :]
        costate = forces[k] + by_end[:nx]
    return slopes


def excess(room: Array) -> Array:
    """Return the excess (..) of values over their limits, which is 0 within the limits.

    `room` (2, ..) contains the lower and the upper limits, both minus the values.
    """
    beyond: Array = np.maximum(np.maximum(room[0], -room[1]), 0.0)
    return beyond


# Absolute and relative tolerance of the optimality conditions of the scaled quadratic program.
_ACCURACY = 1e-10


def solve_stages(
    ends: Array,
    c: Array,
    cost: Array,
    g: Array,
    limits: Array,
    rows: sp.csr_array,
    room: Array,
    prices: Array,
    scale: Array,
) -> tuple[Array, Array, Array, Array] | None:
    r"""Solve a quadratic program over N stages for w = (x, u), with hard and soft limits.

    .. math::
        \min \sum_{k=0}^N \tfrac12 w_k^T \operatorname{diag}(\mathrm{cost}_k)\,w_k + g_k^T w_k
        + \mathrm{prices}^T s, \quad
        x_{k+1} = A_k x_k + B_k u_k + D_k u_{k+1} + c_k, \quad x_0 = 0, \quad
        \mathrm{low}_k \le u_k \le \mathrm{high}_k, \quad
        \mathrm{room}_0 - s \le \mathrm{rows}\,w \le \mathrm{room}_1 + s, \quad s \ge 0

    `ends` (N, nx, nx + 2 nu) contains A, B and D side by side; D is zero if inputs are held. `cost`
    and `g` (N + 1, nx + nu) have one row for each knot, and no entry of `cost` is negative.
    `limits` (2, N + 1, nu) contains low and high. `rows` has a row for each soft limit, and a
    column for each entry of w. The program is scaled by `scale` (nx + nu,), the typical sizes of
    the entries of x and u.

    Return x (N + 1, nx), u (N + 1, nu), the multipliers (N, nx) of the equality constraints, and
    the multipliers (m,) of the soft limits, which are positive at upper limits. Return None if the
    program is infeasible or the solver fails.
    """
    piqp = optional_package("piqp", "this needs the solver PIQP", "mpc")
    (N, nx, _), (knots, nw), m = ends.shape, g.shape, len(prices)
    size = np.tile(scale, knots)
    of_rows = 1.0 / np.tile(scale[:nx], knots)
    none = sp.csc_array((N * nx, nw))
    after = np.concatenate((np.tile(-np.eye(nx), (N, 1, 1)), ends[:, :, nw:]), axis=2)
    # With an empty sparse array, the block diagonal is a sparse array in every version of SciPy.
    empty = sp.csc_array((0, 0))
    links = sp.hstack((sp.block_diag((empty, *ends[:, :, :nw])), none))
    links = links + sp.hstack((none, sp.block_diag((empty, *after))))
    first = sp.eye_array(nx, knots * nw)
    E = sp.diags_array(of_rows) @ sp.vstack((first, links)) @ sp.diags_array(size)
    # Full blocks of H are stored, including zeros. Without the zeros, PIQP would return inputs that
    # differ from 0 by rounding errors.
    H = (cost * scale**2)[:, :, None] * np.eye(nw)
    unit = H.max() or 1.0
    bounds = np.full((2, knots, nw), [[[-np.inf]], [[np.inf]]])
    bounds[:, :, nx:] = limits / scale[nx:]
    low, high = bounds.reshape(2, -1)
    # Each soft limit has a slack s: ``rows w + s >= room[0]`` and ``rows w - s <= room[1]``.
    soft = rows @ sp.diags_array(size)
    slack = sp.eye_array(m)
    open_ = np.full(m, np.inf)
    G = sp.vstack((sp.hstack((soft, slack)), sp.hstack((soft, -slack))), format="csc")
    of_G = np.append(room[0], -open_), np.append(open_, room[1])
    soft_rows = (G, *of_G) if m else (None, None, None)
    solver = piqp.SparseSolver()
    for name in ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"):
        setattr(solver.settings, name, _ACCURACY)
    solver.setup(
        sp.block_diag((*(H / unit), sp.csc_array((m, m))), format="csc"),
        np.append(g.ravel() * size, prices) / unit,
        sp.hstack((E, sp.csc_array((E.shape[0], m))), format="csc"),
        of_rows * np.append(np.zeros(nx), -c),
        *soft_rows,
        np.append(low, np.zeros(m)),
        np.append(high, open_),
    )
    if solver.solve() != piqp.PIQP_SOLVED:
        return None
    result = solver.result
    w = (result.x[: len(size)] * size).reshape(knots, nw)
    y = (unit * of_rows * result.y).reshape(knots, nx)[1:]
    multipliers = np.zeros(0)
    if m:
        multipliers = unit * (result.z_u[m:] - result.z_l[:m])
    return w[:, :nx], np.clip(w[:, nx:], *limits), y, multipliers
