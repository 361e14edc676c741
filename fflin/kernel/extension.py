"""Constraints, lags of actuators and sensors, and flat plates, which only some robots have.

The functions of `kernel.loop` receive an `Extension`, or None for a robot that has none of them.
numba then compiles no code of the extension.
"""

from collections import namedtuple

from fflin.kernel import vectors as vec
from fflin.kernel.constraints import CONSTRAINTS
from fflin.kernel.orbit import from_inertial_axes
from fflin.kernel.tree import FLAG, FLAGS, LANED, REALS, Struct
from fflin.kernel.vectors import Entries, Number, chosen, load, store


class ActuatorLag(namedtuple("ActuatorLag", "rate decay held acting now rates")):
    r"""Inputs (nu,) that follow their commands by :math:`\dot u_a = (u - u_a) / T`.

    - `rate` (nu,): 1/T [1/s]; 0 for an input without a lag.
    - `decay` (s + 1, nu): fraction of the difference from a constant command that remains at each
      of the s stages of a step, and at the end of the step; 0 for an input without a lag.
    - `held`: True if commands are constant during a step. The inputs are then exact exponentials.
      False: the inputs are integrated with the stages of the method.
    - `acting` (nu,): the inputs that act at the present stage.
    - `now` (nu,): the inputs with a lag, at the start of the step or after the latest stage.
    - `rates` (1 + s, nu): `now` at the start of the step, and its time derivative at each stage.
    """


class SensorLag(namedtuple("SensorLag", "rate values rates")):
    r"""Sensors (ny,) that follow the outputs by :math:`\dot y_s = (y - y_s) / T`.

    All fields are empty if no sensor has a lag.

    - `rate` (ny,): 1/T [1/s]; 0 for a sensor without a lag.
    - `values` (ny,): the values y_s after the latest stage.
    - `rates` (1 + s, ny): `values` at the start of the step, and the time derivative at each stage.
    """


class Plates(
    namedtuple(
        "Plates",
        "normal position two_sided flow inertial drag sun specular diffuse sunlight",
    )
):
    """Flat plates on the base, on which drag and solar pressure act, see (11.7) and (11.8).

    - `normal`, `position` (k, 3): normal of the exposed face and centre of pressure [m], in base
      axes. `two_sided` (k,): whether both faces are exposed.
    - `flow` (k, 3): unit vector along the velocity; `inertial` (k,): whether it is in inertial axes
      and the world is an orbital frame. Otherwise, it is in world axes.
    - `drag` (k,) [N]: drag of a plate that is normal to the flow, 0 without drag.
    - `sun` (k, 3): unit vector to the sun, in inertial axes. `specular`, `diffuse` (k,): fractions
      of the sunlight that are reflected.
    - `sunlight` (k,) [N]: solar pressure times area, 0 without solar pressure.
    """


class Extension(namedtuple("Extension", "constraints actuators sensors plates")):
    """Constraints, lags of actuators and sensors, and flat plates.

    The arrays of an absent part are empty.
    """


ACTUATOR_LAG = Struct(ActuatorLag, LANED, rate=REALS, decay=REALS, held=FLAG)
SENSOR_LAG = Struct(SensorLag, LANED, rate=REALS)
PLATES = Struct(Plates, REALS, {FLAGS: "two_sided inertial", LANED: "drag sunlight"})
EXTENSION = Struct(
    Extension,
    constraints=CONSTRAINTS,
    actuators=ACTUATOR_LAG,
    sensors=SENSOR_LAG,
    plates=PLATES,
)


def lag_inputs(lag: ActuatorLag, speed: Entries, u: Entries, stage: int) -> None:
    """Write the inputs that act at a stage under the command u to `lag.acting`.

    `speed` is `Method.speed`.
    """
    count = len(lag.now)
    last = len(lag.decay) // count - 2
    for index in range(count):
        command = load(u, index)
        now = load(lag.now, index)
        if lag.held:
            apart = now - command
            decay = lag.decay[stage * count + index]
            store(lag.acting, index, command + decay * apart)
            if stage == last:
                decay = lag.decay[(stage + 1) * count + index]
                store(lag.now, index, command + decay * apart)
        else:
            rate = lag.rate[index]
            if stage == 0:
                store(lag.rates, index, now)
            store(lag.acting, index, now)
            if rate == 0.0:
                store(lag.acting, index, command)
            store(lag.rates, (1 + stage) * count + index, rate * (command - now))
    if not lag.held:
        vec.combine(speed, stage, lag.rates, lag.now)


def lag_sensors(
    lag: SensorLag, speed: Entries, x: Entries, measured: list[int], stage: int
) -> None:
    """Advance the sensors by a stage at which the outputs are the entries `measured` of x.

    `speed` is `Method.speed`.
    """
    count = len(lag.values)
    if count == 0:
        return
    for index in range(count):
        value = load(lag.values, index)
        if stage == 0:
            store(lag.rates, index, value)
        apart = load(x, measured[index]) - value
        store(lag.rates, (1 + stage) * count + index, lag.rate[index] * apart)
    vec.combine(speed, stage, lag.rates, lag.values)


def lagged(lag: SensorLag, index: int, value: Number) -> Number:
    """Return what a sensor measures of an output: with a lag, its own value."""
    if len(lag.values) > 0 and lag.rate[index] > 0.0:
        value = load(lag.values, index)
    return value


def add_plates(work, plates, orbit, axes, to):
    """Add the moment and the force (6,) of all plates, in base axes, to `work` from `to` on.

    `axes` are the columns of the attitude of the base. `orbit` is None without an orbit; in orbit,
    `write_now` must be called before.
    """
    for index in range(len(plates.two_sided)):
        normal = vec.get3(plates.normal, 3 * index)
        flow = vec.get3(plates.flow, 3 * index)
        sun = vec.get3(plates.sun, 3 * index)
        if orbit is not None:
            sun = from_inertial_axes(orbit, sun)
            if plates.inertial[index]:
                flow = from_inertial_axes(orbit, flow)
        flow, sun = vec.across(axes, flow), vec.across(axes, sun)
        cosine, side = _facing(plates, index, normal, flow)
        force = vec.times(flow, -(load(plates.drag, index) * cosine))
        cosine, side = _facing(plates, index, normal, sun)
        specular, diffuse = plates.specular[index], plates.diffuse[index]
        along_normal = 2.0 * (specular * cosine + diffuse / 3.0) * side
        per_pressure = vec.plus(
            vec.times(sun, 1.0 - specular), vec.times(normal, along_normal)
        )
        pressure = vec.times(per_pressure, -(load(plates.sunlight, index) * cosine))
        force = vec.plus(force, pressure)
        moment = vec.cross(vec.get3(plates.position, 3 * index), force)
        vec.add6(work, to, (moment, force))


def _facing(plates, index, normal, direction):
    """Return the cosine of the angle of incidence, at least 0, and the sign of the normal."""
    cosine = vec.dot(normal, direction)
    side = chosen(cosine, 0.0, -1.0, 1.0)
    if plates.two_sided[index]:
        return side * cosine, side
    return chosen(cosine, 0.0, 0.0, cosine), side
