"""Functions that build the robot, operating point, linear models and closed loop of a command."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial, reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import fflin
from fflin.base.errors import InputError, UnknownNameError, listed, located
from fflin.base.names import joints_by_name, rates_by_name
from fflin.commands import DONE, NO_ORBIT

if TYPE_CHECKING:
    import pinocchio as pin

    from fflin.base.figures import CurveStyle
    from fflin.base.validation import Array
    from fflin.commands.phases import PhaseStart
    from fflin.dynamics.coordinates import Frame
    from fflin.robot.inputs import Input

T = TypeVar("T")

# Laws that commands save, except those of `fflin tune`.
SavedLaw: TypeAlias = (
    "fflin.Gain | fflin.GainSchedule | fflin.Compensator | fflin.MultirateCompensator"
)

_WEIGHTS = ("weights", "q", "r", "bryson", "sample", "integral")
_POSE = ("target_rpy", "target_position")
_TARGETS = (
    "target_joint",
    "target_velocity",
    "effort",
    "equilibrium",
    "tilt",
    "reduce",
)

_FILES, SHOWN = ("html", "png", "gif"), ("scene", "follow", "tool")


@dataclass(frozen=True)
class Report:
    """Report of a command.

    Attributes
    ----------
    robot : str or None
        Name of the robot.
    result : object
        Result of the library, or a mapping. --json prints the fields of the result, or the entries
        of the mapping.
    text : str
        Text that is printed without --json. The first paragraph is the entry "result" of --json.
    files : mapping
        {path: function that writes the file, or None if the file is already written}. An entry with
        the path None is ignored.
    code : int
        Exit code.
    interrupted : str
        Reason why the computation was interrupted, or "". After an interruption, existing files are
        not replaced.
    """

    robot: str | None
    result: object
    text: str
    files: Mapping[Path | None, Callable[[Path], object] | None] = field(
        default_factory=dict
    )
    code: int = DONE
    interrupted: str = ""


def load_robot(arguments: Namespace) -> fflin.Robot:
    """Load the robot, and apply the options that override its settings.

    `arguments.joint_colors` becomes {joint: colour}, for the tables of the report on a terminal.
    """
    from fflin.base.figures import joint_styles

    given = {
        name: value
        for name in ("passive", "gravity", "stiffness", "damping")
        if (value := getattr(arguments, name, None))
    }
    # `load` gets `passive` and the damping "urdf", because its warnings depend on them. All other
    # settings in `given` are applied after loading.
    first: dict[str, Any] = {}
    if "passive" in given:
        first["passive"] = given.pop("passive")
    if given.get("damping") == [(None, "urdf")]:
        first["damping"] = "urdf"
    robot = fflin.load(
        arguments.robot,
        lock=once("--lock", arguments.lock),
        xacro=once("--xacro", arguments.xacro),
        **first,
    )
    for name in ("stiffness", "damping"):
        if name not in given:
            continue
        for_all = [value for joint, value in given[name] if joint is None]
        if for_all and len(given[name]) > 1:
            raise InputError(
                f"--{name} is given for all joints and for single joints; give only one of them"
            )
        given[name] = for_all[0] if for_all else once(f"--{name}", given[name])
    given |= _orbit_of(arguments, robot)
    inputs = getattr(arguments, "inputs", None)
    if inputs is not None:
        new_inputs = _inputs_of(robot, inputs)
        with located(inputs):  # errors about a name or an inertia show the file
            robot = robot.replace(inputs=new_inputs)
    if outputs := getattr(arguments, "output", None):
        given["outputs"] = outputs
    robot = with_welds(robot, arguments)
    if independent := getattr(arguments, "independent", None):
        if not robot.constraints:
            raise InputError(
                f"--independent needs constraints, but '{robot.name}' has none; add --weld, or "
                "remove --independent"
            )
        given["independent"] = independent
    robot = robot.merged(given)
    units = {
        joint.name: joint.unit
        for joint in robot.joints
        if joint.name not in robot.wheels
    }
    arguments.joint_colors = colors_of(joint_styles(units))
    return robot


def _inputs_of(robot: fflin.Robot, inputs: str) -> Sequence[Input]:
    """Return the inputs that a word or a file of --inputs stands for."""
    if inputs == "joints" and not robot.n:
        raise InputError(f"--inputs joints: '{robot.name}' has no joints")
    if inputs == "wheels" and not robot.wheels:
        raise InputError(
            f"--inputs wheels: '{robot.name}' has no reaction wheels among its inputs"
        )
    bundled: dict[str, Sequence[Input]] = {
        "joints": (fflin.JointTorque("*"),),
        "base": (fflin.BaseTorque(), fflin.BaseForce()),
        "wheels": tuple(
            item for item in robot.inputs if isinstance(item, fflin.ReactionWheel)
        ),
    }
    if inputs in bundled:
        return bundled[inputs]
    try:
        return fflin.load_inputs(inputs)
    except UnknownNameError as error:
        if Path(inputs).is_file():
            raise
        raise UnknownNameError(
            f"{error}; --inputs also accepts {', '.join(bundled)}"
        ) from None


def colors_of(styles: Mapping[str, CurveStyle]) -> dict[str, str]:
    """Return the colours of the curves that have one; the colour of all others is grey."""
    return {name: style.color for name, style in styles.items() if style.is_named}


def limits_of_options(
    arguments: Namespace,
) -> list[str | dict[str, float]] | dict[str, float] | None:
    """Return the limits that the options --limits and --limit define."""
    given = once("--limit", arguments.limit)
    if arguments.limits == "urdf":
        return ["urdf", given]
    return given or None


def refuse(arguments: Namespace, names: Collection[str], why: str) -> None:
    """Raise an error with the reason `why` if any option in `names` is given."""
    given = [
        f"--{name.replace('_', '-')}"
        for name in names
        if getattr(arguments, name, None)
    ]
    if "tilt" in names and getattr(arguments, "tilt", None) is False:
        given.append("--no-tilt")
    if given:
        raise InputError(f"{', '.join(given)}: {why}; remove {', '.join(given)}")


def once(option: str, pairs: list[tuple[str, T]]) -> dict[str, T]:
    """Return {name: value} of a repeatable option; raise an error if a name is given twice."""
    values = dict(pairs)
    if len(values) < len(pairs):
        names = [name for name, _ in pairs]
        double = next(name for name in names if names.count(name) > 1)
        raise InputError(
            f"{option} is given more than once for '{double}'; give it once"
        )
    return values


def state_of(
    robot: fflin.Robot,
    arguments: Namespace,
    *states: Mapping[str, Any],
    prefix: str = "",
) -> tuple[Array, Array | None]:
    """Combine `states` with the options of a command; return q (nq,), and v (nv,) or None.

    Later states override earlier states, and options override all states. The options are --joint,
    --rpy, --position and --velocity. Their names can have a prefix, such as ``target_``.
    """
    from fflin.dynamics.points import base_of, combined

    given = {
        name: value
        for name in ("rpy", "position", "joint", "velocity")
        if (value := getattr(arguments, f"{prefix}{name}", None)) is not None
    }
    option = f"--{prefix}".replace("_", "-")
    names = robot.joint_names
    values = once(f"{option}joint", given.pop("joint"))
    rates = once(f"{option}velocity", given.pop("velocity", []))
    fflin.velocity(robot, rates)  # raises an error for invalid `rates`
    given["joints"] = joints_by_name("joint", values, names, robot.joint)
    given["velocity"] = rates_by_name(names, rates)
    state = reduce(combined, (*states, given))
    q = fflin.configuration(robot, state["joints"], base_of(state))
    v = None
    if state["velocity"]:
        v = fflin.velocity(robot, state["velocity"])
    if robot.constraints:
        from fflin.dynamics.closure import closed_point

        return closed_point(robot, q, v)
    return q, v


def point_of(
    robot: fflin.Robot, arguments: Namespace, prefix: str = ""
) -> tuple[Array, Array | None, pin.SE3 | None]:
    """Return q (nq,), v (nv,) and the reference of the operating point.

    The options override the operating point of the robot's file. With the prefix ``target_``,
    return the q, v and reference of the target, which may differ from the operating point. With
    --relative-equilibrium, the pose of this equilibrium is both the base pose and the reference.
    """
    equilibrium = getattr(arguments, "relative_equilibrium", None)  # 1 to 24, or None
    if equilibrium:
        names = (f"{prefix}rpy", f"{prefix}position")
        refuse(arguments, names, "--relative-equilibrium already sets the base pose")
    states = [robot.point]
    if prefix:
        states.append(robot.target)  # overrides entries of the operating point
    q, v = state_of(robot, arguments, *states, prefix=prefix)
    reference = reference_of(arguments)
    if equilibrium:
        q, reference = attitude(robot, q, equilibrium, arguments.frame)
    return q, v, reference


def reference_of(arguments: Namespace) -> pin.SE3 | None:
    """Return the reference of --reference; None means the base pose at the operating point."""
    import pinocchio as pin

    if "reference" in arguments and arguments.reference == "world":
        return pin.SE3.Identity()
    return None


def _orbit_of(arguments: Namespace, robot: fflin.Robot) -> dict[str, object]:
    """Return the field `orbit` of the robot; empty if no option changes the orbit.

    --orbit changes the heights, and keeps the magnetic field of the orbit in the robot file.
    """
    changes: dict[str, object] = {}
    for name in ("inclination", "field"):
        value = getattr(arguments, name, None)
        if value is not None:
            changes[name] = None if value == NO_ORBIT else value
    new = getattr(arguments, "orbit", None)
    if new is None and not changes:
        return {}
    if new == NO_ORBIT:
        why = "--orbit none removes the orbit, so this has no effect"
        refuse(arguments, ("inclination", "field"), why)
        return {"orbit": None}
    old = robot.orbit
    if new is None:
        if old is None:
            raise InputError(
                f"'{robot.name}' is not in orbit, so {listed(f'--{name}' for name in changes)} "
                "has no effect; add --orbit ALTITUDE"
            )
        new = _parts_of(old)
    elif old and old.body == new["body"]:
        kept = ("inclination", "field", "node_longitude")
        new = {name: getattr(old, name) for name in kept if hasattr(old, name)} | new
    return {"orbit": new | changes}


def _parts_of(orbit: fflin.CircularOrbit | fflin.EllipticOrbit) -> dict[str, object]:
    """Return the arguments of the class of an orbit that give the same orbit."""
    parts = asdict(orbit)
    # These follow from the altitude and the eccentricity.
    parts.pop("mean_motion", None)
    parts.pop("apogee", None)
    return parts


def linear_model(arguments: Namespace) -> tuple[fflin.Robot, fflin.LinearModel]:
    """Return the robot, and its linear model about the operating point in the arguments."""
    if not (arguments.equilibrium or arguments.relative_equilibrium):
        refuse(
            arguments,
            ("tilt",),
            "without --equilibrium, the base is not tilted",
        )
    robot = load_robot(arguments)
    return robot, model_about(robot, arguments, *point_of(robot, arguments))


def model_about(
    robot: fflin.Robot,
    arguments: Namespace,
    q: Array,
    v: Array | None,
    reference: pin.SE3 | None,
) -> fflin.LinearModel:
    """Linearise about q (nq,) and v (nv,), with the inputs of --effort or of an equilibrium.

    --equilibrium and --relative-equilibrium compute the inputs of an equilibrium, and add the
    spring deflections to q.
    """
    from fflin.dynamics.points import warn_beyond_limits

    axes = {"frame": arguments.frame, "reference": reference}
    given = once("--effort", arguments.effort)
    u = fflin.effort(robot, given) if given else None
    if arguments.relative_equilibrium or arguments.equilibrium:
        option = (
            "--relative-equilibrium"
            if arguments.relative_equilibrium
            else "--equilibrium"
        )
        refuse(
            arguments,
            ("effort",),
            f"{option} already sets the inputs at the operating point",
        )
        tilt = may_tilt(robot, arguments)
        held = fflin.equilibrium(robot, q, v=v, tilt=tilt, **axes)
        q, u = held.q, held.u
        warn_beyond_limits(robot, u)
    time = getattr(arguments, "time", None) or 0.0
    return fflin.linearize(robot, q, v, u, t=time, **axes)


def may_tilt(robot: fflin.Robot, arguments: Namespace) -> bool:
    """Return whether an equilibrium under gravity may tilt the base.

    Raise an error if --tilt or --no-tilt is given for a robot without gravity.
    """
    if not any(robot.gravity):
        refuse(
            arguments,
            ("tilt",),
            f"'{robot.name}' has no gravity (--gravity), so an equilibrium does not tilt the base",
        )
    return arguments.tilt is not False


def held_model(
    robot: fflin.Robot,
    arguments: Namespace,
    q: Array,
    v: Array | None,
    reference: pin.SE3 | None,
) -> fflin.LinearModel:
    """Linearise as `model_about` does, with the inputs that hold the robot at the point.

    With --no-tilt, an error is raised if no inputs hold the robot at the given attitude.
    """
    from fflin.linear.holding import held, held_if_possible

    point = model_about(robot, arguments, q, v, reference)
    if not may_tilt(robot, arguments):
        return held(point, tilt=False)
    return held_if_possible(point)


def model_to_regulate(
    robot: fflin.Robot,
    arguments: Namespace,
    q: Array,
    v: Array | None,
    reference: pin.SE3 | None,
) -> fflin.LinearModel:
    """Linearise as `model_about` does, with the inputs that hold the robot at the point.

    With --reduce, the conserved momenta are removed from the model.
    """
    lin = held_model(robot, arguments, q, v, reference)
    if arguments.reduce:
        return fflin.momentum_reduction(lin, wheel_speeds=arguments.wheel_speeds)
    return lin


def attitude(
    robot: fflin.Robot, q: Array, number: int, frame: Frame
) -> tuple[Array, pin.SE3]:
    """Return q (nq,) and the base placement of a relative equilibrium; `number` is 1 to 24."""
    import pinocchio as pin

    q = fflin.relative_equilibria(robot, q, frame=frame)[number - 1].q
    return q, pin.XYZQUATToSE3(q[:7])


def models_along(
    arguments: Namespace, robot: fflin.Robot | None = None, prefix: str = ""
) -> fflin.LinearTrajectory:
    """Return the linear models along the trajectory of --trajectory, or over one period.

    `prefix` is the prefix of the options of the point of --periodic, see `point_of`.
    """
    if getattr(arguments, "periodic", None):
        return _models_of_period(arguments, robot or load_robot(arguments), prefix)
    refuse(arguments, ("motion", "period"), "without --periodic N, this has no effect")
    if arguments.trajectory is None:
        raise InputError(
            "neither --trajectory FILE nor --periodic N is given; give one of them"
        )
    point = ("joint", "velocity", "effort", "equilibrium", "tilt", "rpy", "position")
    refuse(
        arguments,
        point,
        "with --trajectory, the models are about the points of the trajectory",
    )
    robot = robot or load_robot(arguments)
    settings = {"hold": arguments.hold, "frame": arguments.frame}
    motion = fflin.Trajectory.load(arguments.trajectory, robot, **settings)
    return fflin.linearize_trajectory(robot, motion, strict=arguments.strict)


def _models_of_period(
    arguments: Namespace, robot: fflin.Robot, prefix: str
) -> fflin.LinearTrajectory:
    """Return the linear models of --periodic, over one period of the robot's orbit."""
    of_point = ("effort", "equilibrium", "tilt", "relative_equilibrium", "time")
    names = ("trajectory", "hold", "strict", "frame", f"{prefix}velocity", *of_point)
    why = "--periodic N computes a periodic motion at rest, in base axes"
    refuse(arguments, names, why)
    states = (robot.point, robot.target) if prefix else (robot.point,)
    q, _ = state_of(robot, arguments, *states, prefix=prefix)
    motion = arguments.motion or "held"
    return fflin.linearize_orbit(
        robot,
        q,
        motion=motion,
        steps=arguments.periodic,
        period=arguments.period,
    )


def with_welds(robot: fflin.Robot, arguments: Namespace) -> fflin.Robot:
    """Return the robot with the welds of --weld."""
    welds = getattr(arguments, "weld", None)
    if not welds:
        return robot
    added = [fflin.Weld(frame, to) for frame, to in welds]
    return robot.merged({"constraints": [*robot.constraints, *added]})


def robot_of_design(
    robot: fflin.Robot,
    allocate: bool | None,
    law: SavedLaw | None = None,
) -> fflin.Robot:
    """Return the robot for a design; for allocation, base torque and force replace other inputs.

    These inputs are the thrusters and magnetorquers. The base force is omitted without thrusters.
    If `allocate` is None, they are allocated under two conditions: the thrusters can produce every
    wrench on the base, or the magnetorquers every moment, and `law` commands a base torque or is
    None. If only magnetorquers rotate the base, default weights for a slow loop are added.
    """
    if allocate is None:
        from fflin.control.authority import (
            thrusters_give_every_wrench,
            torquers_give_every_moment,
        )

        of_wrench = law is None or "tau_b.x" in commands_of(law)
        allocate = of_wrench and (
            thrusters_give_every_wrench(robot) or torquers_give_every_moment(robot)
        )
    if not allocate:
        return robot
    kinds = {*map(type, robot.inputs)}
    if not kinds & {fflin.Thruster, fflin.Magnetorquer}:
        raise InputError(
            f"--allocate needs thrusters or magnetorquers, but '{robot.name}' has none; define "
            "them in the file of --inputs"
        )
    others = tuple(
        item
        for item in robot.inputs
        if not isinstance(item, fflin.Thruster | fflin.Magnetorquer)
    )
    wanted: list[type[fflin.BaseTorque | fflin.BaseForce]] = [fflin.BaseTorque]
    if fflin.Thruster in kinds:
        wanted.append(fflin.BaseForce)
    missing = [kind() for kind in wanted if kind not in kinds]
    design = robot.replace(inputs=(*missing, *others))
    only_magnetic = kinds <= {fflin.Magnetorquer, fflin.JointTorque}
    if only_magnetic and robot.orbit and not robot.weights:
        from fflin.control.magnetic_weights import magnetic_weights

        return design.replace(weights=magnetic_weights(robot))
    return design


def commands_of(law: SavedLaw) -> tuple[str, ...]:
    """Return the names of the inputs of the robot that a law commands."""
    if isinstance(law, fflin.Compensator | fflin.MultirateCompensator):
        return law.output_names
    return law.input_names


def robot_of_law(robot: fflin.Robot, law: SavedLaw) -> fflin.Robot:
    """Return the robot without the inputs that a compensator does not command."""
    if not isinstance(law, fflin.Compensator | fflin.MultirateCompensator):
        return robot
    from fflin.control.saved_compensators import robot_with_inputs

    return robot_with_inputs(robot, law.output_names)


def designed(
    arguments: Namespace,
) -> tuple[fflin.Robot, fflin.Robot, fflin.LinearModel, fflin.Gain]:
    """Return the robot, the robot for the design, and the linear model and gain of the design."""
    robot = load_robot(arguments)
    design = robot_of_design(robot, arguments.allocate)
    if getattr(arguments, "after", None):
        point = _end_of_motion(design, arguments)
    else:
        point = point_of(design, arguments)
    lin = model_to_regulate(design, arguments, *point)
    gain = gain_of(lin, arguments, robot, allocated=design is not robot)
    return robot, design, lin, gain


def _end_of_motion(
    robot: fflin.Robot, arguments: Namespace
) -> tuple[Array, Array | None, pin.SE3 | None]:
    """Return the operating point at rest in the last row of the motion of --after."""
    from fflin.commands.phases import last_state

    names = ("joint", "rpy", "position", "velocity", "relative_equilibrium")
    refuse(arguments, names, "the operating point is the end of the motion of --after")
    q, _ = last_state(robot, arguments.after)
    return q, None, reference_of(arguments)


def tuning_of(
    arguments: Namespace,
) -> tuple[
    fflin.Robot, object, fflin.Structure, list[fflin.Goal], dict[str, Any], bool
]:
    """Return the robot, plant, structure, goals and settings of a search.

    The last result is True if the law commands a wrench that other inputs of the robot produce.
    The options --law, --goal and --vary replace the entries of the table [tune] of the robot file.
    All names are checked.
    """
    from fflin.tuning.specification import (
        check_signals,
        goals_of,
        structure_of,
        table_of,
    )

    robot = load_robot(arguments)
    given = dict(robot.tune)
    for key in ("law", "goal"):
        if texts := getattr(arguments, key):
            given[key] = [table_of(text) for text in texts]
        if not given.get(key):
            raise InputError(
                f"no {key} is given; add --{key}, or tables [[tune.{key}]] to the robot file"
            )
    if arguments.vary:
        given["vary"] = once("--vary", arguments.vary)
    settings: dict[str, Any] = {}
    for option in ("sample", "delay", "starts", "steps", "seed"):
        value = getattr(arguments, option)
        if value is None:
            value = given.get(option)
        if value is not None:
            settings["dt" if option == "sample" else option] = value
    if settings.get("delay") and settings.get("dt") is None:
        settings["dt"] = settings["delay"]
    goals = goals_of(given["goal"])
    design = robot_of_design(robot, arguments.allocate)
    lin = held_model(design, arguments, *point_of(design, arguments))
    structure = structure_of(given["law"], lin)
    check_signals(structure, goals, lin)
    plant: object = lin
    if given.get("vary"):
        plant = uncertain_plants(design, lin, arguments, given["vary"])
        settings["q"] = lin.q
    return design, plant, structure, goals, settings, design is not robot


def uncertain_plants(
    robot: fflin.Robot,
    lin: fflin.LinearModel,
    arguments: Namespace,
    ranges: dict[str, object],
) -> fflin.Uncertain:
    """Return the robots with parameters in ranges, for a law about the point of a model."""
    if lin.v.any() or arguments.effort:
        raise InputError(
            "velocities and --effort have no effect on uncertain models; remove them, or "
            "remove the ranges (--vary, [tune.vary])"
        )
    return fflin.uncertain(robot, ranges)


def tuned_law(
    path: Path, name: str | None
) -> tuple[fflin.LinearController, fflin.Robot]:
    """Return the law that `fflin tune` saved, and its robot, `name` or the robot of the file."""
    from fflin.base.errors import FflinError
    from fflin.base.record import text, texts
    from fflin.tuning.files import read_law, saved_law

    record = read_law(path)
    try:
        robot = fflin.load(name or text(record["robot"]))
    except FflinError:
        if name:
            raise
        raise InputError(
            f"the robot '{text(record['robot'])}' of the law is not known; give the robot of the "
            "design with --robot"
        ) from None
    inputs = {entry for _, names in robot.named_inputs for entry in names}
    if not {*texts(record["output_names"])} <= inputs:
        robot = robot_of_design(robot, None)
    return saved_law(record, robot), robot


def weights_of(arguments: Namespace) -> dict[str, object]:
    """Return a mapping with the rule of --weights, and the weights of --q, --r and --bryson."""
    names = ("q", "r", "bryson")
    given = {name: once(f"--{name}", getattr(arguments, name)) for name in names}
    return {"rule": arguments.weights, **given}


def single_weights(arguments: Namespace) -> set[str]:
    """Return the names in --q, --r and --bryson."""
    return {name for name, _ in (*arguments.q, *arguments.r, *arguments.bryson)}


def gain_of(
    lin: fflin.LinearModel,
    arguments: Namespace,
    robot: fflin.Robot,
    *,
    allocated: bool = False,
) -> fflin.Gain:
    """Return the regulator of a model of `robot`, or of its robot for the design.

    The options --weights, --q, --r and --bryson define the weights, and --integral the integrated
    signals. With --sample or --delay, the model is first discretised. If `allocated` is true, the
    error for an unknown name mentions --no-allocate.
    """
    # "none" switches off the integral action of the robot file.
    integral = [] if arguments.integral == ["none"] else arguments.integral or None
    delay = getattr(arguments, "delay", None) or 0.0
    sample = arguments.sample
    if sample is None and delay:
        sample = delay
    if sample is not None:
        lin = lin.discretize(sample, delay=delay)
    weights = weights_of(arguments)
    try:
        gain = fflin.lqr(
            lin,
            weights=weights,
            wheel_speeds=arguments.wheel_speeds,
            integral_action=integral,
        )
    except UnknownNameError as error:
        message = str(error)
        if allocated:
            message += "; --no-allocate weights single thrusters"
        raise UnknownNameError(message) from None
    if not lin.weights or robot.weights:
        return gain
    # The weights of the model are the default weights of `robot_of_design`.
    from fflin.control.magnetic_weights import described, magnetic_weights

    defaults = magnetic_weights(robot)["bryson"]
    rule = described(gain.weights, defaults, single_weights(arguments))
    return replace(gain, weights=rule)


def _phase_of(robot: fflin.Robot, arguments: Namespace) -> PhaseStart | None:
    """Return the start at the end of the motion of --after, or None without this option."""
    if not getattr(arguments, "after", None):
        return None
    from fflin.commands.phases import start_after

    names = ("joint", "rpy", "position", "velocity")
    along = ("offset", "trajectory", "schedule", "periodic")
    refuse(arguments, (*names, *along), "the start is the end of the motion of --after")
    # This also defines the placements of constraints that have none yet.
    return start_after(robot, arguments.after)


def loop_of(
    robot: fflin.Robot, arguments: Namespace
) -> tuple[fflin.Policy | None, dict[str, Any]]:
    """Return the policy (None with --free), and keyword arguments of `simulate`."""
    from fflin.simulation.plan import SHORTEST, time_to_settle

    settings: dict[str, Any] = {
        **{
            name: getattr(arguments, name)
            for name in ("dt", "method", "delay", "duration")
        },
        "limits": limits_of_options(arguments),
    }
    arguments.phase = _phase_of(robot, arguments)
    if not arguments.controller:
        refuse(
            arguments,
            ("negative_feedback",),
            "only --controller has a sign of the feedback",
        )
    if arguments.trajectory and arguments.controller:
        return _following(robot, arguments), settings
    if arguments.trajectory or arguments.schedule or arguments.periodic:
        policy, start = _tracking(robot, arguments)
        return policy, settings | start
    refuse(
        arguments,
        ("offset", "hold", "motion", "period"),
        "without --trajectory FILE or --periodic N, this has no effect",
    )
    if (law := detumbling_law(arguments)) is not None:
        return law, settings | _detumbling(robot, law, arguments)
    if arguments.free:
        of_law = ("limit", "delay", "reduce", "allocate", "gain", "controller", "mpc")
        names = (*_WEIGHTS, *_POSE, *_TARGETS[:2], "tilt", *of_law)
        refuse(
            arguments,
            names,
            "with --free there is no regulator and all inputs are zero",
        )
        q, v = start_of(robot, arguments)
        if arguments.duration is None:
            settings["duration"] = SHORTEST
        return None, settings | {"q0": q, "v0": v, "frame": arguments.frame}
    policy, linear, lin = about_point(robot, arguments)
    q, v = start_of(robot, arguments, linear.lin.reference)
    if robot.orbit and linear.lin.q[:3].any() and not q[:3].any():
        # The point was displaced so that the centre of mass is on the orbit. The start is, too.
        from fflin.linear.equilibrium import on_orbit

        if not point_of(robot, arguments, "target_")[0][:3].any():
            q = on_orbit(robot, q, linear.lin.frame)
    if arguments.duration is None:
        design = policy.commanded_robot or robot
        settings["duration"] = time_to_settle(design, linear, q, v)
    settings |= {"q0": q, "v0": v}
    if not robot.constraints:
        # A model in independent states does not predict a motion.
        settings["linear"] = lin
    return policy, settings


def _tracking(
    robot: fflin.Robot, arguments: Namespace
) -> tuple[fflin.Policy, dict[str, Any]]:
    """Return the policy with gains designed along a trajectory, and its start for `simulate`."""
    design = robot_of_design(robot, bool(arguments.allocate))
    tracking = along(design, arguments)
    start: dict[str, Any] = {}
    if offset := once("--offset", arguments.offset):
        start["q0"], start["v0"] = tracking.beside(offset)
    elif tracking.trajectory.period:
        start["q0"], start["v0"] = _start_beside(robot, tracking, arguments)
    if arguments.allocate:
        return fflin.Allocation(tracking, design), start
    return tracking, start


def _following(robot: fflin.Robot, arguments: Namespace) -> fflin.Policy:
    """Return the law of --controller along the trajectory of --trajectory."""
    start = ("offset", "joint", "rpy", "position", "velocity")
    refuse(
        arguments,
        (*start, *_POSE, *_TARGETS),
        "the trajectory defines the start and the target",
    )
    other_laws = ("gain", "reduce", "mpc", "free", "bdot", "rate_damping")
    refuse(
        arguments,
        (*_WEIGHTS, *other_laws),
        "--controller replaces the regulator and its options",
    )
    other_motions = ("schedule", "periodic", "period", "motion", "relative_equilibrium")
    refuse(arguments, other_motions, "the law follows the trajectory of --trajectory")
    trajectory = fflin.Trajectory.load(
        arguments.trajectory, robot, hold=arguments.hold, frame=arguments.frame
    )
    compensator = _compensator_of(arguments)
    design = robot_of_design(robot, arguments.allocate, compensator)
    lin = model_to_regulate(design, arguments, *point_of(design, arguments, "target_"))
    policy = _output_feedback(arguments, lin, compensator).follow(trajectory)
    return policy if design is robot else fflin.Allocation(policy, design)


def detumbling_law(arguments: Namespace) -> fflin.BDot | fflin.RateDamping | None:
    """Return the law of --bdot or --rate-damping, or None."""
    if arguments.rate_damping is not None:
        refuse(arguments, ("bdot",), "--rate-damping is another law for detumbling")
        return fflin.RateDamping(arguments.rate_damping)
    if arguments.bdot is not None:
        return fflin.BDot(arguments.bdot)
    return None


def _detumbling(
    robot: fflin.Robot, law: fflin.BDot | fflin.RateDamping, arguments: Namespace
) -> dict[str, Any]:
    """Return keyword arguments of `simulate` for a law that detumbles."""
    other_laws = ("free", "mpc", "gain", "controller", "reduce", "allocate")
    names = (*_WEIGHTS, *_POSE, *_TARGETS, *other_laws)
    why = "--bdot and --rate-damping replace the regulator and its options"
    refuse(arguments, names, why)
    law.form(robot)  # raises an error for a robot without magnetorquers
    q, v = start_of(robot, arguments)
    settings = {"q0": q, "v0": v, "frame": arguments.frame}
    assert robot.orbit is not None  # since it has magnetorquers
    if arguments.duration is None:
        settings["duration"] = robot.orbit.period
    return settings


def _start_beside(
    robot: fflin.Robot, tracking: fflin.TrajectoryFeedback, arguments: Namespace
) -> tuple[Array, Array]:
    """Return the initial q (nq,) and v (nv,) of a simulation along a periodic motion.

    By default, they are on the motion. If the motion displaces the base so that the centre of mass
    is on the orbit, the start is displaced, too.
    """
    from fflin.linear.equilibrium import on_orbit

    q_star, v_star, _ = tracking.reference(0.0)
    given = any(getattr(arguments, name) for name in ("joint", "rpy", "position"))
    q, v = start_of(robot, arguments)
    if not (given or robot.start or robot.point):
        q = q_star
    elif q_star[:3].any() and not q[:3].any():
        q = on_orbit(robot, q, "lvlh")
    return q, v_star if v is None else v


def with_errors(
    policy: fflin.Policy | None, arguments: Namespace
) -> fflin.Policy | None:
    """Return a policy whose measurements have the errors of --noise and --bias."""
    import numpy as np

    from fflin.base.names import by_name
    from fflin.campaign.dispersions import with_sensor_errors
    from fflin.control.data_sheet import output_keys

    given = {
        name: once(f"--{name}", getattr(arguments, name)) for name in ("noise", "bias")
    }
    if not any(given.values()):
        return policy
    if policy is None or not policy.sensors:
        raise InputError(
            "--noise and --bias need a regulator that measures states or outputs about a point"
        )
    if given["noise"] and not policy.sample_time:
        raise InputError("--noise is the noise of a sample; add --sample H")
    sizes = {}
    for name, values in given.items():
        keys = output_keys(values, policy.sensors)
        by_key = {keys[key]: value for key, value in values.items()}
        sizes[name] = np.zeros(len(policy.sensors))
        for index, value in by_name("measured signal", by_key, policy.sensors).items():
            sizes[name][index] = value
    seed = float(arguments.seed)
    return with_sensor_errors(policy.fresh(), sizes["bias"], sizes["noise"], seed)


def _budgeted_noise(arguments: Namespace) -> dict[str, float] | None:
    """Return the noise of --noise, or None for that of the outputs unless --no-noise is given."""
    given = once("--noise", getattr(arguments, "noise", []))
    if given or arguments.no_noise:
        return given
    return None


def budget_of(
    robot: fflin.Robot,
    policy: fflin.Policy | None,
    motion: fflin.Motion | None,
    arguments: Namespace,
    after: float | None = None,
) -> fflin.ErrorBudget:
    """Return the error budget of a loop, compared with its motion if there is one.

    The errors of the motion are counted from the time `after` [s] on, by default in its last half.
    """
    if policy is None or policy.model is None or not policy.laws_of_period():
        raise InputError(
            "--budget needs a linear regulator about a point; remove --budget, or the options for "
            "MPC, trajectories or --free"
        )
    model, delay = policy.model, arguments.delay
    if delay is not None:
        # The given delay replaces the delay of the design.
        model = model.generator or model
    return fflin.error_budget(
        policy,
        model,
        noise=_budgeted_noise(arguments),
        bias=once("--bias", getattr(arguments, "bias", [])),
        delay=delay,
        robot=robot,
        motion=motion,
        limit_cycle=motion is not None,
        after=after,
    )


def start_of(
    robot: fflin.Robot, arguments: Namespace, reference: pin.SE3 | None = None
) -> tuple[Array, Array | None]:
    """Return the initial q (nq,) and v (nv,) from the arguments or the robot.

    With --relative-equilibrium, the given base pose is relative to `reference`, or by default to
    the pose of this equilibrium.
    """
    if arguments.phase is not None:
        return arguments.phase.q, arguments.phase.v
    point, number = robot.point, arguments.relative_equilibrium
    # omit the base pose of the point, because the pose `about` below replaces it
    if number:
        point = {part: point[part] for part in ("joints", "velocity") if part in point}
    rates = rates_by_name(
        robot.joint_names, once("--target-velocity", arguments.target_velocity)
    )
    q, v = state_of(robot, arguments, point, {"velocity": rates}, robot.start)
    if number:
        import pinocchio as pin

        about = reference or attitude(robot, q, number, arguments.frame)[1]
        q[:7] = pin.SE3ToXYZQUAT(about * pin.XYZQUATToSE3(q[:7]))
    return q, v


def start_notes(robot: fflin.Robot, arguments: Namespace) -> tuple[str, ...]:
    """Return a note on a start that [start] of the robot file defines."""
    if not robot.start or arguments.phase is not None:
        return ()
    options = [
        f"--{name}"
        for name in ("joint", "rpy", "position", "velocity")
        if getattr(arguments, name)
    ]
    changed = f"; {listed(options)} replace entries of it" if options else ""
    note = (
        "start: [start] of the robot file, to which the dispersions of states are added"
    )
    return (note + changed,)


def about_point(
    robot: fflin.Robot, arguments: Namespace
) -> tuple[
    fflin.Policy,
    fflin.StateFeedback | fflin.LinearController | fflin.MultirateFeedback,
    fflin.LinearModel | None,
]:
    """Return the policy about a point, its linear feedback, and the model that predicts the motion.

    The model is None for MPC, for a reduced model, for a controller from a file, and for allocated
    thrusters. In these cases, `simulate` predicts the motion with the policy's own model if it can,
    and otherwise makes no prediction.
    """
    from fflin.control.gain import sampled_for

    gain: fflin.Gain | None = None
    feedback: fflin.StateFeedback | fflin.LinearController | fflin.MultirateFeedback
    if arguments.mpc:
        names = ("allocate", "gain", "controller", "reduce", "integral")
        refuse(arguments, names, "--mpc replaces the regulator and its options")
        if arguments.sample is None:
            raise InputError(
                "--mpc needs the sample time of the controller; add --sample H"
            )
        arguments.allocate = False
    if arguments.gain:
        why = "the file of --gain already contains the weights and the operating point"
        refuse(arguments, (*_WEIGHTS, *_TARGETS), why)
        gain = fflin.Gain.load(arguments.gain)
    compensator = _compensator_of(arguments)
    design = robot_of_design(robot, arguments.allocate, gain or compensator)
    if gain:
        lin = _about_gain(design, gain, arguments)
    else:
        lin = model_to_regulate(
            design, arguments, *point_of(design, arguments, "target_")
        )
    if arguments.mpc:
        from fflin.control.mpc import Mpc

        settings = {"dt": arguments.sample, "limits": limits_of_options(arguments)}
        weights = weights_of(arguments)
        controller = fflin.mpc(
            lin, horizon=arguments.horizon, weights=weights, **settings
        )
        assert isinstance(controller, Mpc)  # since the model is about a point
        return controller, fflin.StateFeedback(controller.lin, controller.gain.K), None
    if arguments.controller:
        of_gain = (*_WEIGHTS, "gain", "reduce")
        refuse(
            arguments, of_gain, "--controller replaces the regulator and its options"
        )
        feedback = _output_feedback(arguments, lin, compensator)
    else:
        gain = gain or gain_of(lin, arguments, robot, allocated=design is not robot)
        feedback = _state_feedback(sampled_for(gain, lin), gain)
    if design is not robot:
        return fflin.Allocation(feedback, design), feedback, None
    if arguments.reduce or arguments.controller:
        return feedback, feedback, None
    return feedback, feedback, lin


def _compensator_of(
    arguments: Namespace,
) -> fflin.Compensator | fflin.MultirateCompensator | None:
    """Return the sampled compensator in the file of --controller, or None."""
    from fflin.control.saved_compensators import sampled_compensator

    if not arguments.controller:
        return None
    return sampled_compensator(arguments.controller)


def _output_feedback(
    arguments: Namespace,
    lin: fflin.LinearModel,
    compensator: fflin.Compensator | fflin.MultirateCompensator | None,
) -> fflin.LinearController | fflin.MultirateFeedback:
    """Return the law in the file of --controller, which may be a compensator of `fflin lqg`."""
    from fflin.control.saved_compensators import feedback_of

    if compensator is None:
        sign = -1.0 if arguments.negative_feedback else 1.0
        return fflin.LinearController(arguments.controller, lin, sign=sign)
    why = "the law of `fflin lqg` already has the sign of its feedback"
    refuse(arguments, ("negative_feedback",), why)
    return feedback_of(compensator, lin)


def _state_feedback(model: fflin.LinearModel, gain: fflin.Gain) -> fflin.StateFeedback:
    """Return the feedback of a gain about the point of a model, which may be another point."""
    import numpy as np

    if not gain.integrals:
        return fflin.StateFeedback(model, gain.K)
    none = np.zeros(len(gain.integrals))
    x0 = np.concatenate((model.x0, none))
    moved = replace(gain, x0=x0, u0=model.u0, placement=model.placement)
    return fflin.StateFeedback(model, moved)


def _about_gain(
    robot: fflin.Robot, gain: fflin.Gain, arguments: Namespace
) -> fflin.LinearModel:
    """Return the linear model about the point for which a gain was designed.

    If the base pose of the gain's operating point is the reference of the gain, the new reference
    is the target pose of the base. Otherwise, the reference of the gain is used. With
    --relative-equilibrium, the new reference is always the pose of this equilibrium.
    """
    import pinocchio as pin

    from fflin.control.gain import model_of

    if gain.dependent or gain.x0[:6].any():
        refuse(
            arguments, _POSE, "the file of --gain already contains the pose of the base"
        )
        pose = gain.placement
    else:
        pose = point_of(robot, arguments, "target_")[0][:7]
    linear = partial(
        model_of, gain, robot, f"{arguments.gain} was made for '{gain.robot}'"
    )
    lin = linear(pin.XYZQUATToSE3(pose))
    if number := arguments.relative_equilibrium:
        return linear(attitude(robot, lin.q, number, lin.frame)[1])
    return lin


def along(robot: fflin.Robot, arguments: Namespace) -> fflin.TrajectoryFeedback:
    """Return the feedback along the trajectory of --trajectory or --schedule."""
    regulator = (
        "free",
        "gain",
        "relative_equilibrium",
        *_POSE,
        *_TARGETS,
    )
    refuse(
        arguments,
        ("controller",),
        "--schedule and --periodic have gains of their own; with --trajectory, a law from a file "
        "follows a trajectory",
    )
    why = (
        "the trajectory defines the regulator, its target, and the start, "
        "which --offset displaces"
    )
    refuse(
        arguments,
        ("mpc",),
        "on the command line, MPC holds a fixed target; in Python, fflin.mpc(models, ...) follows "
        "the models = fflin.linearize_trajectory(robot, motion) of a trajectory",
    )
    refuse(arguments, ("integral",), "a law along a trajectory has no integral action")
    start = ("joint", "rpy", "position", "velocity")
    if arguments.schedule is None:
        if not getattr(arguments, "periodic", None):
            refuse(arguments, (*regulator, *start), why)
        models = models_along(arguments, robot, "target_")
        weights = weights_of(arguments)
        end = "periodic" if models.period else "steady"
        schedule = fflin.tvlqr(models, Qf=end, sample=arguments.sample, weights=weights)
        return fflin.TrajectoryFeedback(models, schedule)
    designed = "the file of --schedule already contains the trajectory and the design of its gains"
    refuse(
        arguments,
        ("trajectory", "hold", "periodic", "period", "motion", *_WEIGHTS),
        designed,
    )
    schedule = fflin.GainSchedule.load(arguments.schedule)
    refuse(arguments, regulator if schedule.period else (*regulator, *start), why)
    return fflin.TrajectoryFeedback(schedule.trajectory(robot), schedule)


def check_pictures(robot: fflin.Robot, arguments: Namespace) -> None:
    """Raise an error for invalid options of `pictures`, before a long simulation starts."""
    from fflin.simulation.plan import LONGEST
    from fflin.view.visualize import check_outputs, check_playback, tool_frame

    if not check_outputs({f".{name}": getattr(arguments, name) for name in _FILES}):
        return
    tool_frame(robot, arguments.tool)
    duration = arguments.duration or LONGEST
    check_playback(arguments.fps, arguments.speed, arguments.times, 0.0, duration)


def pictures(
    robot: fflin.Robot, motion: Callable[[], fflin.Motion], arguments: Namespace
) -> dict[Path | None, Callable[[Path], object]]:
    """Return {path: function that writes the file} for a web page and pictures of a motion.

    The path of a file that is not asked for is None. `motion` is called when a file is written.
    """
    options = {
        name: getattr(arguments, name) for name in ("times", "fps", "speed", *SHOWN)
    }

    def write(path: Path) -> None:
        # `visualize` takes the path as html=, png= or gif=, like the ending of the file.
        kind = path.suffix.removeprefix(".")
        output: dict[str, Any] = {kind: path}
        fflin.visualize(robot, motion(), **options, **output)

    return {getattr(arguments, name): write for name in _FILES}
