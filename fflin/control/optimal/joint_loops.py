r"""Closed loops of the joints that rotate a free-floating base.

Without angular momentum, the base of a free-floating robot rotates by :math:`\omega_b = W(q_m)\,
\dot q_m`. If two joints move in a small closed loop, the base rotates by the area of the loop in
the plane of the joints i and j, times the curvature

.. math::
    F_{ij} = \partial_i W_j - \partial_j W_i + W_i \times W_j

in base axes. The search for a loop begins at ellipses of two directions of the joints, chosen by
this area rule, and improves their Fourier coefficients by nonlinear least squares.

References
----------
C. Fernandes, L. Gurvits and Z. X. Li, Near-optimal nonholonomic motion planning for a system of
coupled rigid bodies, IEEE Transactions on Automatic Control 39(3), 1994.

R. M. Murray, Z. Li and S. S. Sastry, A Mathematical Introduction to Robotic Manipulation, 1994,
chapter 7.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pinocchio as pin
from scipy.optimize import least_squares

from fflin.base.validation import Array, Indices, Mask
from fflin.control.optimal.floating_base import FloatingBase

# Step of the joint positions [rad, m] in the central differences of the curvature.
_STEP = 1e-4

# A direction counts as spanned by vectors if its singular value is above _SPANNED times the largest
# one. A largest value below _LEAST_COUPLING means that the joints do not rotate the base.
_SPANNED, _LEAST_COUPLING = 1e-9, 1e-6

# The joints make up to MOST_CIRCLES circles, each of which is integrated in STEPS steps.
MOST_CIRCLES, STEPS = 8, 48

# Number of postures at which the curvature is evaluated, and number of ellipses that are improved.
_POSTURES, _IMPROVED = 12, 3

# Largest amplitude of a joint [rad, m], if its limits allow it.
_LARGEST = 1.0

# Weight of the root mean square of the torques in the least squares, relative to the error of the
# attitude. The torques of the best ellipse count as 1, and so does the rotation from the end of the
# path to the target. A large weight would leave an error.
_OF_TORQUES = 0.05

# An error of the attitude below this fraction of the rotation is left to the search for the plan.
_NEAR = 0.03

# Largest number of evaluations of the Jacobian in a least-squares problem.
_EVALUATIONS = 40


def curvature(base: FloatingBase, joints: Array) -> Array:
    """Return the curvature F (n, n, 3) at joint positions (n,).

    A small loop of the joints, whose oriented area in the plane of the joints i and j is S[i, j],
    rotates the base by the vector ``sum(F[i, j] * S[i, j])`` over all i < j, in base axes.
    """
    n = len(joints)
    steps = _STEP * np.eye(n)
    W = base.terms(np.vstack((joints, joints + steps, joints - steps))).coupling
    # [i, :, j]: derivative of W_j by i
    derivatives = (W[1 : n + 1] - W[n + 1 :]) / (2.0 * _STEP)
    jacobian = derivatives.transpose(0, 2, 1)
    columns = W[0].T
    bracket = np.cross(columns[:, None], columns[None])
    F: Array = jacobian - jacobian.transpose(1, 0, 2) + bracket
    return F


def best_plane(F: Array, rotation: Array, scale: Array) -> tuple[Array, Array, float]:
    """Return the two directions (n,) of the joints whose loops rotate the base the most.

    The rotation about the vector `rotation` (3,) is compared for loops of equal area, if each joint
    is measured in units of `scale` (n,). The directions a and b are orthonormal in these units. The
    third result is the angle [rad] by which a loop of unit area, oriented from a to b, rotates
    about it.
    """
    about = F @ (rotation / np.linalg.norm(rotation))
    values, vectors = np.linalg.eigh(1j * scale[:, None] * about * scale)
    vector = vectors[:, -1]
    # With the largest eigenvalue s and its eigenvector x + i y: F x = s y, and F y = -s x.
    a, b = np.sqrt(2.0) * vector.imag, np.sqrt(2.0) * vector.real
    return a, b, float(values[-1])


def rotation_axes(base: FloatingBase, postures: Array) -> Array:
    """Return an orthonormal basis (k, 3) of the angular velocities that joint rates can produce.

    The angular velocities are in base axes, and are collected over the joint positions `postures`
    (N, n). The angular momentum is zero.
    """
    W = base.terms(postures).coupling
    columns = W.transpose(0, 2, 1).reshape(-1, 3)
    _, sizes, axes = np.linalg.svd(columns, full_matrices=False)
    spanned: Array = axes[sizes > _SPANNED * max(float(sizes[0]), _LEAST_COUPLING)]
    return spanned


@dataclass(frozen=True)
class Loops:
    """Loops of some joints along a given path of all joints.

    The loops are Fourier series of an angle that grows from 0 to 2 pi. Its rate is zero at both
    ends, so the loops do not change the joint rates there.
    """

    base: FloatingBase
    t: Array  # equally spaced times (K,), with K - 1 = STEPS * MOST_CIRCLES
    path: Array  # joint positions (K, n) to which the loops are added
    moved: Indices  # indices of the joints that move in loops (m,)
    target: Array  # rotation (3, 3) of the base at the end
    # components (3,) of the rotation vector of the attitude error that must vanish
    asked: Mask
    # limits of the joint positions and rates (2, 2, n): lower and upper, then kind
    bounds: Array
    weights: Array  # weights of the squared torques of the joints `moved` (m,)

    @cached_property
    def scale(self) -> Array:
        """Amplitudes (m,) of the joints that use half of the range, but at most `_LARGEST`."""
        low, high = self.bounds[:, 0, self.moved]
        scale: Array = np.clip(0.5 * (high - low), 1e-3, _LARGEST)
        return scale

    def basis(self, circles: int) -> Array:
        """Return the four Fourier functions (K, 4) with one and two circles per period.

        There are `circles` periods.
        """
        s = (self.t - self.t[0]) / (self.t[-1] - self.t[0])
        phase = 2.0 * np.pi * circles * s**2 * (3.0 - 2.0 * s)
        columns = [
            1.0 - np.cos(phase),
            np.sin(phase),
            1.0 - np.cos(2 * phase),
            np.sin(2 * phase),
        ]
        return np.array(columns).T

    def joints(self, basis: Array, coefficients: Array) -> Array:
        """Return the joint positions (K, n) for the coefficients (4, m), in units of `scale`."""
        joints = self.path.copy()
        joints[:, self.moved] += basis @ (coefficients * self.scale)
        return joints

    def error(self, joints: Array) -> Array:
        """Return the rotation vector (3,) from the attitude at the end to the target.

        It is in base axes. Components that are not asked for are zero.
        """
        R = self.base.rotations(self.t, joints)[-1]
        error: Array = np.asarray(pin.log3(R.T @ self.target)) * self.asked
        return error

    def beyond(self, joints: Array) -> Array:
        """Return the violations (K - 1, 2, m) of the limits, relative to `scale`."""
        rates = np.diff(joints, axis=0) / np.diff(self.t)[:, None]
        values = np.stack((joints[1:], rates), axis=1)[..., self.moved]
        low, high = self.bounds[..., self.moved]
        excess = np.maximum(np.maximum(values - high, low - values), 0.0)
        # The rate of a loop is its amplitude times 2 pi / duration.
        relative: Array = excess / (self.scale * [[1.0], [2.0 * np.pi / self.t[-1]]])
        return relative

    def torques(self, basis: Array, coefficients: Array) -> Array:
        """Return weighted torques (4, m) whose sum of squares is the mean effort of the loops.

        The inertia is computed at the middle of the path, and terms quadratic in the rates are
        ignored.
        """
        inertia = self.base.inertia(self.middle)[np.ix_(self.moved, self.moved)]
        rates = np.gradient(basis, self.t, axis=0)
        factor = np.linalg.qr(np.gradient(rates, self.t, axis=0), "r") / np.sqrt(
            len(self.t)
        )
        torques: Array = (
            factor @ (coefficients * self.scale) @ inertia * np.sqrt(self.weights)
        )
        return torques

    @property
    def middle(self) -> Array:
        """Joint positions (n,) in the middle of the path."""
        middle: Array = self.path[len(self.path) // 2].copy()
        return middle

    def ellipses(self, circles: int, postures: Array) -> Iterator[Array]:
        """Yield coefficients (4, m) of ellipses whose centres are near the given postures.

        `postures` (P, m) are displacements from the middle of the path, in units of `scale`. The
        areas of the ellipses follow from the curvature at the postures.
        """
        rotation = self.error(self.path)
        angle = float(np.linalg.norm(rotation))
        for posture in postures:
            joints = self.middle
            joints[self.moved] += posture * self.scale
            F = curvature(self.base, joints)[np.ix_(self.moved, self.moved)]
            a, b, most = best_plane(F, rotation, self.scale)
            radius = min(np.sqrt(angle / (np.pi * circles * max(most, 1e-12))), 1.0)
            # The path is on the ellipse. Select the point of the ellipse that is farthest away from
            # the posture, or try several points if the posture is the path itself.
            toward = np.arctan2(posture @ b, posture @ a)
            phases = np.arange(8) * np.pi / 4.0
            if posture.any():
                phases = np.array([toward])
            for phase in phases:
                first = np.cos(phase) * a + np.sin(phase) * b
                second = np.cos(phase) * b - np.sin(phase) * a
                # The loop first (1 - cos) + second sin is oriented from `second` to `first`.
                yield radius * np.array((first, -second, 0.0 * first, 0.0 * first))

    def best(self, most_circles: int) -> tuple[Array, float]:
        """Return the joint positions (K, n) of the best loops, and their error.

        The error is the sum of the attitude error [rad] at the end, and of the largest violation of
        a limit relative to `scale`. Loops with few circles are preferred, because they need less
        effort. The path without loops must miss the target.
        """
        near = _NEAR * float(np.linalg.norm(self.error(self.path)))
        postures = np.random.default_rng(0).uniform(
            -1.0, 1.0, (_POSTURES, len(self.moved))
        )
        postures[0] = 0.0
        best = self.path
        least = np.inf
        circles = 1
        while circles <= most_circles and least > near:
            # Optimise on a coarser grid with STEPS steps per circle, which is faster. The results
            # are judged on the whole grid.
            stride = MOST_CIRCLES // circles
            coarse = replace(self, t=self.t[::stride], path=self.path[::stride])
            least_effort = np.inf
            for coefficients in coarse.improved(circles, postures):
                basis = self.basis(circles)
                joints = self.joints(basis, coefficients)
                attitude_error = np.linalg.norm(self.error(joints))
                error = float(attitude_error + self.beyond(joints).max())
                effort = float(np.square(self.torques(basis, coefficients)).sum())
                # Prefer a small error. Errors below `near` count as equal; then prefer a small
                # effort.
                if (max(error, near), effort) < (max(least, near), least_effort):
                    best, least, least_effort = joints, error, effort
            circles *= 2
        return best, least

    def improved(self, circles: int, postures: Array) -> Iterator[Array]:
        """Yield the coefficients (4, m) of the best ellipses, improved by least squares."""
        basis = self.basis(circles)

        def error(coefficients: Array) -> Array:
            """Return the error of the attitude and the violations of limits."""
            joints = self.joints(basis, coefficients)
            return np.concatenate(
                (self.error(joints), self.beyond(joints).max(axis=0).ravel())
            )

        ellipses = sorted(
            self.ellipses(circles, postures),
            key=lambda candidate: float(np.linalg.norm(error(candidate))),
        )[:_IMPROVED]
        angle = float(np.linalg.norm(self.error(self.path)))
        size = float(np.linalg.norm(self.torques(basis, ellipses[0])))
        unit = _OF_TORQUES * angle / size

        def residuals(flat: Array) -> Array:
            coefficients = flat.reshape(4, -1)
            torques = unit * self.torques(basis, coefficients)
            return np.concatenate((error(coefficients), torques.ravel()))

        for ellipse in ellipses:
            solution = least_squares(
                residuals, ellipse.ravel(), max_nfev=_EVALUATIONS, ftol=1e-4, xtol=1e-4
            )
            yield solution.x.reshape(4, -1)
