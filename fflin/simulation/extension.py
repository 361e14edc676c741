"""Constraints, lags and flat plates of a plan, as data for the compiled loop."""

from __future__ import annotations

import numpy as np

from fflin.base.validation import Array
from fflin.control.loops import Loop
from fflin.control.policy import OutputForm
from fflin.control.sensors import SensorLag
from fflin.dynamics.disturbance import Plate
from fflin.kernel import extension
from fflin.kernel.constraints import CONSTRAINTS, Constraints
from fflin.kernel.tree import batch_tree, empty
from fflin.robot.disturbance import PLATE, plates_of
from fflin.simulation.plan import Plan
from fflin.simulation.plant import Plant

# Names, in `Runs`, of the dispersed forces of flat plates.
DRAG, SUNLIGHT = "drag", "sunlight"


def is_extended(plan: Plan) -> bool:
    """Return whether a plan has constraints, lags or flat plates."""
    plant = plan.plant
    return (
        plant.constrained is not None
        or PLATE in plant.robot.disturbance
        or bool(plant.lags.any())
        or _sensor_lag(plan) is not None
    )


def extension_of(plan: Plan) -> extension.Extension:
    """Return the constraints, the lags and the flat plates of a plan for the kernel."""
    return extension.Extension(
        constraints=_constraints(plan),
        actuators=_actuators(plan),
        sensors=_sensors(plan),
        plates=_plates(plan.plant),
    )


def _constraints(plan: Plan) -> Constraints:
    """Return the constraints of a plan's robot; empty without constraints."""
    plant = plan.plant
    none: Constraints = empty(CONSTRAINTS)
    if plant.constrained is None:
        return none
    tree = batch_tree(plant.robot)
    assert tree is not None
    return plant.constrained.in_kernel(tree, len(plan.q))


def _sensor_lag(plan: Plan) -> SensorLag | None:
    """Return the lags of the sensors that the law of a plan measures, or None."""
    if plan.policy is None or plan.policy.commanded_robot is not None:
        return None
    form = plan.policy.inner.form(plan.plant.robot)
    if isinstance(form, OutputForm) and isinstance(form.loop, Loop):
        return form.loop.lag
    return None


def _actuators(plan: Plan) -> extension.ActuatorLag:
    """Return the lags of the actuators, as in `simulation.lag`."""
    lags = plan.plant.lags
    lagging = lags > 0.0
    rate = np.zeros(len(lags))
    rate[lagging] = 1.0 / lags[lagging]
    times = plan.times.dt * np.array((*plan.method.nodes, 1.0))
    decay = np.where(lagging, np.exp(-np.outer(times, rate)), 0.0)
    held = plan.law is None or plan.times.sample > 0
    stages = len(plan.method.nodes)
    return extension.ActuatorLag(
        rate=rate,
        decay=decay.ravel(),
        held=held or not lagging.any(),
        acting=np.zeros(len(lags)),
        now=np.clip(plan.initial, plan.limits.low, plan.limits.high),
        rates=np.zeros((1 + stages) * len(lags)),
    )


def _sensors(plan: Plan) -> extension.SensorLag:
    """Return the lags of the sensors; empty without a lag."""
    none: extension.SensorLag = empty(extension.SENSOR_LAG)
    lag = _sensor_lag(plan)
    if lag is None:
        return none
    start = lag.start
    stages = len(plan.method.nodes)
    return none._replace(
        rate=lag.rate, values=start, rates=np.zeros((1 + stages) * len(start))
    )


def _plates(plant: Plant) -> extension.Plates:
    """Return the flat plates of a robot."""
    plates = [Plate(plate, plant.field) for plate in plates_of(plant.robot.disturbance)]

    def stacked(rows: list[Array]) -> Array:
        return np.array(rows, dtype=float).ravel()

    return extension.Plates(
        normal=stacked([plate.normal for plate in plates]),
        position=stacked([plate.position for plate in plates]),
        two_sided=[plate.plate.two_sided for plate in plates],
        flow=stacked([plate.flow for plate in plates]),
        inertial=[
            plate.flow_is_inertial and plant.field is not None for plate in plates
        ],
        drag=[plate.drag for plate in plates],
        sun=stacked([plate.sun for plate in plates]),
        specular=[plate.plate.specular for plate in plates],
        diffuse=[plate.plate.diffuse for plate in plates],
        sunlight=[plate.sunlight for plate in plates],
    )
