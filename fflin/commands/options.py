"""Options of each command: their groups and their help texts."""

from fflin.base.writing import RECORDS
from fflin.dynamics.methods import DEFAULT_METHOD, METHODS

_SAVED = ", ".join(RECORDS)
_OTHER_METHODS = [name for name in METHODS if name != DEFAULT_METHOD]
_METHODS = " or ".join((f"{DEFAULT_METHOD} (default)", *_OTHER_METHODS))

# Titles of the groups of options in the help.
POINT = "operating point"
ROBOT = "robot (these options override robot.toml)"
OUTPUT = "output"
TRAJECTORY, CONTROLLER, SIMULATION = "trajectory", "controller", "simulation"

_POSE = "joint rpy position velocity"
_TARGET = "target-joint target-rpy target-position target-velocity"
_INPUTS = "effort equilibrium tilt relative-equilibrium"
_SYSTEM = (
    "lock weld independent xacro orbit inclination field stiffness damping gravity passive inputs "
    "output"
)
_TRAJECTORY = "trajectory hold strict"
_PATH = f"{_TRAJECTORY} periodic period motion"
_WEIGHTS = "weights q r bryson sample reduce wheel-speeds"
_SCENE = "scene tool follow"
_PICTURES = f"png gif times {_SCENE} fps speed"

_AT_POINT = {"": "ROBOT", POINT: f"{_POSE} {_INPUTS} frame reference", ROBOT: _SYSTEM}
_ALONG = {"": "ROBOT", ROBOT: _SYSTEM, TRAJECTORY: f"frame {_TRAJECTORY}"}
_LOOP = {
    "": "ROBOT",
    "start": f"{_POSE} offset",
    "target": f"{_TARGET} {_INPUTS}",
    TRAJECTORY: _PATH,
    CONTROLLER: f"{_WEIGHTS} integral schedule gain controller negative-feedback allocate mpc "
    "horizon bdot rate-damping free limits limit delay",
    SIMULATION: "duration dt step method frame",
    ROBOT: _SYSTEM,
}

# {command: {title of the group: options}}, in the order of the help; positional arguments are in
# capitals.
OPTIONS: dict[str, dict[str, str]] = {
    "robots": {},
    "info": {"": "ROBOT", POINT: _POSE, ROBOT: _SYSTEM},
    "init": {"": "URDF", OUTPUT: "output-file force"},
    "view": {
        "": "ROBOT",
        POINT: _POSE,
        ROBOT: "lock weld xacro orbit inclination field",
        OUTPUT: f"frame {_SCENE} no-open port",
    },
    "linearize": {
        **_AT_POINT,
        POINT: f"{_AT_POINT[POINT]} time",
        OUTPUT: "dt for output-file plot",
        TRAJECTORY: _PATH,
    },
    "check": {
        **_AT_POINT,
        POINT: f"{_AT_POINT[POINT]} time",
        TRAJECTORY: _PATH,
        OUTPUT: "tolerance plot",
    },
    "analyze": {**_AT_POINT, TRAJECTORY: "periodic period motion", OUTPUT: "plot"},
    "modes": {**_AT_POINT, OUTPUT: "plot html"},
    "equilibrium": {**_AT_POINT, OUTPUT: "output-file"},
    "sensitivity": {**_AT_POINT, "derivatives": "dt top only", OUTPUT: "output-file"},
    "uncertain": {
        "": "ROBOT",
        POINT: "joint",
        ROBOT: _SYSTEM,
        "parameters": "vary",
        OUTPUT: "output-file",
    },
    "validity": {
        **_AT_POINT,
        CONTROLLER: f"{_WEIGHTS} integral dt allocate",
        "runs": "attitude offset spread samples seed jobs limits",
        OUTPUT: "plot",
    },
    "funnel": {
        **_ALONG,
        CONTROLLER: f"{_WEIGHTS} schedule",
        "runs": "goal within limits limit knots samples seed confidence threads dt step",
        OUTPUT: "plot output-file",
    },
    "lqr": {
        **_AT_POINT,
        POINT: f"{_AT_POINT[POINT]} after",
        CONTROLLER: f"{_WEIGHTS} integral delay dt allocate",
        OUTPUT: "output-file plot",
    },
    "lqg": {
        **_AT_POINT,
        CONTROLLER: "weights q r bryson sample delay wheel-speeds integral vary allocate",
        "filter": "process-noise noise bias-noise disturbance disturbance-frequency",
        OUTPUT: "output-file plot",
    },
    "tvlqr": {
        **_ALONG,
        TRAJECTORY: f"frame {_PATH}",
        POINT: "joint rpy position",
        CONTROLLER: f"{_WEIGHTS} dt qf",
        OUTPUT: "output-file",
    },
    "tune": {
        **_AT_POINT,
        CONTROLLER: "law goal vary sample delay allocate",
        "search": "starts steps seed",
        OUTPUT: "output-file plot",
    },
    "plan": {
        "": "ROBOT",
        ROBOT: _SYSTEM,
        "start": _POSE,
        "target": _TARGET,
        TRAJECTORY: "duration knots hold free-end r limits limit guess",
        OUTPUT: "output-file",
    },
    "simulate": {
        **_LOOP,
        "start": f"{_LOOP['start']} after",
        SIMULATION: f"{_LOOP[SIMULATION]} every engine",
        "pointing errors": "pointing accuracy budget noise bias no-noise seed",
        OUTPUT: f"plot show output-file html {_PICTURES}",
    },
    "export": {"": "FILE", OUTPUT: "output-folder robot weld limits name real"},
    "sweep": {
        "": "ROBOT",
        "points": "grid random seed range",
        POINT: f"{_POSE} effort frame reference",
        ROBOT: _SYSTEM,
        "computation": "engine workers",
        OUTPUT: "output-file",
    },
    "montecarlo": {
        **_LOOP,
        "": "ROBOT DISPERSIONS",
        "runs": "runs seed until width confidence engine workers threads no-noise",
        "pointing errors": "pointing accuracy budget",
        OUTPUT: f"goal worst plot output-file force html {_PICTURES}",
    },
}

# {title of a group: text below the title}
DESCRIPTIONS = {
    "points": "give --grid or --random. By default, all points have the velocity in [point] of "
    "robot.toml or, if there is none, zero velocity",
}

# {command: options that its short help lists}. For a command without an entry, the short help lists
# all options.
COMMON = {
    "uncertain": "joint vary lock stiffness damping passive inputs output output-file",
    "info": "joint rpy position velocity lock orbit stiffness passive inputs output",
    "linearize": "joint rpy position velocity effort equilibrium time frame reference inputs dt "
    "for trajectory periodic output-file plot",
    "check": "joint rpy position velocity effort equilibrium frame reference inputs trajectory "
    "tolerance plot",
    "analyze": "joint rpy velocity equilibrium relative-equilibrium orbit stiffness inputs output "
    "frame periodic plot",
    "modes": "joint rpy velocity equilibrium relative-equilibrium orbit stiffness inputs output "
    "frame plot html",
    "equilibrium": "joint rpy velocity tilt relative-equilibrium orbit stiffness gravity passive "
    "inputs frame output-file",
    "sensitivity": "joint rpy velocity equilibrium inputs frame dt top only output-file",
    "validity": "joint inputs weights q r bryson sample reduce attitude offset spread samples "
    "seed jobs limits frame plot",
    "funnel": "trajectory schedule goal within weights q r knots samples seed threads dt limits "
    "limit frame inputs output-file plot",
    "lqr": "joint velocity equilibrium inputs frame weights q r bryson sample reduce wheel-speeds "
    "output-file plot",
    "lqg": "sample delay weights q r bryson integral process-noise noise bias-noise disturbance "
    "vary inputs output output-file plot",
    "tvlqr": "trajectory periodic hold strict weights q r bryson sample qf inputs frame "
    "output-file",
    "tune": "law goal vary sample delay starts seed joint inputs output output-file plot",
    "plan": "joint rpy position velocity target-joint target-rpy target-position target-velocity "
    "duration knots hold free-end r limits limit guess inputs output-file",
    "simulate": "joint rpy target-joint target-rpy trajectory weights q r sample mpc gain "
    "schedule free limits duration inputs output-file plot html",
    "sweep": "grid random seed range joint velocity inputs output frame engine workers output-file",
    "montecarlo": "runs seed until width confidence workers goal worst joint rpy trajectory gain "
    "schedule duration inputs pointing output-file plot",
}

_SATURATION = (
    "saturate the inputs at the limits of the robot as `fflin simulate` does (urdf), or do not "
    "saturate them (none, default)"
)

# {option or ARGUMENT: help}. A key "COMMAND OPTION" applies to this command only.
ABOUT: dict[str, str] = {
    "ROBOT": "robot name listed by `fflin robots`, or path of a URDF, an MJCF "
    "file (.xml) or a robot.toml",
    "joint": "position of a joint [rad|m]. The default is the position in robot.toml or, if there "
    "is none, the neutral position",
    "rpy": "base attitude: roll, pitch, yaw [deg] about fixed axes",
    "position": "base position [m]",
    "velocity": "velocity of a joint or wheel [rad/s|m/s], or a component of the base velocity in "
    "base axes (omega_b.x ... v_b.z)",
    "target-joint": "target position of a joint [rad|m]. The default is the first of these that "
    "exists: the value in [target] of robot.toml, the value in [point], the neutral position",
    "target-rpy": "target base attitude: roll, pitch, yaw [deg] about fixed axes",
    "target-position": "target base position [m]",
    "target-velocity": "target velocity, such as the speed of a wheel. In a simulation, the target "
    "velocity is also the initial velocity unless --velocity is given",
    "effort": "value of an input at the operating point. NAME is the name of the input in u, such "
    "as tau_m.joint_1",
    "equilibrium": "apply the minimum-norm inputs that make the operating point an equilibrium (or "
    "a steady motion) under springs and gravity. The springs of passive joints deflect until they "
    "balance the load. If no inputs can hold the robot at the operating point, the command reports "
    "an error",
    "tilt": "whether an equilibrium under gravity may tilt the base, by less than 90 deg, if no "
    "inputs balance all forces at the given attitude. By default, the base may tilt. With "
    "--no-tilt, it keeps the given attitude",
    "relative-equilibrium": "for a robot in orbit: use the N-th of the 24 attitudes without "
    "gravity-gradient torque (1 by default), and the inputs that --equilibrium computes. The state "
    "measures attitude and position from this equilibrium pose",
    "frame": "axes of base velocities and wrenches. `hybrid` (default) uses base axes for angular "
    "parts and reference axes for linear parts. `local` uses base axes for all parts, and `world` "
    "uses reference axes for all parts. For a robot in orbit, the axes are as in `hybrid`, but the "
    "world is an orbital frame, `lvlh` (default) or `hill`. In `lvlh`, x points along the orbit, y "
    "opposite to the orbit normal and z towards the central body. In `hill`, x points away from "
    "the central body, y along the orbit and z along the orbit normal",
    "reference": "pose from which the attitude and position in the state are measured: the base "
    "pose at the operating point (base, default), or the world frame (world)",
    "lock": "lock a joint at VALUE [rad|m]. Without VALUE, the joint is locked at its neutral "
    "position. In every option, NAME can also be a pattern such as 'hinge_*'",
    "weld": "weld a frame to the frame TO or, without TO, to inertial space, in the pose that they "
    "have at the operating point. The welds are added to the constraints in robot.toml",
    "independent": "coordinate kept in the linear model. NAME is a coordinate, a group or a "
    "pattern, such as q_b or left_1; repeat the option for each. The linear model of a robot with "
    "constraints has only independent coordinates, by default chosen automatically",
    "xacro": "value of an argument of a xacro file",
    "orbit": "circular orbit at an altitude [m], or elliptic orbit with the heights [m] of perigee "
    "and apogee, above a central body: earth (default), moon, mars ... The world is then the "
    "orbital frame. Inclination and magnetic field are those of the orbit in robot.toml, if it has "
    "the same central body. `none` removes the orbit of a robot file",
    "inclination": "inclination of the orbit [rad], on which the magnetic field depends",
    "field": "magnetic field of the orbit, for magnetorquers: dipole, tilted_dipole (which rotates "
    "with the earth) or none",
    "stiffness": "stiffness of a joint [N m/rad|N/m], or one value for all joints",
    "damping": "damping of a joint [N m s/rad|N s/m], or one value for all joints. With `urdf` as "
    "VALUE, the damping in the URDF is used",
    "gravity": "uniform gravity in world axes [m/s^2]; zero by default",
    "passive": "joint without a motor: the default inputs do not include a torque at this joint",
    "inputs": "inputs of the robot: a TOML file of inputs, a bundled name such as cubesat, "
    "`joints` (joint torques only), `base` (base torque and force only) or `wheels` (wheels "
    "only). The default is the inputs in robot.toml or, if there are none, base torque, base "
    "force and all joint torques",
    "output": "outputs of the model: state (default), base, star_tracker, joints, rates, "
    "joints:NAME, rates:NAME (a joint or a pattern), com, momentum, frame:NAME (pose and "
    "velocity), pose:NAME, velocity:NAME, gyroscope:NAME, accelerometer:NAME, relative:NAME:TO "
    "(frame NAME relative to frame TO), force:NAME (of the constraint NAME)",
    "trajectory": f"use the trajectory in FILE: {_SAVED} or .csv; see "
    "fflin.Trajectory.load. --frame states the axes in which FILE gives base velocities and "
    "wrenches. The default of --frame is the frame named in FILE or, if there is none, local",
    "analyze periodic": "for a robot in orbit: analyse the linear models at N + 1 knots of one "
    "period, about a periodic motion that --motion selects",
    "periodic": "for a robot in orbit: use the linear models at N + 1 knots of one period, about a "
    "periodic motion that --motion selects. --joint, --rpy and --position define where the robot "
    "rests, relative to the axes `lvlh`. In a simulation, --target-joint, --target-rpy and "
    "--target-position define it",
    "period": "time [s] after which the models of --periodic repeat; by default the period of the "
    "orbit. The field of a tilted dipole repeats if the ground track does",
    "motion": "periodic motion of --periodic: at rest in the orbital frame and held by the inputs "
    "(held, default), or without inputs (free)",
    "time": "time of the model [s], for a robot whose model depends on time: in an elliptic orbit, "
    "or with magnetorquers; 0 by default",
    "bdot": "detumble by the B-dot law with this gain [A m^2 s/T]: each magnetorquer has a moment "
    "proportional to the derivative of the magnetic field along its axis",
    "rate-damping": "detumble from the measured angular velocity with this gain [N m s]: the "
    "magnetorquers exert the part of -GAIN times the angular velocity across the magnetic field",
    "hold": "inputs between the knots of FILE: linearly interpolated (linear), or constant from "
    "each knot to the next (previous). The default is the setting in FILE or, if there is none, "
    "linear",
    "strict": "report an error if the trajectory in FILE violates the dynamics of the robot",
    "weights": "rule for all weights that --q, --r and --bryson do not set. `urdf` (default) keeps "
    "the inputs within the limits of the URDF after displacements of 30 deg of the base and 0.3 "
    "rad of the joints. `identity` sets every weight to 1",
    "q": "weight on states. NAME is a state, a group or a pattern, such as q_m.joint_1, q_b or "
    "q_m.hinge_*",
    "r": "weight on inputs. NAME is an input, a group or a pattern, such as tau_b or tau_m.hinge_*",
    "bryson": "largest acceptable value of a state, an input or a group. Its weight is 1/VALUE^2, "
    "and all weights set by the rule are multiplied by one factor, so that both kinds of weights "
    "are comparable",
    "integral": "also integrate a state or an output, so that a constant disturbance leaves no "
    "error in it. NAME is a state, an output or a group, such as q_b. The integrals are slower "
    "than the loop; the report states their rate. `none` switches off the integrals that the robot "
    "file sets",
    "sample": "sample time of the controller [s], with zero-order hold of the inputs. The sampled "
    "gain minimises the continuous-time cost",
    "reduce": "for robots with conserved momentum: regulate only the controllable states",
    "wheel-speeds": "whether to regulate the speeds of reaction wheels to their values at the "
    "operating point. By default, wheel speeds are regulated if thrusters or a base torque can "
    "absorb the wheel torque. --wheel-speeds also regulates the combinations of wheel speeds that "
    "exert no net torque on the robot (redundant wheels)",
    "schedule": "use the gains in FILE, which `fflin tvlqr` saved, and follow the trajectory that "
    "FILE also contains. This option replaces --trajectory",
    "allocate": "design the regulator with base torque and force as inputs, and allocate its "
    "commands to the thrusters and magnetorquers, which produce the nearest possible wrench. "
    "Allocation is the default if the thrusters can push in every direction, or if three "
    "magnetorquers can have a moment in every direction, but not along a trajectory. With "
    "--no-allocate, the regulator commands each thruster itself, and negative thrust is cut at "
    "zero",
    "limits": "limits of the inputs. `urdf` (default) uses the limits of the robot and the limits "
    "of --limit; `none` uses only the limits of --limit. The limits of the robot are the joint "
    "efforts in the URDF, the min and max of its inputs, and the largest speeds of its wheels",
    "limit": "largest magnitude of an input, or of each input in a group or pattern such as tau_m. "
    "This limit replaces the limit of the robot",
    "gain": "use the gain in FILE, which `fflin lqr` saved, and regulate to the operating point "
    "for which the gain was designed",
    "controller": "use a linear controller K with positive feedback, u - u0 = K (y - y0), about "
    f"the target or along --trajectory. FILE ({_SAVED}) contains the law of `fflin lqg` or `fflin "
    "tune`, or the matrices A, B, C and D of the controller and, if the controller is sampled, its "
    "sample time dt or Ts. --output defines y",
    "negative-feedback": "apply the controller of --controller with negative feedback, u - u0 = -K "
    "(y - y0)",
    "mpc": "use model predictive control (MPC) with the limits of the robot; MPC requires --sample",
    "horizon": "number of samples in the horizon of --mpc",
    "law": "law to tune, such as 'pd measured=q_b inputs=wheel lag=[0.1,1]'. TYPE is pd, pid, "
    "static_gain or state_space, or a filter: low_pass, lead or notch. The sum of all laws is in "
    "series with all filters. Keys and values are as in [[tune.law]] of robot.toml, which this "
    "option replaces. A number fixes a parameter, [least,largest] bounds it",
    "starts": "number of starts of the search; 3 by default",
    "steps": "largest number of steps of each search; 300 by default",
    "free": "simulate the robot without a regulator and without inputs",
    "delay": "delay [s] between a sample and the application of the command that is computed from "
    "this sample. The regulator is designed for this delay. Without --sample, its sample time is "
    "then equal to the delay. A law from a file, MPC, and a law along a trajectory do not change",
    "offset": "initial error with respect to the start of the trajectory, in base axes. NAME is a "
    "state, a group or a pattern, such as r_b.x, q_m or omega_b.z (SI units), or it is roll, pitch "
    "or yaw [deg]",
    "after": "start at the end of the motion in FILE, which `fflin simulate -o` saved, for example "
    "before a latch (--weld) or a release. If this phase has constraints that are not yet closed, "
    "they close in an impact, as in fflin.latch",
    "duration": "duration of the simulation [s]. The default is the duration of the trajectory. "
    "Without a trajectory, the default is the settling time of the linear loop, limited to 60 ... "
    "600 s",
    "dt": "integration step [s]; chosen automatically by default",
    "step": "former name of --dt",
    "method": f"integration method: {_METHODS}",
    "scene": "background: sky and planet (space), or a floor with a grid (lab). The default is lab "
    "under uniform gravity, otherwise space",
    "tool": "draw the axes and the path of this frame",
    "follow": "whether the camera follows the base. By default, the camera follows the base if the "
    "robot moves far compared with its size",
    "png": "write a picture that shows the motion as a strip of images at the times of --times "
    "(four images by default); requires Chromium",
    "gif": "write an animation; requires Chromium",
    "times": "times of the images in --png [s]",
    "fps": "frames per second of playback",
    "speed": "playback speed, in seconds of motion per second; 1 by default",
    "URDF": "path of a URDF, or a robot name listed by `fflin robots`",
    "no-open": "do not open a browser; the address of the page is printed on stderr",
    "port": "port on 127.0.0.1; a free port by default",
    "for": "convert the model to the coordinates that a tool uses, and save the result; requires "
    "-o FILE",
    "tolerance": "relative tolerance for all errors. By default, each kind of error has its own "
    "tolerance",
    "top": "show the N parameters with the largest effect",
    "only": "show only the parameters that NAME selects. NAME is a kind of parameter, a link or a "
    "pattern, such as mass, link_3 or *.density",
    "vary": "range of the parameter NAME, or of all parameters that match a pattern; `fflin "
    "sensitivity` lists the names. RANGE is a largest deviation as a fraction of the nominal "
    "value, such as 0.2, or the bounds LEAST:LARGEST. With `,tied` after RANGE, such as 0.2,tied, "
    "all parameters that match the pattern vary together",
    "attitude": "largest rotation of the base [deg]",
    "spread": "largest displacement of a joint [rad|m]",
    "seed": "random seed of the runs",
    "jobs": "number of processes; at most one per core",
    "within": "largest error allowed at any time of a run, named as in --goal",
    "confidence": "confidence level of all intervals",
    "qf": "weight on the final error. The default is the solution of the algebraic Riccati "
    "equation at the last configuration",
    "free-end": "state whose final value is free. NAME is a state, group or pattern",
    "guess": f"begin the search at the trajectory in FILE: {_SAVED} or .csv; see "
    "fflin.Trajectory.load. Its time is scaled to --duration",
    "every": "save the state at every N-th integration step; by default N is 1, or larger for long "
    "runs",
    "show": "show only these curves in --plot. NAME is a state, input, group or pattern, such as "
    "q_m or '*.hinge_*'",
    "FILE": f"gain, compensator, gain schedule or tuned law saved by fflin: {_SAVED}",
    "output-folder": "folder for the code; a missing folder is created",
    "robot": "robot for which FILE was designed: a name listed by `fflin robots`, or the path of a "
    "URDF or robot.toml. The default is the robot that FILE names",
    "name": "prefix of all names in the C code",
    "real": "floating-point type in the C code; double by default",
    "grid": "N values of a joint [rad|m] from LO to HI. With several joints, the points are all "
    "combinations, and the last joint varies fastest",
    "random": "number of random points, uniformly distributed within the joint limits",
    "range": "range of a joint [rad|m] for --random, in place of its joint limits",
    "DISPERSIONS": 'TOML file with a line [dispersions], and a line such as "base.mass" = 0.05 '
    "(standard deviation) for each random parameter; see fflin.load_dispersions",
    "runs": "number of runs",
    "until": "stop the runs when the confidence interval of the success rate is at most --width "
    "wide. CONDITION defines success, such as 'attitude < 1 deg'",
    "width": "width of the confidence interval at which --until stops the runs",
    "worst": "list the K worst runs",
    "force": "replace the file of -o, whatever it contains. Without --force, -o replaces only a "
    "file that contains a result of the same kind",
    "pointing": "report pointing errors as in ECSS-E-ST-60-10C, for windows of this length [s]",
    "accuracy": "angle [deg] for the settling time of --pointing",
    "budget": "report the error of each cause in the linear loop, see fflin.error_budget: the "
    "disturbance of the robot, the noise of its outputs, --noise and --bias. The part of the "
    "simulated errors that they do not explain, such as the limit cycle of thrusters, is a "
    "further cause",
    "noise": "standard deviation of the noise in each sample of a measured signal, as a standard "
    "normal variable. NAME is a state, or an output for --controller, a group or a quantity such "
    "as gyroscope",
    "bias": "constant error of a measured signal, named as in --noise",
    "no-noise": "leave out the noise and the drifting biases that the outputs of the robot declare",
    "json": "print the results as one JSON object",
    # Options of one command.
    "init output-file": "save the robot file (by default the URDF's name with .toml, in the "
    "current folder) to FILE",
    "init force": "replace an existing file",
    "view frame": "orbital frame used as the world; lvlh by default",
    "linearize dt": "sample the model at the sample time H [s] with zero-order hold",
    "linearize output-file": "save A, B, C and D (.csv: one file per matrix, such as NAME.A.csv) "
    "to FILE",
    "linearize plot": "plot the magnitudes of the entries of A and B to FILE",
    "check plot": "plot the errors and their tolerances to FILE",
    "analyze plot": "plot the modes to FILE",
    "modes plot": "plot the frequencies, damping ratios and shapes of the modes to FILE",
    "modes html": "write an HTML page that animates the mode shapes",
    "equilibrium output-file": "save the equilibrium (q, u, spring deflections and poles) to FILE",
    "sensitivity dt": "differentiate the model after it is sampled at the sample time H [s] with "
    "zero-order hold",
    "sensitivity output-file": "save the derivatives dA, dB and df0 for each parameter to FILE",
    "uncertain output-file": "save the matrices A, B1 .. D22 and the blocks of Delta to FILE",
    "validity limits": _SATURATION,
    "validity offset": "largest displacement of the base [m]",
    "validity dt": "former name of --sample",
    "validity plot": "plot the results to FILE",
    "validity samples": "number of random runs",
    "funnel output-file": "save the funnel to FILE",
    "funnel plot": "plot the funnel to FILE",
    "funnel samples": "number of runs from each knot",
    "funnel goal": "largest error allowed at the end of a run: attitude [deg], position [m], "
    "joints, omega_b, v_b or joint rates",
    "funnel knots": "number of knots to test",
    "funnel threads": "number of threads; by default one per core",
    "lqr dt": "former name of --sample",
    "lqr delay": "design the regulator for commands that act T s after their sample. Without "
    "--sample, the sample time is T",
    "lqr after": "regulate to the configuration at the end of the motion in FILE, at rest. Design "
    "in this way the gain of a phase that begins with a latch (--weld)",
    "lqr output-file": "save the gain to FILE",
    "lqr plot": "plot the poles, the loop gain of each input and the stability margins to FILE",
    "process-noise": "intensity of the process noise on a state, as the covariance of a sample. "
    "NAME is a state, a group or a pattern, such as omega_b. The default is noise at the inputs, "
    "as small as a disk margin of 2/3 permits",
    "bias-noise": "estimate the bias of an output, whose random walk has the intensity W. NAME is "
    "as in --noise. The default is the bias of the [[output]] in robot.toml. A larger W makes the "
    "estimate faster",
    "disturbance": "estimate and reject a slowly varying disturbance. NAME is a generalised "
    "force such as tau_b or an input, and W the intensity of its random walk. The default is "
    "[disturbance] of robot.toml, whose random walk reaches its size within 100 s, unless "
    "there is integral action. `none` estimates no disturbance",
    "disturbance-frequency": "frequency [Hz] of a sinusoid that the disturbance NAME contains; the "
    "default is the frequency in [disturbance] of robot.toml",
    "lqg noise": "standard deviation of the noise in each sample of an output. NAME is an output, "
    "a group, or a sensor such as gyroscope or star_tracker. The default is the noise of the "
    "[[output]] in robot.toml",
    "lqg vary": "range of an uncertain parameter. RANGE is as in `fflin uncertain`. The report "
    "states the worst margins of the law in the ranges",
    "lqg delay": "delay [s] between a sample and the application of its command. Without "
    "--sample, the sample time is T",
    "lqg output-file": "save the law, for --controller and `fflin export`, to FILE",
    "lqg plot": "plot the loops and their margins to FILE",
    "tvlqr dt": "former name of --sample",
    "tvlqr output-file": "save the gains to FILE",
    "tune goal": "requirement, such as 'margin disk=0.75 hard=true' or 'max_gain "
    "inputs={tau_b=0.01} outputs={q_b=1e-3}'. TYPE is max_gain, roll_off, margin, decay, damping, "
    "variance or track. Keys and values are as in [[tune.goal]] of robot.toml, which this "
    "option replaces",
    "tune vary": "range of an uncertain parameter over which the goals must hold, as in `fflin "
    "uncertain`. This option replaces [tune.vary] in robot.toml",
    "tune sample": "sample time of the law [s]; the law is continuous by default",
    "tune delay": "delay of the inputs [s]. Without --sample, the sample time is T",
    "tune seed": "random seed of the starts; 0 by default",
    "tune output-file": "save the law to FILE",
    "tune plot": "plot the gains of all goals with their limits, the Nichols plot of the loops, "
    "and the search to FILE",
    "plan hold": "inputs between knots: constant (previous, default) or linearly interpolated "
    "(linear)",
    "plan r": "weight on an input, a group or a pattern. The default is 1/limit^2",
    "plan duration": "duration of the motion [s]",
    "plan output-file": "save the trajectory to FILE",
    "plan knots": "number of equally spaced knots",
    "simulate output-file": "save the motion to FILE",
    "simulate plot": "plot the nonlinear and the linear motion to FILE",
    "simulate html": "write a page that plays the motion offline",
    "simulate engine": "simulate in compiled code or in Python. By default, long runs use compiled "
    "code if numba is installed, and all other runs use Python",
    "export limits": _SATURATION,
    "sweep effort": "value of an input at all points. NAME is the name of the input in u, such as "
    "tau_m.joint_1",
    "sweep output-file": "save the models (with .h5, the same command resumes after an "
    "interruption) to FILE",
    "sweep seed": "random seed of --random",
    "sweep engine": "compute the points in compiled code or in Python. By default, the code is "
    "compiled if numba is installed and the outputs are the state",
    "sweep workers": "distribute the work over N processes; at most one per core",
    "montecarlo engine": "simulate in compiled code or in Python. By default, the runs use "
    "compiled code if numba is installed and the loop is supported",
    "montecarlo output-file": "save the runs (.csv and .mat are tables for other programs; with "
    ".h5, the same command resumes after an interruption) to FILE",
    "montecarlo force": "replace the file of -o even if it contains the runs of another command",
    "montecarlo plot": "plot quantile bands over time, histograms and the worst runs to FILE",
    "montecarlo html": "write a page that plays the worst run",
    "montecarlo seed": "random seed",
    "simulate seed": "random seed of the noise and the drifting biases of sensors",
    "montecarlo budget": "report the error of each cause in the linear loop of the nominal robot, "
    "see fflin.error_budget: the disturbance of the robot and the noise of its outputs",
    "montecarlo goal": "report the fraction of runs that meet CONDITION, such as 'attitude < 1 deg "
    "and settle < 60 s', and draw the bounds of CONDITION in --plot",
    "montecarlo threads": "distribute the runs over N threads; by default one per core",
    "montecarlo workers": "distribute the runs over N processes",
}
