"""Whole processes: each imports one package, loads a URDF and makes its first linear model."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from benchmarks.robots import load, plain_urdf

ROBOT = "servicer_7dof"

# What a user of each would write; `path` is the URDF's. None imports another's package.
_PROGRAMS = {
    "fflin": """
import fflin
lin = fflin.linearize(fflin.load(path))
lin.A, lin.B
""",
    "Pinocchio": """
import pinocchio as pin
model = pin.buildModelFromUrdf(path, pin.JointModelFreeFlyer())
pin.computeMinverse(model, model.createData(), pin.neutral(model))
""",
    "MuJoCo": """
import mujoco, numpy as np
spec = mujoco.MjSpec.from_file(path)
spec.compiler.fusestatic = False
spec.body("base").add_freejoint()
model = spec.compile()
model.opt.gravity[:] = 0.0
data = mujoco.MjData(model)
A, B = np.zeros((2 * model.nv, 2 * model.nv)), np.zeros((2 * model.nv, model.nu))
mujoco.mjd_transitionFD(model, data, 1e-6, False, A, B, None, None)
""",
    "Crocoddyl": """
import crocoddyl, numpy as np, pinocchio as pin
model = pin.buildModelFromUrdf(path, pin.JointModelFreeFlyer())
state = crocoddyl.StateMultibody(model)
actuation = crocoddyl.ActuationModelFull(state)
costs = crocoddyl.CostModelSum(state, actuation.nu)
dynamics = crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs)
data, x, u = dynamics.createData(), state.zero(), np.zeros(actuation.nu)
dynamics.calc(data, x, u)
dynamics.calcDiff(data, x, u)
""",
    "Drake": """
import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import OutputPortSelection
from pydrake.systems.primitives import FirstOrderTaylorApproximation
plant = MultibodyPlant(0.0)
Parser(plant).AddModels(path)
plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
plant.Finalize()
context, port = plant.CreateDefaultContext(), plant.get_applied_generalized_force_input_port()
port.FixValue(context, np.zeros(plant.num_velocities()))
FirstOrderTaylorApproximation(plant, context, port.get_index(), OutputPortSelection.kNoOutput)
""",
}
_MODULES = {
    "fflin": "fflin",
    "Pinocchio": "pinocchio",
    "MuJoCo": "mujoco",
    "Crocoddyl": "crocoddyl",
    "Drake": "pydrake",
}
_REPORT = """
with open("/proc/self/status") as status:  # getrusage would count the parent's too
    peak = next(line.split()[1] for line in status if line.startswith("VmHWM"))
print(int(peak) / 1024)
"""
IMPORT, FIRST = "import", "first model"


def programs() -> tuple[list[str], list[str]]:
    """Return the names of the packages that are there, and notes on those that are not."""
    there = [name for name, module in _MODULES.items() if find_spec(module)]
    return there, [f"{name}: not installed" for name in _MODULES if name not in there]


@contextmanager
def urdf_file() -> Iterator[str]:
    """Write the robot's URDF to a file that is there for the time being."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / f"{ROBOT}.urdf"
        path.write_text(plain_urdf(load(ROBOT)), encoding="utf-8")
        yield str(path)


def run_process(name: str, until: str, path: str) -> tuple[float, float]:
    """Return the time [s] and the peak memory [MiB] of a process until `IMPORT` or `FIRST`."""
    lines = f"import {_MODULES[name]}" if until == IMPORT else _PROGRAMS[name]
    return measured(name, f"path = {path!r}\n{lines}")


def measured(name: str, source: str) -> tuple[float, float]:
    """Return the time [s] and the peak memory [MiB] of a process that runs some lines."""
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", f"{source}\n{_REPORT}"],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ,
    )
    seconds = time.perf_counter() - start
    if done.returncode:
        raise SystemExit(f"{name}: {done.stderr.strip()[-400:]}")
    return seconds, float(done.stdout.splitlines()[-1])
