"""Models of slowly varying disturbances and sensor biases, which extend the state of a model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from fflin.base.errors import InputError
from fflin.base.names import by_name, input_keys, matching
from fflin.base.validation import (
    Array,
    dimension,
    instance,
    number,
    positive,
    quantity,
)
from fflin.control.estimator import BIAS, DISTURBANCE
from fflin.dynamics.integrators import held_cost, held_exponential
from fflin.linear.linearization import linearize
from fflin.linear.model import LinearModel
from fflin.robot.inputs import BaseForce, BaseTorque, JointTorque

# Groups of generalised forces, by the group of the velocity on which they act.
_FORCES = {"omega_b": "tau_b", "v_b": "F_b", "qdot_m": "tau_m"}


@dataclass(frozen=True)
class AddedStates:
    """Added states s of a model: ``dx/dt = ... + B s``, ``y = ... + C s``, ``ds/dt = A s + noise``.

    In the equations of a sampled model, the left sides are the values at the next sample.

    Attributes
    ----------
    names : tuple of str (k,)
    A, B, C : ndarray (k, k), (nx, k), (ny, k)
    W : ndarray (nx + k, nx + k)
        Intensity of the noise on (x, s), or its covariance per sample.
    size : ndarray (k,)
        Square roots of the intensities, which scale the added states.
    poles : tuple of complex
        The different poles of A, one of each conjugate pair.
    """

    names: tuple[str, ...]
    A: Array
    B: Array
    C: Array
    W: Array
    size: Array
    poles: tuple[complex, ...]

    def extend(self, A: Array, C: Array, S: Array, seen: Array) -> tuple[Array, Array]:
        """Return A and C of the states S x with the outputs `seen` y, extended by the states."""
        nothing = np.zeros((len(self.A), len(A)))
        extended = np.block([[A, S @ self.B], [nothing, self.A]])
        return extended, np.hstack((C, seen @ self.C))

    def padded(self, more: int) -> AddedStates:
        """Return the added states for a model with `more` last states that they do not affect."""
        if not more:
            return self
        nx = len(self.B)
        rows = np.zeros((more, len(self.A)))
        whole = np.delete(np.arange(len(self.W) + more), np.s_[nx : nx + more])
        W: Array = np.zeros((len(self.W) + more,) * 2)
        W[np.ix_(whole, whole)] = self.W
        return replace(self, B=np.vstack((self.B, rows)), W=W)


def added_states(
    lin: LinearModel,
    disturbance_noise: Mapping[str, float] | None,
    biases: Mapping[int, float],
    disturbance_frequency: Mapping[str, float | Sequence[float]] | None,
) -> AddedStates:
    """Return the states of disturbances and biases with the arguments of `kalman`.

    `biases` contains the result of `bias_intensities`.
    """
    forces, frequencies = _chosen_forces(lin, disturbance_noise, disturbance_frequency)
    to_x, to_y = _force_columns(lin, tuple(forces))
    names, size, rates = list[str](), list[float](), [0.0]
    blocks, acting = list[Array](), [np.zeros((len(forces), 0))]
    for unit, (key, intensity) in zip(np.eye(len(forces)), forces.items(), strict=True):
        for frequency in (0.0, *frequencies.get(key, ())):
            labels, block, weights = _signal(f"{DISTURBANCE}{key}", frequency)
            names += labels
            size += [math.sqrt(intensity)] * len(labels)
            blocks.append(block)
            acting.append(np.outer(unit, weights))
            rates.append(2.0 * math.pi * frequency)
    force = np.hstack(acting)
    names += [f"{BIAS}{lin.output_names[i]}" for i in biases]
    size += [math.sqrt(intensity) for intensity in biases.values()]
    A: Array = block_diag(*blocks, np.zeros((len(biases), len(biases))))
    B: Array = np.hstack((to_x @ force, np.zeros((len(lin.A), len(biases)))))
    C = np.hstack((to_y @ force, np.eye(len(lin.C))[:, list(biases)]))
    scale: Array = np.array(size)
    noise: Array = block_diag(np.zeros_like(lin.A), np.diag(scale**2))
    poles = tuple(complex(0.0, rate) for rate in dict.fromkeys(rates))
    if lin.dt:
        A, B, noise = _sampled(lin, A, B, scale)
        poles = tuple(complex(np.exp(pole * lin.dt)) for pole in poles)
    return AddedStates(tuple(names), A, B, C, noise, scale, poles)


def _signal(name: str, frequency: float) -> tuple[list[str], Array, Array]:
    """Return the state names, A (k, k) and C (k,) of a constant or of a sinusoid [Hz]."""
    if not frequency:
        return [name], np.zeros((1, 1)), np.ones(1)
    rate = 2.0 * math.pi * frequency
    label = f"{name}.{frequency:g}Hz"
    # The second state of a sinusoid has no effect by itself.
    A = np.array([[0.0, rate], [-rate, 0.0]])
    return [label, f"{label}.quadrature"], A, np.array([1.0, 0.0])


def _sampled(
    lin: LinearModel, A: Array, B: Array, size: Array
) -> tuple[Array, Array, Array]:
    """Return A, B and the noise covariance of the added states over one sample, exactly."""
    nx = len(lin.A)
    source = lin.generator
    if source is None:
        # Biases alone do not act on the state, so the continuous model is not needed.
        if B.any():
            raise InputError(
                "the sampled model does not contain its continuous model, which disturbances "
                "between samples need; use lin.discretize(dt) of the continuous model"
            )
        noise = np.concatenate((np.zeros(nx), lin.dt * size**2))
        return np.eye(len(A)), B, np.diag(noise)
    # The states are scaled, so that all noise has the intensity 1 and B has entries up to 1.
    # Otherwise, rounding errors could exceed the smallest intensities.
    largest = float(np.abs(B * size).max(initial=0.0)) or 1.0
    scale = np.concatenate((np.full(nx, largest), size))
    whole = np.block([[source.A, B], [np.zeros((len(A), nx)), A]])
    whole = whole * scale / scale[:, None]
    unit = np.diag(np.concatenate((np.zeros(nx), np.ones(len(A)))))
    step, _ = held_exponential(whole, whole[:, :0], lin.dt)
    step = step * scale[:, None] / scale
    noise = held_cost(whole.T, unit, lin.dt) * scale * scale[:, None]
    return step[nx:, nx:], step[:nx, nx:], noise


def force_names(lin: LinearModel) -> tuple[str, ...]:
    """Return the names of the generalised forces, and of the other inputs."""
    velocities = lin.state_names[-len(lin.M) :]
    forces = []
    for name in velocities:
        group, _, member = name.partition(".")
        forces.append(f"{_FORCES[group]}.{member}")
    return tuple(dict.fromkeys((*forces, *input_keys(lin))))


def _chosen_forces(
    lin: LinearModel,
    noise: Mapping[str, float] | None,
    frequency: Mapping[str, float | Sequence[float]] | None,
) -> tuple[dict[str, float], dict[str, tuple[float, ...]]]:
    """Return the intensity and the frequencies [Hz] of each disturbance, by its name."""
    expected = "a mapping {name: value}"
    noise = {} if noise is None else noise
    noise = instance("disturbance_noise", noise, Mapping, expected)
    frequency = {} if frequency is None else frequency
    frequency = instance("disturbance_frequency", frequency, Mapping, expected)
    known = force_names(lin)
    intensities = {
        key: quantity(f"disturbance_noise of '{key}'", value)
        for key, value in noise.items()
    }
    for key in intensities:
        matching("disturbance", key, known)
    at = by_name("disturbance", intensities, known)
    forces = {known[i]: at[i] for i in sorted(at)}
    periodic = {
        key: _frequencies(key, value, lin.dt) for key, value in frequency.items()
    }
    frequencies = {
        known[i]: value for i, value in by_name("disturbance", periodic, known).items()
    }
    for key in frequencies:
        if key not in forces:
            raise InputError(
                f"disturbance_frequency names {key}, for which disturbance_noise has no intensity; "
                "give one"
            )
    return forces, frequencies


def _frequencies(key: str, value: object, dt: float) -> tuple[float, ...]:
    """Return different frequencies [Hz] from a number or a list of numbers."""
    what = f"disturbance_frequency of '{key}'"
    values = [value] if dimension(what, value) == 0 else list(value)  # type: ignore[call-overload]
    frequencies = tuple(positive(what, number(what, item), "Hz") for item in values)
    if len(set(frequencies)) < len(frequencies):
        raise InputError(f"{what} has a frequency twice; give each frequency once")
    for frequency in frequencies:
        if dt and 2.0 * frequency * dt >= 1.0:
            raise InputError(
                f"{what} is {frequency:g} Hz, expected less than half the sampling frequency, "
                f"{0.5 / dt:g} Hz"
            )
    return frequencies


def _force_columns(lin: LinearModel, keys: tuple[str, ...]) -> tuple[Array, Array]:
    """Return the effect (nx, k) and the direct effect on outputs (ny, k) of unit forces."""
    nx, ny = len(lin.A), len(lin.C)
    to_x, to_y = np.zeros((nx, len(keys))), np.zeros((ny, len(keys)))
    source = lin.generator or lin
    inputs = input_keys(lin)
    forces = force_names(lin)[: len(lin.M)]
    accelerations = np.linalg.inv(lin.M)
    for column, key in enumerate(keys):
        if key in inputs:
            at = inputs.index(key)
            to_x[:, column], to_y[:, column] = source.B[:, at], source.D[:, at]
        else:
            to_x[-len(lin.M) :, column] = accelerations[:, forces.index(key)]
    others = [key for key in keys if key not in inputs]
    if others and (felt := _felt(lin, others)) is not None:
        for key, values in felt.items():
            to_y[:, keys.index(key)] = values
    return to_x, to_y


def _felt(lin: LinearModel, keys: list[str]) -> dict[str, Array] | None:
    """Return the direct effect (ny,) of forces on accelerometers, or None without them."""
    robot = lin._robot
    if robot is None:
        accelerometers = [x for x in lin.output_names if ".acceleration." in x]
        if accelerations := accelerometers[:1]:
            raise InputError(
                f"{accelerations[0]} feels disturbances, but the model was read from a file and "
                "has no robot; linearise the robot again"
            )
        return None
    if not any(output.FEELS_ACCELERATION for output in robot.outputs):
        return None
    inputs = list(robot.inputs)
    joints = [key.partition(".")[2] for key in keys if key.startswith("tau_m.")]
    if any(key.startswith("tau_b.") for key in keys):
        inputs.append(BaseTorque())
    if any(key.startswith("F_b.") for key in keys):
        inputs.append(BaseForce())
    inputs += [JointTorque(joint) for joint in joints]
    pushed = linearize(
        robot.replace(inputs=inputs),
        lin.q,
        lin.v,
        frame=lin.frame,
        reference=lin.reference,
        moving=lin.moving,
        independent=lin.independent,
    )
    names = input_keys(pushed)
    return {key: pushed.D[:, names.index(key)] for key in keys}
