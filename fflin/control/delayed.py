"""State feedback of models with delayed inputs, which contains its earlier commands."""

from fflin.base.names import without_past
from fflin.base.validation import Array
from fflin.control.policy import System, proportional


def is_delayed(states: tuple[str, ...]) -> bool:
    """Return whether states are those of a model with delayed inputs."""
    return without_past(states) != states


def law_with_memory(
    K: Array,
    A: Array,
    B: Array,
    dt: float,
    states: tuple[str, ...],
    inputs: tuple[str, ...],
) -> System:
    r"""Return the feedback u - u0 = -K (x - x0) as a system from the states of the robot.

    The last states of a model with delayed inputs are earlier commands z, which the law remembers:

    .. math:: u - u_0 = -K_x (x - x_0) - K_z z, \qquad z_{+} = A_z z + B_z (u - u_0)

    A and B are the matrices of the model with the state names `states`.
    """
    measured = without_past(states)
    n = len(measured)
    if n == len(states):
        return proportional(K, dt, states, inputs)
    K_x, K_z = K[:, :n], K[:, n:]
    A_z, B_z = A[n:, n:], B[n:]
    return System(
        A_z - B_z @ K_z, -B_z @ K_x, -K_z, -K_x, dt, inputs=measured, outputs=inputs
    )
