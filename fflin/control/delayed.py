"""State feedback of models with delayed inputs, which contains its earlier commands."""

import numpy as np

from fflin.base.names import without_past
from fflin.base.validation import Array
from fflin.control.policy import System, proportional


def is_delayed(states: tuple[str, ...]) -> bool:
    """Return whether states belong to a model with delayed inputs."""
    return without_past(states) != states


def law_with_memory(
    K: Array,
    A: Array,
    B: Array,
    dt: float,
    states: tuple[str, ...],
    inputs: tuple[str, ...],
    integrals: tuple[str, ...] = (),
) -> System:
    r"""Return the feedback u - u0 = -K (x - x0) as a system from the states of the robot.

    Some states of a model with delayed inputs are earlier commands. The law remembers them, and
    the states in `integrals`, as its state z:

    .. math:: u - u_0 = -K_x (x - x_0) - K_z z, \qquad
              z_{+} = A_z z + A_{zx} (x - x_0) + B_z (u - u_0)

    A and B are the matrices of the model with the state names `states`.
    """
    measured = [x for x in without_past(states) if x not in integrals]
    if len(measured) == len(states):
        return proportional(K, dt, states, inputs)
    x = [states.index(name) for name in measured]
    z = [i for i in range(len(states)) if i not in x]
    K_x, K_z, B_z = K[:, x], K[:, z], B[z]
    from_x = A[np.ix_(z, x)]
    # Commands and lags do not depend on the robot, but rounding may couple them in a sampled model.
    commands = [states[i] not in integrals for i in z]
    from_x[commands] = 0.0
    return System(
        A[np.ix_(z, z)] - B_z @ K_z,
        from_x - B_z @ K_x,
        -K_z,
        -K_x,
        dt,
        inputs=tuple(measured),
        outputs=inputs,
    )
