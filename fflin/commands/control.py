"""Commands that design controllers, write C code, and compute simulations, campaigns and sweeps."""

from __future__ import annotations

import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fflin
from fflin.base.errors import DetectabilityError, FflinWarning, FileError, InputError
from fflin.base.names import chosen, input_keys
from fflin.base.process import Progress, Status
from fflin.base.tables import folded
from fflin.commands import DONE, FELL_SHORT
from fflin.commands.builders import (
    Report,
    along,
    budget_of,
    check_pictures,
    colors_of,
    designed,
    detumbling_law,
    limits_of_options,
    load_robot,
    loop_of,
    models_along,
    once,
    pictures,
    point_of,
    reference_of,
    refuse,
    robot_of_design,
    robot_of_law,
    start_notes,
    state_of,
    tuned_law,
    tuning_of,
    uncertain_plants,
    weights_of,
    with_errors,
    with_welds,
)

if TYPE_CHECKING:
    from fflin.base.validation import Array
    from fflin.batch.configurations import Configurations
    from fflin.control.gain import Margins as GainMargins

_ROWS = 240  # number of instants per run at which --plot shows errors and inputs

_ALLOCATED = (
    "allocation: tau_b and F_b are realised by the thrusters, in `fflin simulate --gain` too; "
    "--no-allocate designs the thrusts themselves"
)

_MAGNETIC = (
    "allocation: magnetorquers realise the part of tau_b across the magnetic field, in `fflin "
    "simulate --gain` too; without given weights, the loop is as slow as the orbit, because a "
    "faster loop is unstable; simulate several orbits to see whether the loop is stable"
)

_TORQUE_OF_OTHERS = (
    "the law commands a torque on the base, which thrusters or magnetorquers produce: `fflin "
    "simulate` and `montecarlo` allocate it, in Python fflin.Allocation does; "
    "--no-allocate tunes a law that commands each of them"
)

_LARGER_MARGIN = (
    "compare other --process-noise and larger --r, or omit both for the default noise and "
    "weights"
)

_NOT_ALLOCATED = (
    "no allocation: the gains command each thruster, in `fflin simulate` too, and negative thrust "
    "is cut at zero"
)


def lqr(arguments: Namespace) -> Report:
    """Design a linear quadratic regulator; show gain, poles, residual and margins.

    example: fflin lqr canadarm2 -o gain.npz
    """
    from fflin.base.record import record_of

    robot, design, _, gain = designed(arguments)
    # The report omits warnings, because they already appear on stderr.
    text = "\n\n".join(
        x for x in str(gain).split("\n\n") if not x.startswith("warning: ")
    )
    if design is not robot:
        thrusters = any(isinstance(x, fflin.Thruster) for x in robot.inputs)
        text += f"\n\n{folded([_ALLOCATED if thrusters else _MAGNETIC])}"
    result = {
        **record_of(gain),
        "margins": gain.margins,
        "allocated": design is not robot,
    }
    files = {
        arguments.output_file: gain.save,
        arguments.plot: lambda path: fflin.plot_loops(gain, path),
    }
    return Report(gain.robot, result, text, files)


def lqg(arguments: Namespace) -> Report:
    """Design a regulator with a Kalman filter of the outputs; show poles, errors and margins.

    example: fflin lqg satellite.toml --sample 0.25 --delay 0.25 --inputs wheels -o law.npz
    """
    from fflin.base.record import record_of
    from fflin.commands.filtering import deviations_table, filter_of
    from fflin.control.filter_deviations import deviations
    from fflin.control.margins import margins_at_once
    from fflin.control.saved_compensators import policy_of

    if arguments.sample is None and not arguments.delay:
        raise InputError("a filter needs the sample time of the law; add --sample H")
    arguments.reduce = False
    robot, design, _, gain = designed(arguments)
    model = gain._lin
    assert model is not None  # since it was designed here
    plants = None
    if arguments.vary:
        if robot.orbit:
            raise InputError(
                "--vary needs a robot without an orbit; add --orbit none, and fly the law in the "
                "orbit with `fflin montecarlo`"
            )
        ranges = once("--vary", arguments.vary)
        plants = uncertain_plants(design, model, arguments, ranges)
    try:
        estimator, note = filter_of(model, gain, arguments)
    except DetectabilityError as error:
        if robot.wheels and design is not robot:
            hint = "; --inputs wheels designs a law of the wheels alone"
            raise DetectabilityError(f"{error}{hint}") from None
        raise
    compensator = fflin.lqg(gain, estimator)
    policy = policy_of(compensator, model)
    margins = margins_at_once(policy, None, None)
    _warn_of_margins(margins)
    errors = deviations(estimator, model)
    notes = [f"weights: {gain.weights}", note]
    # The report of the compensator already contains the note on a slow bias.
    notes += [x for x in policy.notes if x != compensator.slow_bias]
    if design is not robot:
        notes.append(_TORQUE_OF_OTHERS)
    parts = [str(compensator), folded([_margins_line(margins)])]
    result = {**record_of(compensator), "margins": margins}
    if plants is not None:
        worst = plants.worst(policy, model.q)
        parts.append(f"over the ranges of --vary:\n{worst}")
        result["worst"] = worst
    parts += [deviations_table(errors), folded(notes)]
    result |= {
        "standard_deviations": {name: value for name, (value, _) in errors.items()},
        "units": {name: unit for name, (_, unit) in errors.items()},
        "notes": notes,
        "allocated": design is not robot,
    }
    files: dict[Path | None, Callable[[Path], object]] = {
        arguments.output_file: compensator.save,
        arguments.plot: lambda path: fflin.plot_loops(policy, path),
    }
    return Report(robot.name, result, "\n\n".join(parts), files)


def tune(arguments: Namespace) -> Report:
    """Tune a PD, PID or other law to goals; show the goals, the parameters and the search.

    example: fflin tune satellite.toml --law 'pd shared=true' --goal 'margin disk=0.75' -o law.npz
    """
    robot, plant, structure, goals, settings, allocated = tuning_of(arguments)
    with closing(Status()) as line:
        tuned = fflin.tune(plant, structure, goals, **settings, progress=line.say)
    text = str(tuned)
    if allocated:
        text += f"\n\n{folded([_TORQUE_OF_OTHERS])}"
    files: dict[Path | None, Callable[[Path], object]] = {
        arguments.output_file: tuned.save,
        arguments.plot: lambda path: fflin.plot_tuned(tuned, path),
    }
    code = DONE
    if not all(goal.met for goal in tuned.goals if goal.hard):
        code = FELL_SHORT
    return Report(robot.name, tuned.record(), text, files, code)


def tvlqr(arguments: Namespace) -> Report:
    """Design a time-varying linear quadratic regulator along a trajectory or over an orbit.

    example: fflin tvlqr planar_detumble --trajectory plan.csv --hold previous --sample 0.1 -o
    gains.npz
    """
    why = "along a trajectory no reduced model is needed, because the finite-horizon cost exists"
    refuse(arguments, ("reduce",), why)
    along = models_along(arguments)
    Qf: dict[str, float] | str = once("--qf", arguments.qf) or "steady"
    if along.period:
        refuse(arguments, ("qf",), "the cost of --periodic N has no end")
        Qf = "periodic"
    schedule = fflin.tvlqr(
        along, Qf=Qf, sample=arguments.sample, weights=weights_of(arguments)
    )
    text = str(schedule)
    if any(isinstance(item, fflin.Thruster) for item in along.robot.inputs):
        text += f"\n{folded([_NOT_ALLOCATED])}"
    return Report(
        along.robot.name, schedule, text, {arguments.output_file: schedule.save}
    )


def export(arguments: Namespace) -> Report:
    """Write C99 code of a gain, compensator, gain schedule or tuned law, with a test program.

    example: fflin export gain.npz --robot servicer_7dof --limits urdf -o flight
    """
    from fflin.base.record import read_record, reading, text

    kinds = {
        kind.__name__: kind
        for kind in (
            fflin.Gain,
            fflin.GainSchedule,
            fflin.Compensator,
            fflin.MultirateCompensator,
        )
    }
    with reading(arguments.file, "Gain, GainSchedule, Compensator or tuned law"):
        kind_name = text(read_record(arguments.file)[0]["kind"])
        if kind_name not in (*kinds, "Tuned"):
            raise ValueError(f"the file contains: {kind_name}")
    law: Any
    robot = None
    if kind_name == "Tuned":
        law, robot = tuned_law(arguments.file, arguments.robot)
    else:
        law = kinds[kind_name].load(arguments.file)
    if (arguments.robot or arguments.weld) and robot is None:
        loaded = with_welds(fflin.load(arguments.robot or law.robot), arguments)
        robot = robot_of_law(robot_of_design(loaded, None, law), law)
    limits = None if arguments.limits == "none" else arguments.limits
    name, real = arguments.name, arguments.real
    folder = fflin.write_c(
        law, arguments.output_folder, robot=robot, limits=limits, name=name, real=real
    )
    test = (
        f"cd '{folder}'\n"
        f"  cc -std=c99 -o {name}_test {name}.c {name}_test.c -lm\n"
        f"  ./{name}_test"
    )
    message = f"C99 code of {law!r}, with numbers of type {real}\nto test it:\n  {test}"
    result = {"name": name, "real": real, "folder": str(folder)}
    endings = (".h", ".c", "_test.c", ".json")
    name_of_robot = robot.name if robot else law.robot
    return Report(
        name_of_robot,
        result,
        message,
        {folder / f"{name}{end}": None for end in endings},
    )


def plan(arguments: Namespace) -> Report:
    """Plan a low-effort trajectory between two states within limits.

    example: fflin plan planar_detumble --target-joint joint_1=0.3 --duration 20 -o plan.npz
    """
    robot = load_robot(arguments)
    q0, v0 = state_of(robot, arguments, robot.point, robot.start)
    guess = None
    if arguments.guess:
        guess = fflin.Trajectory.load(arguments.guess, robot)
    motion = fflin.plan(
        robot,
        point_of(robot, arguments, "target_")[:2],
        arguments.duration,
        q0=q0,
        v0=v0,
        knots=arguments.knots,
        hold=arguments.hold,
        limits=limits_of_options(arguments),
        R=once("--r", arguments.r) or None,
        free=arguments.free_end,
        guess=guess,
    )
    return Report(robot.name, motion, str(motion), {arguments.output_file: motion.save})


def simulate(arguments: Namespace) -> Report:
    """Simulate the robot with a regulator to a target or along a trajectory.

    example: fflin simulate ets_vii --rpy 30 0 0 --duration 60 --html loop.html --plot loop.png
    """
    from fflin.simulation.plots import JOINTS, styles_of
    from fflin.simulation.report import motion_record, motion_report

    window = _window(arguments)
    robot = load_robot(arguments)
    show = arguments.show
    check_pictures(robot, arguments)
    if show:
        lin = fflin.linearize(robot)
        chosen("state or input", show, (*lin.state_names, *input_keys(lin)))
    policy, settings = loop_of(robot, arguments)
    measuring = with_errors(policy, arguments)
    if measuring is not policy:
        settings.pop("linear", None)  # the linear model has no sensor errors
    if arguments.no_noise:
        settings["noise"] = 0.0
    settings["seed"] = arguments.seed
    motion = fflin.simulate(
        robot, measuring, every=arguments.every, engine=arguments.engine, **settings
    )
    files: dict[Path | None, Callable[[Path], object] | None] = {
        arguments.output_file: motion.save,
        arguments.plot: partial(motion.plot, show=show or None),
        **pictures(robot, lambda: motion, arguments),
    }
    arguments.joint_colors = colors_of(styles_of(motion).get(JOINTS[0], {}))
    code = FELL_SHORT if motion.stopped else DONE
    interrupted = ""
    if motion.stopped.startswith("interrupted"):
        interrupted = motion.stopped
    text = motion_report(motion)
    record = motion_record(motion)
    if arguments.phase is not None and (impact := arguments.phase.impact):
        record["impact"] = {
            "event": impact.event,
            "impulse": impact.impulse,
            "energy_lost": impact.energy_lost,
        }
        text += f"\n{folded([f'impact at the start: {impact.summary}'])}"
    record["margins"], line = _margins_of(policy, settings)
    if line:
        text += f"\n{folded([line])}"
    if detumbling_law(arguments) is not None and not motion.stopped:
        record["detumbling_time"] = fflin.detumbling_time(motion)
    settled = None
    if window is not None and not motion.stopped:
        pointing = motion.pointing(window, accuracy=arguments.accuracy)
        settled = pointing.after
        record["pointing"] = pointing
        text += f"\n\n{pointing}"
    if arguments.budget and not motion.stopped:
        budget = budget_of(robot, policy, motion, arguments, settled)
        record["budget"] = budget
        text += f"\n\n{budget}"
    return Report(robot.name, record, text, files, code, interrupted)


def _margins_of(policy: object, settings: Mapping[str, Any]) -> tuple[object, str]:
    """Return the margins of the loop of a simulation for all inputs at once, and a line on them."""
    from fflin.control.margins import margins_at_once
    from fflin.control.policy import Policy

    if not isinstance(policy, Policy) or not policy.laws_of_period():
        return None, ""
    margins = margins_at_once(policy, settings.get("delay"), settings.get("sample"))
    return margins, _margins_line(margins)


def _margins_line(margins: GainMargins | None) -> str:
    """Return a line on the margins of a loop for all inputs at once."""
    from fflin.control.loop_margins import FRAGILE

    if margins is None:
        return "margins of the linear loop: see fflin.margins(policy, lin)"
    if not margins.disk:
        return "margins of the linear loop: none, because it is unstable"
    low, high = margins.gain
    line = (
        f"margins of the linear loop, all inputs at once: gain {low:.3g} to {high:.3g}, phase "
        f"{margins.phase:.3g} deg (disk margin {margins.disk:.3g})"
    )
    if margins.disk < FRAGILE:
        line += "; a small delay or model error makes the loop unstable"
    return line


def _warn_of_margins(margins: GainMargins | None) -> None:
    """Warn of a small disk margin of a loop with a filter, by the rule of `lqr`."""
    from fflin.control.gain import fragility
    from fflin.control.loop_margins import FRAGILE

    if margins is None or margins.disk >= FRAGILE:
        return
    text = f"with the filter, {fragility(margins)}; {_LARGER_MARGIN}"
    warnings.warn(text, FflinWarning, stacklevel=3)


def _window(arguments: Namespace) -> float | None:
    """Return the window [s] of the pointing errors, or None."""
    window: float | None = arguments.pointing
    if window is None and arguments.accuracy is not None:
        raise InputError("--accuracy needs --pointing WINDOW")
    return window


def montecarlo(arguments: Namespace) -> Report:
    """Simulate a loop with random parameters; show quantiles, success rates and the worst runs.

    example: fflin montecarlo ets_vii uncertain.toml --runs 1000 --plot runs.png
    """
    from fflin.campaign.pointing import pointing_record
    from fflin.campaign.report import campaign_record, worst_runs
    from fflin.control.policy import BoundLaw, bound

    window = _window(arguments)
    path = arguments.output_file
    is_table = path is not None and path.suffix in (".csv", ".mat")
    if is_table and path.exists() and not arguments.force:
        raise FileError(
            f"{path} already exists; give another file name, or add --force"
        )
    dispersions = fflin.load_dispersions(arguments.dispersions)
    robot = load_robot(arguments)
    check_pictures(robot, arguments)
    policy, settings = loop_of(robot, arguments)
    settings.pop("linear", None)  # the runs are not compared with a linear model
    for name in (
        "runs",
        "seed",
        "until",
        "width",
        "confidence",
        "workers",
        "threads",
        "engine",
    ):
        settings[name] = getattr(arguments, name)
    if arguments.no_noise:
        settings["noise"] = 0.0
    budget = None
    if arguments.budget:
        # Before the runs, because a loop without a budget is refused.
        budget = budget_of(robot, policy, None, arguments)
    settings["histories"] = _ROWS if arguments.plot else 0
    settings["out"] = None if is_table else path
    with going_on(path, "runs") as progress:
        campaign = fflin.monte_carlo(
            robot,
            policy,
            dispersions,
            goals=arguments.goal,
            progress=progress,
            overwrite=arguments.force,
            **settings,
        )
    worst = cache(lambda: campaign.replay(campaign.worst(1)[0]))
    files = {
        path: campaign.save if is_table else None,
        arguments.plot: lambda file: fflin.plot_campaign(campaign, file),
        **pictures(robot, worst, arguments),
    }
    command = bound(policy, robot) if policy else None
    notes = command.notes if isinstance(command, BoundLaw) else ()
    if "q0" in settings and not arguments.offset:
        notes += start_notes(robot, arguments)
    shown = [str(campaign), *(folded([note]) for note in notes)]
    text = "\n".join([*shown, *worst_runs(campaign, arguments.worst)])
    result = {**campaign_record(campaign, arguments.worst), "notes": notes}
    if window is not None and not campaign.stopped.all():
        with going_on(path, "runs") as progress:
            errors = campaign.pointing(
                window, accuracy=arguments.accuracy, progress=progress
            )
        result["pointing"] = pointing_record(errors)
        text += f"\n\n{errors}"
    if budget is not None:
        result["budget"] = budget
        text += f"\n\n{budget}"
    return Report(robot.name, result, text, files)


def validity(arguments: Namespace) -> Report:
    """Find how far the robot can be displaced before the linear model or its regulator fails.

    example: fflin validity ets_vii --attitude 120 --samples 200 --jobs 2
    """
    robot, design, lin, gain = designed(arguments)
    model = lin.discretize(arguments.sample) if arguments.sample else lin
    limits = "urdf" if arguments.limits == "urdf" else None
    workers = arguments.jobs if arguments.jobs > 1 else None
    with closing(Progress()) as bar:
        result = fflin.validity(
            design,
            model,
            gain,
            attitude=arguments.attitude,
            position=arguments.offset,
            joint=arguments.spread,
            samples=arguments.samples,
            seed=arguments.seed,
            limits=limits,
            workers=workers,
            progress=bar,
        )
    text = str(result)
    if limits or any(name in lin.limits for name in lin.input_names):
        saturation = "not saturated; use --limits urdf to saturate them"
        if limits:
            saturation = "saturated at the limits of the robot"
        text += f"\n{folded([f'inputs were {saturation}'])}"
    if design is not robot:
        text += (
            "\nideal torques and forces on the base replace the thrusters and magnetorquers "
            "(--no-allocate)"
        )
    files = {arguments.plot: lambda path: fflin.plot_validity(result, path)}
    return Report(robot.name, result, text, files)


def funnel(arguments: Namespace) -> Report:
    """Find the initial errors from which the regulator along a trajectory reaches a goal.

    example: fflin funnel arm.toml --schedule gains.npz --goal attitude=1
    """
    if arguments.trajectory is None and arguments.schedule is None:
        raise InputError(
            "neither --trajectory nor --schedule is given; give one of them"
        )
    robot = load_robot(arguments)
    policy = along(robot, arguments)
    with closing(Progress()) as bar:
        result = fflin.funnel(
            robot,
            policy,
            once("--goal", arguments.goal),
            within=once("--within", arguments.within),
            limits=limits_of_options(arguments),
            progress=bar,
            dt=arguments.dt,
            knots=arguments.knots,
            samples=arguments.samples,
            seed=arguments.seed,
            confidence=arguments.confidence,
            threads=arguments.threads,
        )
    files = {
        arguments.plot: lambda path: fflin.plot_funnel(result, path),
        arguments.output_file: result.save,
    }
    return Report(robot.name, result, str(result), files)


def sweep(arguments: Namespace) -> Report:
    """Linearise about many points and save all models.

    example: fflin sweep servicer_7dof --grid joint_2=-1:1:21 --grid joint_4=-2:0:11 -o grid.h5
    """
    from fflin.batch.files import part_of
    from fflin.batch.sweep import ChunkJob

    path = arguments.output_file
    robot = load_robot(arguments)
    settings = {"frame": arguments.frame, "reference": reference_of(arguments)}
    linearizer = fflin.Linearizer(robot, **settings)
    q, v, u = _points(robot, arguments)
    size = len(q) * ChunkJob(linearizer, at_rest=v is None and u is None).row_bytes
    part = part_of(path)
    needs = f"{size / 1e9:,.1f} GB" if size >= 1e9 else f"{size / 1e3:,.1f} kB"
    message = (
        f"linearising '{robot.name}' about {len(q):,} points; {path} takes {needs}"
    )
    if part.exists():
        message += f", resuming from {part}"
    with going_on(path, "points") as progress:
        progress.announce(f"fflin: {message}")
        work = {
            "engine": arguments.engine,
            "workers": arguments.workers,
            "progress": progress,
        }
        batch = fflin.sweep(robot, q, v, u, **settings, **work, out=path)
    states, inputs = len(batch.state_names), len(batch.input_names)
    counts = f"{len(batch):,} points, {states} states, {inputs} inputs"
    text = folded([f"{robot.name}: {counts}", *batch.notes])
    names = ("state_names", "state_units", "input_names", "input_units", "frame")
    result = {"points": len(batch), **{name: getattr(batch, name) for name in names}}
    result["notes"] = batch.notes
    return Report(robot.name, result, text, {path: None})


def _points(
    robot: fflin.Robot, arguments: Namespace
) -> tuple[Configurations, Array | None, Array | None]:
    """Return the configurations q of a sweep, and v and u, which are the same at all points."""
    import numpy as np
    import pinocchio as pin

    from fflin.robot.joints import by_joint

    if bool(arguments.grid) == (arguments.random is not None):
        raise InputError(
            "a sweep needs exactly one of --grid and --random; give one of them"
        )
    if arguments.range and arguments.random is None:
        raise InputError("--range needs --random; --grid has its own ranges")
    q, v = state_of(robot, arguments, robot.point)
    u = None
    if arguments.effort:
        u = fflin.effort(robot, once("--effort", arguments.effort))
    fixed = once("--joint", arguments.joint)
    base = robot.model.jointPlacements[1] * pin.XYZQUATToSE3(q[:7])
    if arguments.random is not None:
        ranges = once("--range", arguments.range)
        ranges |= {name: (value, value) for name, value in fixed.items()}
        drawn = {"seed": arguments.seed, "ranges": ranges, "base": base}
        return fflin.random_configurations(robot, arguments.random, **drawn), v, u
    axes = once("--grid", arguments.grid)
    values = {name: np.linspace(*axis) for name, axis in axes.items()}
    joints = {
        **robot.point.get("joints", {}),
        **by_joint(fixed, robot.joint_names, robot.joint),
    }
    others = {
        name: x for name, x in joints.items() if name not in axes or name in fixed
    }
    return fflin.grid(robot, values, joints=others, base=base), v, u


@contextmanager
def going_on(path: Path | None, what: str) -> Iterator[Progress]:
    """Return a context with a progress bar.

    After Ctrl-C, the raised `KeyboardInterrupt` states the progress and, if the command can be
    resumed, how to resume it.
    """
    from fflin.batch.files import part_of

    bar = Progress()
    try:
        yield bar
    except KeyboardInterrupt:
        message = "stopped"
        if bar.total:
            message += f" at {bar.done:,} of {bar.total:,} {what}"
        if not path:
            message += "; nothing is saved without -o FILE"
        elif part_of(path).exists():
            message += f"; the same command resumes from {part_of(path)}"
        raise KeyboardInterrupt(message) from None
    finally:
        bar.close()
