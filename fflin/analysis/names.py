"""Names of combinations of states, such as conserved momenta and their coordinates."""

import re

import numpy as np

from fflin.analysis.mechanics import ConservedMomenta
from fflin.analysis.ranks import Margin
from fflin.base.validation import Array, Values
from fflin.linear.model import LinearModel

# For each group of velocities: name of the momentum, and name of the coordinate whose rate is the
# momentum.
_CONSERVED = {
    "omega_b": ("angular momentum", "base attitude"),
    "v_b": ("linear momentum", "base position"),
}
_OTHER = ("momentum of", "position of")

_AXIS = re.compile(r"(?<!\S)[xyz](?!\S)")


def momentum_names(lin: LinearModel, conserved: ConservedMomenta) -> tuple[str, ...]:
    """Name the conserved momenta, and then the coordinates whose rates are these momenta."""
    nv = len(lin.M)
    size = np.sqrt(lin.M.diagonal())
    rates = [name.split(".", 1) for name in lin.state_names[nv:]]
    momenta, driven = (
        tuple(f"{_CONSERVED.get(group, _OTHER)[i]} {member}" for group, member in rates)
        for i in (0, 1)
    )
    # The inputs cannot move the named coordinate while the others are fixed, but they may move it
    # together with the others.
    only_joints = all(rates[i][0] == "qdot_m" for i in conserved.kept)
    of_base = all(
        not row[i] for row in conserved.weights for i in range(nv) if rates[i][0] == "qdot_m"
    )
    rest = "the joints" if only_joints and of_base else "the rest"
    return (
        *(combination(row, momenta, size) for row in conserved.weights),
        *(f"{combination(row, driven, size)} with {rest} fixed" for row in conserved.weights),
    )


def grouped(names: tuple[str, ...]) -> list[str]:
    """Join names that differ only in their axis, for example to "angular momentum x/y/z"."""
    groups: dict[str, list[str]] = {}
    for name in names:
        axes = _AXIS.findall(name)
        key = _AXIS.sub("\0", name) if len(axes) == 1 else name
        groups.setdefault(key, []).extend(axes[: len(axes) == 1])
    return [key.replace("\0", "/".join(axes)) for key, axes in groups.items()]


_RATES = {"q_b": "omega_b", "r_b": "v_b", "q_m": "qdot_m"}


def rate_of(name: str) -> str:
    """Return the name of the rate of a coordinate, or "" if the name is not a coordinate."""
    group, _, member = name.partition(".")
    return f"{_RATES[group]}.{member}" if group in _RATES else ""


def combination(weights: Array, names: tuple[str, ...], sizes: Array, most: int = 3) -> str:
    """Format a linear combination by its largest terms; `sizes` makes the weights comparable."""
    order = [i for i in np.argsort(-np.abs(weights) * sizes) if weights[i]]
    largest = abs(weights[order[0]]) * sizes[order[0]]
    shown = [i for i in order if abs(weights[i]) * sizes[i] > 1e-6 * largest]
    terms: list[str] = []
    for i in shown[:most]:
        value = f"{abs(weights[i]):.3g}"
        sign = ("-" if weights[i] < 0.0 else "+") + " " * bool(terms)
        terms.append(sign + (names[i] if value == "1" else f"{value} {names[i]}"))
    if len(shown) > most:
        terms.append(f"+ {len(shown) - most} more")
    return " ".join(terms).removeprefix("+")


def undecided(lin: LinearModel, margin: Margin, what: str, count: int) -> tuple[str, ...]:
    """Return a note for each undecided rank, with both possible numbers of states."""
    return tuple(
        f"undecided: {shape(lin, at)} counts as {'' if change < 0 else 'not '}{what}, but the "
        f"test value is only {ratio:.1g} times its rounding error; {count} or {count + change} "
        f"of {len(lin.A)} states are {what}"
        for ratio, at, change in margin.doubts
    )


def unsettled(lin: LinearModel, settling: Margin, what: str) -> tuple[str, ...]:
    """Return a note if rounding error hides whether the slowest motion decays."""
    return tuple(
        f"undecided: {shape(lin, at)} may or may not decay by itself, because its decay rate is "
        f"only {ratio:.1g} times its rounding error; the model may or may not be {what}"
        for ratio, at, _ in settling.doubts
    )


def shape(lin: LinearModel, at: Values) -> str:
    """Describe a motion with rates `at` (nv,), real or complex, by its largest coordinates."""
    size = np.sqrt(lin.M.diagonal())
    largest = at[int(np.abs(at * size).argmax())]
    of_base = {"omega_b": "rotation about ", "v_b": "translation along "}
    pairs = (name.partition(".") for name in lin.state_names[len(lin.M) :])
    names = tuple(of_base.get(group, "") + (member or group) for group, _, member in pairs)
    return combination(np.real(at / largest), names, size)
