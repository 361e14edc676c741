"""Simulation of the nonlinear robot on the manifold, under any policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from fflin.base.errors import InputError
from fflin.simulation.recording import check_prediction, motion_of
from fflin.simulation.run import Run

if TYPE_CHECKING:
    import pinocchio as pin
    from numpy.typing import ArrayLike

    from fflin.base.validation import Array
    from fflin.control.policies import Policy, StateFeedback
    from fflin.dynamics.state import Frame
    from fflin.linear.model import LinearModel
    from fflin.robot.robot import Robot
    from fflin.simulation.motion import Motion
    from fflin.simulation.plant import Disturbance
    from fflin.simulation.run import Event


def simulate(
    robot: Robot,
    policy: Policy | StateFeedback | Any = None,
    *,
    x0: ArrayLike | None = None,
    q0: ArrayLike | None = None,
    v0: ArrayLike | None = None,
    duration: float,
    dt: float | None = None,
    method: str = "cf4",
    project: bool = True,
    sample: float | None = None,
    delay: float = 0.0,
    limits: float | Mapping[str, Any] | None = None,
    disturbance: Disturbance | None = None,
    events: Sequence[Event] = (),
    callback: Callable[[float, Array, Array, Array], None] | None = None,
    linear: LinearModel | bool | None = None,
    frame: Frame | None = None,
    reference: pin.SE3 | None = None,
    every: int = 1,
    progress: bool | None = None,
) -> Motion:
    r"""Simulate a robot under a policy.

    Steps of fixed size on the manifold, by default of the commutator-free method CF4 of order 4.
    After each step the velocity of the base is set so that the momentum is what the impulse from
    outside makes it, :math:`\nu_b = M_{bb}^{-1}(H - M_{bm} \dot q_m)`, where H is integrated with
    the weights of the method. Thrusters never pull: a negative thrust is cut to zero.

    Parameters
    ----------
    robot : Robot
    policy : callable, optional
        policy(t, q, v) -> u (nu,) over the robot's inputs, such as
        ``StateFeedback(lin, gain.K)``; none acts by default.
    x0 : array_like (nx,), optional
        Initial state in the chart of the policy's model, or of `frame` and `reference`.
    q0 : array_like (nq,), optional
    v0 : array_like (nv,), optional
        Initial configuration and velocity in Pinocchio's order, instead of `x0`; neutral and at
        rest by default.
    duration : float
        [s]
    dt : float, optional
        Step [s]; by default 0.01, or less where the loop's fastest pole or the samples ask for it.
        Where the input is neither sampled nor late, it is made to divide the duration.
    method : {"cf4", "rkmk4", "semi_implicit_euler"}
    project : bool
        Whether the momentum is kept as above.
    sample : float, optional
        Time [s] between the samples of the policy, a multiple of dt, between which u is held; by
        default that of the policy's model where it is sampled, else the policy is asked at every
        stage of every step.
    delay : float
        Time [s] from a sample to its effect, a multiple of dt; until then u0 of the policy's
        model acts, or nothing. Where there is a delay and no `sample`, samples are dt apart.
    limits : float or mapping, optional
        Largest magnitude of all inputs, or {input or group: magnitude, or (least, largest)}.
    disturbance : callable, optional
        disturbance(t, q, v) -> generalised force (nv,) in Pinocchio's order.
    events : sequence of callable
        event(t, q, v) -> float; the run ends after the step in which one is no longer positive.
    callback : callable, optional
        callback(t, q, v, u), called at every recorded row.
    linear : LinearModel or bool, optional
        Predicts the motion under the same law; by default the policy's own model, False for none.
        Sampled, it does so where every row is at a sample.
    frame : {"hybrid", "local", "world"}, optional
    reference : pin.SE3, optional
        Chart of x and axes of u; the policy's model's by default, else hybrid and the identity.
    every : int
        Steps from one recorded row to the next.
    progress : bool, optional
        Whether a bar is shown on stderr; by default on a terminal, for runs that take long.

    Returns
    -------
    Motion
        Ended early, ``stopped`` says why: an event, an interrupt (Ctrl-C), or a loop that left
        the chart or diverged.

    Raises
    ------
    InputError
        If an argument has a wrong size or value, a policy or disturbance returns what is no
        input or force, or dt is too large for the loop.
    UnknownNameError
        If there is no such method or input.

    References
    ----------
    E. Celledoni, A. Marthinsen and B. Owren, Future Generation Computer Systems 19(3), 2003.
    """
    run = Run(robot, policy, frame, reference, disturbance)
    check_prediction(run, linear)
    run.begin(x0, q0, v0)
    run.clock(duration, dt, every, sample, delay)
    run.actuate(limits)
    run.choose(method, project)
    run.guard(events, callback)
    try:
        return motion_of(run, run.go(progress), linear)
    except MemoryError:
        raise InputError(
            f"{run.steps // run.every} rows of '{run.robot.name}' do not fit into the memory; take "
            "a larger dt or `every`"
        ) from None
