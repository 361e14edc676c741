"""A step of the nonlinear simulation: fourth order, a millisecond, no inputs."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

import fflin
from benchmarks.peers import WrongResultError
from benchmarks.robots import Array, Point, load, random_point
from benchmarks.tables import Table, figure
from benchmarks.timing import interleaved

NAMES = ("ur5", "servicer_7dof", "talos")
STEP, STEPS = 1e-3, 1000  # [s], and how many are timed together
BARE, FREE = "four pin.aba", "fflin, momentum not kept"


@dataclass(frozen=True)
class Simulation:
    """`run` makes `STEPS` steps from the point; `velocities` of the joints are then (n,)."""

    run: Callable[[], object]
    velocities: Callable[[], Array]


def run() -> Table:
    rows, notes = [], dict[str, None]()
    columns: list[str] = []
    for name in NAMES:
        point = random_point(load(name), seed=1)
        simulations, said = _simulations(point)
        notes |= dict.fromkeys(said)
        expected = _reference(point)
        for key, simulation in simulations.items():
            simulation.run()
            error = (
                np.abs(simulation.velocities() - expected).max()
                / np.abs(expected).max()
            )
            if not error < 1e-6:
                raise WrongResultError(
                    f"{key} on {name}: velocities differ by {error:.1e}"
                )
        calls = {key: each.run for key, each in simulations.items()}
        times = interleaved(calls | {BARE: _bare(point)})
        own = times.pop("fflin")
        columns += [key for key in times if key not in columns]
        row = {key: figure(each.ratio(own)) for key, each in times.items()}
        rows.append((name, point.robot.n, figure(own.least / STEPS * 1e6), row))
    return Table(
        "Simulation step",
        f"One of {STEPS} steps of {STEP * 1e3:g} ms at order four (Drake: three, its highest order "
        "with a fixed step), without inputs. fflin also conserves the momentum. The first column "
        "is the time of fflin; the times of the others are divided by it.",
        ("robot", "n", "fflin [us]", *columns),
        tuple(
            (name, str(n), time, *(row.get(key, figure(None)) for key in columns))
            for name, n, time, row in rows
        ),
        tuple(notes),
    )


def _bare(point: Point) -> Callable[[], None]:
    model, data, tau = (
        point.robot.model,
        point.robot.create_data(),
        np.zeros(point.robot.nv),
    )
    q, v = point.q, point.v

    def call() -> None:
        for _ in range(4 * STEPS):
            pin.aba(model, data, q, v, tau)

    return call


def _reference(point: Point) -> Array:
    """Joint velocities after all steps, by the midpoint rule extrapolated to fourth order."""
    coarse, fine = (_midpoint(point, count * STEPS) for count in (4, 8))
    return fine + (fine - coarse) / 3.0


def _midpoint(point: Point, steps: int) -> Array:
    model, data, tau = (
        point.robot.model,
        point.robot.create_data(),
        np.zeros(point.robot.nv),
    )
    q, v, h = point.q.copy(), point.v.copy(), STEP * STEPS / steps
    for _ in range(steps):
        q_half = pin.integrate(model, q, 0.5 * h * v)
        v_half = v + 0.5 * h * pin.aba(model, data, q, v, tau)
        v = v + h * pin.aba(model, data, q_half, v_half, tau)
        q = pin.integrate(model, q, h * v_half)
    return v[point.order[6:]]


def _simulations(point: Point) -> tuple[dict[str, Simulation], list[str]]:
    found: dict[str, Simulation] = {}
    notes = []
    found["fflin"] = _fflin(point, project=True)
    found[FREE] = _fflin(point, project=False)
    for name, make in (("MuJoCo RK4", _mujoco), ("Drake RK3", _drake)):
        try:
            found[name] = make(point)
        except ImportError as error:
            notes.append(f"{name}: not installed ({error})")
    return found, notes


def _fflin(point: Point, *, project: bool) -> Simulation:
    kept = {}

    def call() -> None:
        # As the peers do: the last state alone is kept.
        kept["motion"] = fflin.simulate(
            point.robot,
            q0=point.q,
            v0=point.v,
            duration=STEP * STEPS,
            dt=STEP,
            every=STEPS,
            project=project,
        )

    return Simulation(call, lambda: kept["motion"].v[-1][point.order[6:]])


def _mujoco(point: Point) -> Simulation:
    peer = importlib.import_module("benchmarks.peers.mujoco_peer")
    mujoco = peer.mujoco
    here = peer.MujocoPoint(point)
    here.model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    here.model.opt.timestep = STEP
    here.ctrl[:] = 0.0

    def call() -> None:
        here.data.qpos[:], here.data.qvel[:] = here.qpos, here.qvel
        mujoco.mj_step(here.model, here.data, STEPS)

    def velocities() -> Array:
        return here.data.qvel[here.order[6:]]

    return Simulation(call, velocities)


def _drake(point: Point) -> Simulation:
    peer = importlib.import_module("benchmarks.peers.drake_peer")
    analysis = importlib.import_module("pydrake.systems.analysis")
    here = peer.DrakePoint(point, rest=False)
    here.port.FixValue(here.context, np.zeros(here.nv))
    state = here.plant.GetPositionsAndVelocities(here.context).copy()
    simulator = analysis.Simulator(here.plant, here.context)
    integrator = analysis.ResetIntegratorFromFlags(simulator, "runge_kutta3", STEP)
    integrator.set_fixed_step_mode(True)

    def call() -> None:
        here.context.SetTime(0.0)
        here.plant.SetPositionsAndVelocities(here.context, state)
        simulator.Initialize()
        simulator.AdvanceTo(STEP * STEPS)

    def velocities() -> Array:
        return here.plant.GetVelocities(here.context)[here.order[6:]]

    return Simulation(call, velocities)
