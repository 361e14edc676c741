"""Options of each command: their groups, their help texts, and forms that differ from `FORMS`."""

from __future__ import annotations

from fflin.commands.parser import (
    FORMS,
    Form,
    OutputFile,
    count_of,
    many,
    number,
    one,
)

# Titles of the groups of options in the help.
POINT, ROBOT, OUTPUT = "operating point", "robot (these options override robot.toml)", "output"
TRAJECTORY, CONTROLLER, SIMULATION = "trajectory", "controller", "simulation"

_NAME = {"ROBOT": "robot name listed by `fflin robots`, or path of a URDF or robot.toml"}
_JOINT = {
    "joint": "position of a joint [rad|m]. The default is the position in robot.toml or, if there "
    "is none, the neutral position",
}
_POSE = {
    **_JOINT,
    "rpy": "base attitude: roll, pitch, yaw [deg] about fixed axes",
    "position": "base position [m]",
    "velocity": "velocity of a joint or wheel [rad/s|m/s], or a component of the base velocity in "
    "base axes (omega_b.x ... v_b.z)",
}
_TARGET = {
    "target-joint": "target position of a joint [rad|m]. The default is the first of these that "
    "exists: the value in [target] of robot.toml, the value in [point], the neutral position",
    "target-rpy": "target base attitude: roll, pitch, yaw [deg] about fixed axes",
    "target-position": "target base position [m]",
    "target-velocity": "target velocity, such as the speed of a wheel. In a simulation, the "
    "target velocity is also the initial velocity unless --velocity is given",
}
_INPUTS = {
    "effort": "value of an input at the operating point. NAME is the name of the input in u, such "
    "as tau_m.joint_1",
    "equilibrium": "apply the minimum-norm inputs that make the operating point an equilibrium "
    "(or a steady motion) under springs and gravity. The springs of passive joints deflect until "
    "they balance the load. If no inputs can hold the robot at the operating point, the command "
    "reports an error",
    "relative-equilibrium": "for a robot in orbit: use the N-th of the 24 attitudes without "
    "gravity-gradient torque (1 by default), and the inputs that --equilibrium computes. The "
    "state measures attitude and position from this equilibrium pose",
}
_FRAME = {
    "frame": "axes of base velocities and wrenches. `hybrid` (default) uses base axes for angular "
    "parts and reference axes for linear parts. `local` uses base axes for all parts, and `world` "
    "uses reference axes for all parts. For a robot in orbit, the axes are as in `hybrid`, but "
    "the world is an orbital frame, `lvlh` (default) or `hill`. In `lvlh`, x points along the "
    "orbit, y opposite to the orbit normal and z towards the central body. In `hill`, x points "
    "away from the central body, y along the orbit and z along the orbit normal",
}
_REFERENCE = {
    "reference": "pose from which the attitude and position in the state are measured: the base "
    "pose at the operating point (base, default), or the world frame (world)",
}
_ORBIT = {
    "orbit": "circular orbit at an altitude [m] above a central body: earth (default), moon, mars "
    "... The world is then the orbital frame",
}
_LOCK = {
    "lock": "lock a joint at VALUE [rad|m]. Without VALUE, the joint is locked at its neutral "
    "position. In every option, NAME can also be a pattern such as 'hinge_*'",
}
_SYSTEM = {
    **_LOCK,
    **_ORBIT,
    "stiffness": "stiffness of a joint [N m/rad|N/m], or one value for all joints",
    "damping": "damping of a joint [N m s/rad|N s/m], or one value for all joints. With `urdf` as "
    "VALUE, the damping in the URDF is used",
    "gravity": "uniform gravity in world axes [m/s^2]; zero by default",
    "passive": "joint without a motor: the default inputs do not include a torque at this joint",
    "inputs": "inputs of the robot: a TOML file of inputs, a bundled name such as cubesat, "
    "`joints` (joint torques only) or `base` (base torque and force only). The default is the "
    "inputs in robot.toml or, if there are none, base torque, base force and all joint torques",
    "output": "outputs of the model: state (default), base, joints, rates, joints:NAME, "
    "rates:NAME (a joint or a pattern), com, momentum, frame:NAME (pose and velocity), pose:NAME, "
    "velocity:NAME, gyroscope:NAME, accelerometer:NAME, relative:NAME:TO (frame NAME relative to "
    "frame TO)",
}
_AT_POINT = {"": _NAME, POINT: _POSE | _INPUTS | _FRAME | _REFERENCE, ROBOT: _SYSTEM}
_TRAJECTORY = {
    "trajectory": "use the trajectory in FILE: .npz, .mat, .json or .csv; see "
    "fflin.Trajectory.load. --frame states the axes in which FILE gives base velocities and "
    "wrenches. The default of --frame is the frame named in FILE or, if there is none, local",
    "hold": "inputs between the knots of FILE: linearly interpolated (linear), or constant from "
    "each knot to the next (previous). The default is the setting in FILE or, if there is none, "
    "linear",
    "strict": "report an error if the trajectory in FILE violates the dynamics of the robot",
}
_WEIGHTS = {
    "weights": "rule for all weights that --q, --r and --bryson do not set. `urdf` (default) "
    "keeps the inputs within the limits of the URDF after displacements of 30 deg of the base and "
    "0.3 rad of the joints. `identity` sets every weight to 1",
    "q": "weight on states. NAME is a state, a group or a pattern, such as q_m.joint_1, q_b or "
    "q_m.hinge_*",
    "r": "weight on inputs. NAME is an input, a group or a pattern, such as tau_b or tau_m.hinge_*",
    "bryson": "largest acceptable value of a state, an input or a group. Its weight is 1/VALUE^2, "
    "and all weights set by the rule are multiplied by one factor, so that both kinds of weights "
    "are comparable",
    "sample": "sample time of the controller [s], with zero-order hold of the inputs. The sampled "
    "gain minimises the continuous-time cost",
    "reduce": "for robots with conserved momentum: regulate only the controllable states",
    "wheel-speeds": "whether to regulate the speeds of reaction wheels to their values at the "
    "operating point. By default, wheel speeds are regulated if thrusters or a base torque can "
    "absorb the wheel torque. --wheel-speeds also regulates the combinations of wheel speeds that "
    "exert no net torque on the robot (redundant wheels)",
}
_FORMER_SAMPLE = {"dt": "former name of --sample"}
_ALLOCATION = {
    "allocate": "design the regulator with base torque and force as inputs, and allocate its "
    "commands to the thrusters, which produce the nearest possible wrench. Allocation is the "
    "default if the thrusters can push in every direction, but not along a trajectory. With "
    "--no-allocate, the regulator commands each thruster itself, and negative thrust is cut at "
    "zero",
}
_LIMITS = {
    "limits": "limits of the inputs. `urdf` (default) uses the limits of the robot and the limits "
    "of --limit; `none` uses only the limits of --limit. The limits of the robot are the joint "
    "efforts in the URDF, the min and max of its inputs, and the largest speeds of its wheels",
    "limit": "largest magnitude of an input, or of each input in a group or pattern such as "
    "tau_m. This limit replaces the limit of the robot",
}
_SATURATION = {
    "limits": "saturate the inputs at the limits of the robot as `fflin simulate` does (urdf), or "
    "do not saturate them (none, default)",
}
_SCHEDULE = {
    "schedule": "use the gains in FILE, which `fflin tvlqr` saved, and follow the trajectory that "
    "FILE also contains. This option replaces --trajectory",
}
_STEP = {
    "dt": "integration step [s]; chosen automatically by default",
    "step": "former name of --dt",
}
_LOOP = {
    "": _NAME,
    "start": {
        **_POSE,
        "offset": "initial error with respect to the start of the trajectory, in base axes. NAME "
        "is a state, a group or a pattern, such as r_b.x, q_m or omega_b.z (SI units), or it is "
        "roll, pitch or yaw [deg]",
    },
    "target": _TARGET | _INPUTS,
    TRAJECTORY: _TRAJECTORY,
    CONTROLLER: {
        **_WEIGHTS,
        **_SCHEDULE,
        "gain": "use the gain in FILE, which `fflin lqr` saved, and regulate to the operating "
        "point for which the gain was designed",
        "controller": "use a linear controller K with positive feedback, u - u0 = K (y - y0), "
        "about the target. FILE (.mat, .npz or .json) contains the matrices A, B, C and D of the "
        "controller and, if the controller is sampled, its sample time dt or Ts. --output defines "
        "y",
        "negative-feedback": "apply the controller of --controller with negative feedback, u - u0 "
        "= -K (y - y0)",
        **_ALLOCATION,
        "mpc": "use model predictive control (MPC) with the limits of the robot; MPC requires "
        "--sample",
        "horizon": "number of samples in the horizon of --mpc",
        "free": "simulate the robot without a regulator and without inputs",
        **_LIMITS,
        "delay": "delay [s] between a sample and the application of the command that is computed "
        "from this sample",
    },
    SIMULATION: {
        "duration": "duration of the simulation [s]. The default is the duration of the "
        "trajectory. Without a trajectory, the default is the settling time of the linear loop, "
        "limited to 60 ... 600 s",
        **_STEP,
        "method": "integration method: cf4 (default) or semi_implicit_euler",
        **_FRAME,
    },
    ROBOT: _SYSTEM,
}
_SCENE = {
    "scene": "background: sky and planet (space), or a floor with a grid (lab). The default is "
    "lab under uniform gravity, otherwise space",
    "tool": "draw the axes and the path of this frame",
    "follow": "whether the camera follows the base. By default, the camera follows the base if "
    "the robot moves far compared with its size",
}
_PICTURES = {
    "png": "write a picture that shows the motion as a strip of images at the times of --times "
    "(four images by default); requires Chromium",
    "gif": "write an animation; requires Chromium",
    "times": "times of the images in --png [s]",
    **_SCENE,
    "fps": "frames per second of playback",
    "speed": "playback speed, in seconds of motion per second; 1 by default",
}

# {command: {title of the group: {option: help}}}; a positional argument is in capitals.
OPTIONS: dict[str, dict[str, dict[str, str]]] = {
    "robots": {},
    "info": {"": _NAME, POINT: _POSE, ROBOT: _SYSTEM},
    "init": {
        "": {
            "URDF": "path of a URDF, or a robot name listed by `fflin robots`",
        },
        OUTPUT: {
            "output-file": "save the robot file (by default the URDF's name with .toml, in the "
            "current folder) to FILE",
            "force": "replace an existing file",
        },
    },
    "view": {
        "": _NAME,
        POINT: _POSE,
        ROBOT: _LOCK | _ORBIT,
        OUTPUT: {
            "frame": "orbital frame used as the world; lvlh by default",
            **_SCENE,
            "no-open": "do not open a browser; the address of the page is printed on stderr",
            "port": "port on 127.0.0.1; a free port by default",
        },
    },
    "linearize": {
        **_AT_POINT,
        OUTPUT: {
            "dt": "sample the model at the sample time H [s] with zero-order hold",
            "for": "convert the model to the coordinates that a tool uses, and save the result; "
            "requires -o FILE",
            "output-file": "save A, B, C and D (.csv: one file per matrix, such as NAME.A.csv) to "
            "FILE",
            "plot": "plot the magnitudes of the entries of A and B to FILE",
        },
        TRAJECTORY: _TRAJECTORY,
    },
    "check": {
        **_AT_POINT,
        TRAJECTORY: _TRAJECTORY,
        OUTPUT: {
            "tolerance": "relative tolerance for all errors. By default, each kind of error has "
            "its own tolerance",
            "plot": "plot the errors and their tolerances to FILE",
        },
    },
    "analyze": {**_AT_POINT, OUTPUT: {"plot": "plot the modes to FILE"}},
    "modes": {
        **_AT_POINT,
        OUTPUT: {
            "plot": "plot the frequencies, damping ratios and shapes of the modes to FILE",
            "html": "write an HTML page that animates the mode shapes",
        },
    },
    "equilibrium": {
        **_AT_POINT,
        OUTPUT: {
            "output-file": "save the equilibrium (q, u, spring deflections and poles) to FILE",
        },
    },
    "sensitivity": {
        **_AT_POINT,
        "derivatives": {
            "dt": "differentiate the model after it is sampled at the sample time H [s] with "
            "zero-order hold",
            "top": "show the N parameters with the largest effect",
            "only": "show only the parameters that NAME selects. NAME is a kind of parameter, a "
            "link or a pattern, such as mass, link_3 or *.density",
        },
        OUTPUT: {"output-file": "save the derivatives dA, dB and df0 for each parameter to FILE"},
    },
    "uncertain": {
        "": _NAME,
        POINT: _JOINT,
        ROBOT: _SYSTEM,
        "parameters": {
            "vary": "range of the parameter NAME, or of all parameters that match a pattern; "
            "`fflin sensitivity` lists the names. RANGE is a largest deviation as a fraction of "
            "the nominal value, such as 0.2, or the bounds LEAST:LARGEST. With `,tied` after "
            "RANGE, such as 0.2,tied, all parameters that match the pattern vary together",
        },
        OUTPUT: {"output-file": "save the matrices A, B1 .. D22 and the blocks of Delta to FILE"},
    },
    "validity": {
        **_AT_POINT,
        CONTROLLER: _WEIGHTS | _FORMER_SAMPLE | _ALLOCATION,
        "runs": {
            "attitude": "largest rotation of the base [deg]",
            "offset": "largest displacement of the base [m]",
            "spread": "largest displacement of a joint [rad|m]",
            "samples": "number of random runs",
            "seed": "random seed of the runs",
            "jobs": "number of processes; at most one per core",
            **_SATURATION,
        },
        OUTPUT: {"plot": "plot the results to FILE"},
    },
    "funnel": {
        "": _NAME,
        ROBOT: _SYSTEM,
        TRAJECTORY: _FRAME | _TRAJECTORY,
        CONTROLLER: _WEIGHTS | _SCHEDULE,
        "runs": {
            "goal": "largest error allowed at the end of a run: attitude [deg], position [m], "
            "joints, omega_b, v_b or joint rates",
            "within": "largest error allowed at any time of a run, named as in --goal",
            **_LIMITS,
            "knots": "number of knots to test",
            "samples": "number of runs from each knot",
            "seed": "random seed of the runs",
            "confidence": "confidence level of all intervals",
            "threads": "number of threads; by default one per core",
            **_STEP,
        },
        OUTPUT: {"plot": "plot the funnel to FILE", "output-file": "save the funnel to FILE"},
    },
    "lqr": {
        **_AT_POINT,
        CONTROLLER: _WEIGHTS | _FORMER_SAMPLE | _ALLOCATION,
        OUTPUT: {
            "output-file": "save the gain to FILE",
            "plot": "plot the poles, the loop gain of each input and the stability margins to FILE",
        },
    },
    "tvlqr": {
        "": _NAME,
        ROBOT: _SYSTEM,
        TRAJECTORY: _FRAME | _TRAJECTORY,
        CONTROLLER: {
            **_WEIGHTS,
            **_FORMER_SAMPLE,
            "qf": "weight on the final error. The default is the solution of the algebraic "
            "Riccati equation at the last configuration",
        },
        OUTPUT: {"output-file": "save the gains to FILE"},
    },
    "plan": {
        "": _NAME,
        ROBOT: _SYSTEM,
        "start": _POSE,
        "target": _TARGET,
        TRAJECTORY: {
            "duration": "duration of the motion [s]",
            "knots": "number of equally spaced knots",
            "hold": "inputs between knots: constant (previous, default) or linearly interpolated "
            "(linear)",
            "free-end": "state whose final value is free. NAME is a state, group or pattern",
            "r": "weight on an input, a group or a pattern. The default is 1/limit^2",
            **_LIMITS,
        },
        OUTPUT: {"output-file": "save the trajectory to FILE"},
    },
    "simulate": {
        **_LOOP,
        SIMULATION: {
            **_LOOP[SIMULATION],
            "every": "save the state at every N-th integration step; by default N is 1, or larger "
            "for long runs",
            "engine": "simulate in compiled code or in Python. By default, long runs use compiled "
            "code if numba is installed, and all other runs use Python",
        },
        OUTPUT: {
            "plot": "plot the nonlinear and the linear motion to FILE",
            "show": "show only these curves in --plot. NAME is a state, input, group or pattern, "
            "such as q_m or '*.hinge_*'",
            "output-file": "save the motion to FILE",
            "html": "write a page that plays the motion offline",
            **_PICTURES,
        },
    },
    "export": {
        "": {
            "FILE": "gain, compensator or gain schedule saved by fflin: .npz, .mat or .json",
        },
        OUTPUT: {
            "output-folder": "folder for the code; a missing folder is created",
            "robot": "robot for which FILE was designed: a name listed by `fflin robots`, or the "
            "path of a URDF or robot.toml. The default is the robot that FILE names",
            **_SATURATION,
            "name": "prefix of all names in the C code",
            "real": "floating-point type in the C code; double by default",
        },
    },
    "sweep": {
        "": _NAME,
        "points": {
            "": "give --grid or --random. By default, all points have the velocity in [point] of "
            "robot.toml or, if there is none, zero velocity",
            "grid": "N values of a joint [rad|m] from LO to HI. With several joints, the points "
            "are all combinations, and the last joint varies fastest",
            "random": "number of random points, uniformly distributed within the joint limits",
            "seed": "random seed of --random",
            "range": "range of a joint [rad|m] for --random, in place of its joint limits",
        },
        POINT: {
            **_POSE,
            "effort": "value of an input at all points. NAME is the name of the input in u, such "
            "as tau_m.joint_1",
            **_FRAME,
            **_REFERENCE,
        },
        ROBOT: _SYSTEM,
        "computation": {
            "engine": "compute the points in compiled code or in Python. By default, the code is "
            "compiled if numba is installed and the outputs are the state",
            "workers": "distribute the work over N processes; at most one per core",
        },
        OUTPUT: {
            "output-file": "save the models (with .h5, the same command resumes after an "
            "interruption) to FILE",
        },
    },
    "montecarlo": {
        **_LOOP,
        "": {
            **_NAME,
            "DISPERSIONS": 'TOML file with a line [dispersions], and a line such as "base.mass" = '
            "0.05 (standard deviation) for each random parameter; see fflin.load_dispersions",
        },
        "runs": {
            "runs": "number of runs",
            "seed": "random seed",
            "until": "stop the runs when the confidence interval of the success rate is at most "
            "--width wide. CONDITION defines success, such as 'attitude < 1 deg'",
            "width": "width of the confidence interval at which --until stops the runs",
            "confidence": "confidence level of all intervals",
            "workers": "distribute the runs over N processes",
            "threads": "distribute the runs over N threads; by default one per core",
        },
        OUTPUT: {
            "goal": "report the fraction of runs that meet CONDITION, such as 'attitude < 1 deg "
            "and settle < 60 s', and draw the bounds of CONDITION in --plot",
            "worst": "list the K worst runs",
            "plot": "plot quantile bands over time, histograms and the worst runs to FILE",
            "output-file": "save the runs (.csv and .mat are tables for other programs; with .h5, "
            "the same command resumes after an interruption) to FILE",
            "force": "replace the file of -o even if it contains the runs of another command",
            "html": "write a page that plays the worst run",
            **_PICTURES,
        },
    },
}

# {command: options that its short help lists}. For a command without an entry, the short help lists
# all options.
COMMON = {
    "linearize": "joint rpy position velocity effort equilibrium frame reference inputs dt for "
    "trajectory output-file plot",
    "check": "joint rpy position velocity effort equilibrium frame reference inputs trajectory "
    "tolerance plot",
    "analyze": "joint rpy velocity equilibrium relative-equilibrium orbit stiffness inputs output "
    "frame plot",
    "modes": "joint rpy velocity equilibrium relative-equilibrium orbit stiffness inputs output "
    "frame plot html",
    "equilibrium": "joint rpy velocity relative-equilibrium orbit stiffness gravity passive "
    "inputs frame output-file",
    "sensitivity": "joint rpy velocity equilibrium inputs frame dt top only output-file",
    "validity": "joint inputs weights q r bryson sample reduce attitude offset spread samples "
    "seed jobs limits frame plot",
    "funnel": "trajectory schedule goal within weights q r knots samples seed threads dt limits "
    "limit frame inputs output-file plot",
    "lqr": "joint velocity equilibrium inputs frame weights q r bryson sample reduce wheel-speeds "
    "output-file plot",
    "tvlqr": "trajectory hold strict weights q r bryson sample qf inputs frame output-file",
    "plan": "joint rpy position velocity target-joint target-rpy target-position target-velocity "
    "duration knots hold free-end r limits limit inputs output-file",
    "simulate": "joint rpy target-joint target-rpy trajectory weights q r sample mpc gain "
    "schedule free limits duration inputs output-file plot html",
    "sweep": "grid random seed range joint velocity inputs output frame engine workers output-file",
    "montecarlo": "runs seed until width confidence workers goal worst joint rpy trajectory gain "
    "schedule duration inputs output-file plot",
}


def _saved(*kinds: str, endings: tuple[str, ...] = (".npz", ".mat", ".json")) -> Form:
    return one(OutputFile(endings, kinds), "FILE")


_TABLE = (".npz", ".mat", ".json", ".csv")
_FORMER: Form = {**FORMS["dt"], "dest": "former_dt"}
_UNSATURATED: Form = {**FORMS["limits"], "default": "none"}

# {command: {option: form}} for forms that differ from those in `FORMS`.
SPECIAL: dict[str, dict[str, Form]] = {
    "init": {"output-file": _saved(endings=(".toml",))},
    "view": {"frame": {"choices": ("lvlh", "hill")}},
    "linearize": {
        "output-file": _saved("LinearModel", "LinearTrajectory", "ToolModel", endings=_TABLE)
    },
    "equilibrium": {"output-file": _saved("Equilibrium")},
    "sensitivity": {"output-file": _saved("Sensitivity")},
    "uncertain": {"output-file": _saved("LFT")},
    "validity": {"dt": _FORMER, "limits": _UNSATURATED, "offset": one(number, "X", 0.5)},
    "funnel": {"knots": one(count_of, "N", 10), "output-file": _saved("Funnel")},
    "lqr": {"dt": _FORMER, "output-file": _saved("Gain")},
    "tvlqr": {
        "dt": _FORMER,
        "trajectory": {**FORMS["trajectory"], "required": True},
        "output-file": _saved("GainSchedule"),
    },
    "plan": {
        "duration": one(number, "T", required=True),
        "hold": {**FORMS["hold"], "default": "previous"},
        "output-file": _saved("Trajectory", "Motion", endings=_TABLE),
    },
    "simulate": {"output-file": _saved("Motion", endings=_TABLE)},
    "export": {"limits": _UNSATURATED},
    "sweep": {"output-file": {**_saved("LinearBatch", endings=(".npz", ".h5")), "required": True}},
    "montecarlo": {
        "goal": many(str, "CONDITION"),
        "output-file": _saved(endings=(".npz", ".h5", ".csv", ".mat")),
    },
}
