"""Outputs as they are written on a command line."""

from collections.abc import Callable

from fflin.base.errors import InputError, unknown
from fflin.robot.outputs import (
    Accelerometer,
    BasePose,
    CenterOfMass,
    FramePose,
    FrameVelocity,
    FullState,
    Gyroscope,
    JointPositions,
    JointVelocities,
    Momentum,
    Output,
)

_OF_ROBOT: dict[str, Output] = {
    "state": FullState(),
    "base": BasePose(),
    "joints": JointPositions(),
    "rates": JointVelocities(),
    "com": CenterOfMass(),
    "momentum": Momentum(),
}
_OF_FRAME: dict[str, tuple[Callable[[str], Output], ...]] = {
    "frame": (FramePose, FrameVelocity),
    "pose": (FramePose,),
    "velocity": (FrameVelocity,),
    "gyroscope": (Gyroscope,),
    "accelerometer": (Accelerometer,),
}


def parse_output(text: str) -> tuple[Output, ...]:
    """Read one output as it is written on a command line.

    Parameters
    ----------
    text : str
        ``state``, ``base``, ``joints``, ``rates``, ``com`` or ``momentum``; or of a frame
        ``pose:NAME``, ``velocity:NAME``, both as ``frame:NAME``, ``gyroscope:NAME``,
        ``accelerometer:NAME``.

    Returns
    -------
    tuple of Output

    Raises
    ------
    UnknownNameError
        If there is no such output.
    InputError
        If the frame is missing, or one is given where none belongs.
    """
    kind, colon, frame = text.partition(":")
    if kind in _OF_FRAME:
        if not frame:
            raise InputError(f"output '{text}' is of no frame; write {kind}:NAME")
        return tuple(build(frame) for build in _OF_FRAME[kind])
    if kind not in _OF_ROBOT:
        raise unknown("output", kind, (*_OF_ROBOT, *_OF_FRAME))
    if colon:
        raise InputError(f"output '{text}' is of the whole robot; write {kind}")
    return (_OF_ROBOT[kind],)
