"""Displacements from an operating point: attitude [deg], position [m] and joints [rad|m]."""

from fflin.base.errors import InputError
from fflin.base.validation import number
from fflin.linear.model import LinearModel

# The largest displacement [m], [rad].
_FARTHEST = 1e6


def checked_displacement(
    lin: LinearModel, attitude: float, position: float, joint: float
) -> dict[str, float]:
    """Return the largest displacement; zero of what is not among the states."""
    given = {"attitude": attitude, "position": position, "joint": joint}
    given = {key: number(key, value) for key, value in given.items()}
    if not 0.0 <= given["attitude"] < 175.0 or min(given.values()) < 0.0:
        raise InputError(
            f"the displacements are {shown(given)}; expected values of 0 or more, and an "
            "attitude below 175 deg, because the chart ends at 180 deg"
        )
    if max(given.values()) > _FARTHEST:
        raise InputError(
            f"the displacements are {shown(given)}; expected at most {_FARTHEST:g}; give smaller "
            "ones"
        )
    groups = {name.partition(".")[0] for name in lin.state_names}
    names = {"attitude": "q_b", "position": "r_b", "joint": "q_m"}
    largest = {key: given[key] if name in groups else 0.0 for key, name in names.items()}
    if not any(largest.values()):
        raise InputError(
            "no state of the model is displaced; give a nonzero displacement of one of its states"
        )
    return largest


def scaled(largest: dict[str, float], level: float) -> dict[str, float]:
    """Return a share of a displacement."""
    return {key: level * value for key, value in largest.items()}


def joint_unit(lin: LinearModel) -> str:
    """Return the unit of the joints, "rad|m" where some turn and others slide."""
    pairs = zip(lin.state_names, lin.state_units, strict=True)
    of = {unit for name, unit in pairs if name.startswith("q_m.")}
    return of.pop() if len(of) == 1 else "rad|m"


def shown(displacement: dict[str, float], of_joints: str = "rad|m") -> str:
    """Say in words what of a displacement is not zero."""
    units = {"attitude": "deg", "position": "m", "joint": of_joints}
    words = [f"{displacement[key]:.3g} {unit}" for key, unit in units.items() if displacement[key]]
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:]))) or "0"
