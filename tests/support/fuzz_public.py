"""Calls of every public function with arguments that nobody should give it."""

import math

import numpy as np
import pinocchio as pin

import fflin

ODD = {
    "None": None,
    "word": "nosuch",
    "nan": math.nan,
    "inf": math.inf,
    "huge": 1e300,
    "tiny": 1e-300,
    "negative": -1.0,
    "zero": 0,
    "many": 99999999999999999999,
    "complex": 1j,
    "ragged": [[1.0, 2.0], [3.0]],
    "masked": np.ma.masked_array(np.zeros(3), mask=[1, 0, 0]),
    "object": np.array([None, {}], dtype=object),
    "matrix": np.full((2, 3), np.nan),
    "scalar": np.array(3.0),
    "empty": [],
    "mapping": {"nosuch": 1.0},
    "keys": {3: None},
    "words": ["a", ["b"]],
    "type": dict,
    "bytes": b"\x00",
    "pose": pin.SE3(2.0 * np.eye(3), np.zeros(3)),
    "five": 5,
    "true": True,
    "trillion": 10**12,
    "largest": 1e308,
    "surrogate": "\udc80",
    "surrogates": ["\udc80"],
    "null": "a\0b",
    "return": "a\rb ",
    "long": "x" * 5000,
    "array": np.zeros(3),
    "large array": np.full(3, 1e308),
    "large matrix": np.full((3, 3), 1e308),
    "no entries": np.zeros(0),
    "text array": np.array(["a"]),
    "date": np.datetime64("2020"),
    "set": {1.0},
    "nested": {"q_b": {"x": [1]}},
    "nothing": [None],
    "pair": (1, 2),
    "device": "/dev/zero",
    "thing": object(),
}


def _objects():
    """Robot, models and designs that the calls take."""
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin, 1.0, 1.0)
    filtered = fflin.kalman(lin, 1.0, 1.0)
    t = np.array([0.0, 0.01, 0.02])
    rows = {
        "q": np.tile(robot.neutral(), (3, 1)),
        "v": np.zeros((3, robot.nv)),
        "u": np.zeros((3, 6 + robot.n)),
    }
    along = fflin.linearize_trajectory(robot, t, **rows)
    return robot, lin, gain, filtered, {"t": t} | rows, along


def _wheels():
    """Law of a satellite with wheels, and its robot with a base torque."""
    wheel = fflin.ReactionWheel((0, 0, 1), inertia=1e-6)
    robot = fflin.load("cubesat", inputs=[wheel])
    lin = fflin.linearize(robot)
    law = fflin.StateFeedback(lin, np.zeros(lin.B.shape[::-1]))
    return {"law": law, "design": robot.replace(inputs=[fflin.BaseTorque(), wheel])}


def light(folder):
    """Calls that need no compiled code and no second, by the names of the functions."""
    robot, lin, gain, filtered, knots, along = _objects()
    q, v, u = robot.neutral(), np.zeros(robot.nv), np.zeros(6 + robot.n)
    given = lin.to("mujoco")
    motion = fflin.simulate(robot, fflin.StateFeedback(lin, gain.K), duration=0.05)
    sensitive = fflin.sensitivity(lin)
    uncertain = fflin.uncertain(robot, {"base.mass": 0.1})
    result = {"robot": robot, "q": q, "v": v, "u": u}
    place = {"frame": "hybrid", "reference": pin.SE3.Identity(), "moving": False}
    weights = {"Q": 1.0, "R": 1.0}
    filtered_model = fflin.linearize(robot.replace(stiffness=1.0, damping=1.0))
    vector = (0.0, 0.0, 1.0)
    joint = robot.joint_names[0]
    sensor = {"sample": 0.1, "delay": 0.1, "lag": 0.1, "noise": 1e-5, "bias": 1e-6}
    outputs = [fflin.BasePose(sample=0.2), fflin.JointPositions()]
    slow = fflin.linearize(robot.replace(outputs=outputs)).discretize(0.1)
    slow_filter = fflin.kalman(slow, 1.0, 1.0)
    slow_law = fflin.lqg(fflin.lqr(slow), slow_filter)
    return {
        "unload_wheels": _wheels() | {"rate": 0.1},
        "Accelerometer": {"frame": "base"} | sensor,
        "Allocation": {"policy": fflin.StateFeedback(lin, gain.K), "design": robot},
        "BaseForce": {"max": 1.0, "min": (-1.0, -1.0, 0.0), "lag": 0.1},
        "BasePose": {} | sensor,
        "BaseTorque": {"max": (1.0, 1.0, 1.0), "min": None, "lag": 0.1},
        "bryson": {"lin": lin, "largest": {"q_b": 1.0}},
        "CenterOfMass": {} | sensor,
        "capture": {
            **{
                "robot": robot,
                "frame": "hand",
                "payload": pin.Inertia(1.0, np.zeros(3), 0.1 * np.eye(3)),
                "q": q,
                "v": v,
            },
            **{
                "placement": pin.SE3.Identity(),
                "payload_q": None,
                "payload_v": np.zeros(6),
            },
            "prefix": "caught",
        },
        "CircularOrbit": {
            **{"altitude": 7e5, "mean_motion": None, "body": "earth", "mu": None},
            "body_radius": None,
            **{"inclination": 1.0, "argument_of_latitude": 0.1, "field": "dipole"},
        },
        "BDot": {"gain": 1.0},
        "RateDamping": {"gain": 1.0},
        "detumbling_time": {"motion": motion, "factor": 4.0},
        "Magnetorquer": {
            **{"axis": vector, "frame": "base", "name": "m", "max": 1.0, "min": None}
        },
        "closed": {"robot": robot, "q": q, "v": v},
        "EllipticOrbit": {
            **{"perigee": 7e5, "apogee": 9e5, "eccentricity": None, "body": "earth"},
            **{"inclination": 0.1, "argument_of_perigee": 0.2, "anomaly": 0.3},
            **{"mu": None, "body_radius": None},
        },
        "configuration": {
            "robot": robot,
            "joints": {joint: 0.1},
            "base": pin.SE3.Identity(),
        },
        "controllability": {"lin": lin},
        "effort": {"robot": robot, "values": {}},
        "equilibrium": {
            "robot": robot,
            "q": q,
            "v": v,
            "frame": "hybrid",
            "tilt": True,
            "disturbed": False,
        },
        "FramePose": {"frame": "base"} | sensor,
        "FrameVelocity": {"frame": "base"} | sensor,
        "from_model": {
            "model": robot.model,
            "name": "x",
            "lock": None,
            "gravity": vector,
        },
        "FullState": {} | sensor,
        "generalized_inertia": {"lin": lin},
        "generalized_jacobian": {"robot": robot, "q": q, "frame": "base"},
        "margins": {
            "policy": gain,
            "lin": lin,
            "delay": 0.0,
            "sample": None,
            "at": "inputs",
        },
        "error_budget": {
            "policy": gain,
            "lin": lin,
            "noise": {"q_b": 1e-4},
            "bias": {"omega_b.x": 1e-5},
            "disturbance": {"tau_b": (1e-3, 0.0, 0.0)},
            "periodic": {"tau_b.x": (1e-3, 0.1)},
            "force_noise": {"tau_b.z": 1e-4},
            "delay": 0.1,
            "sample": 0.1,
            "factor": 3.0,
            "motion": None,
            "robot": robot,
            "limit_cycle": False,
            "after": None,
        },
        "gramians": {"lin": filtered_model, "duration": 1.0},
        "grid": {"robot": robot, "axes": {joint: [0.0, 1.0]}, "base": None},
        "Gyroscope": {"frame": "base"} | sensor,
        "jam": {"robot": robot, "joints": [joint], "q": q, "v": v},
        "JointPositions": {"joints": (joint,)} | sensor,
        "JointTorque": {"joint": joint, "max": 1.0, "min": -0.5, "lag": 0.1},
        "JointVelocities": {"joints": (joint,)} | sensor,
        "kalman": {
            "lin": lin,
            "W": 1.0,
            "V": 1.0,
            "G": lin.B,
            "disturbance_noise": {"tau_b": 1e-6},
            "bias_noise": None,
            "disturbance_frequency": {"tau_b.x": [0.01]},
        },
        "latch": {
            "robot": robot,
            "constraints": fflin.Weld("hand", "base"),
            "q": q,
            "v": v,
        },
        "linearize": result | place | {"independent": ["q_b"]},
        "linearize_trajectory": knots
        | {"robot": robot, "strict": False, "hold": "previous", "frame": "world"},
        "linearize_orbit": {
            "robot": fflin.load("cubesat", orbit=7e5),
            "q": None,
            "motion": "held",
            "steps": 8,
        },
        "Linearizer": {"robot": robot} | place | {"independent": ["q_b"]},
        "list_robots": {},
        "LinearController": {"system": -gain.K, "lin": lin, "sign": -1, "noise": None},
        "load": {
            **{
                "robot": "planar_detumble",
                "lock": [joint],
                "package_dirs": (),
                "inputs": None,
            },
            **{
                "outputs": None,
                "stiffness": 1.0,
                "damping": "urdf",
                "rest": {},
                "gravity": vector,
            },
            "limits": {"tau_b": 1.0},
            "disturbance": {"tau_b": vector},
        },
        "Tunable": {"value": 1.0, "least": 0.5, "largest": 2.0, "name": "k"},
        **{
            key: {
                **{"measured": "q_b", "inputs": "tau_b", "kp": 1.0, "kd": (1.0, 2.0)},
                **{"lag": 0.1, "bandwidth": 1.0, "coupled": False, "name": "axis"},
                "distribution": np.eye(3),
            }
            for key in ("PD", "PID")
        },
        "LowPass": {"frequency": (1.0, 2.0), "order": 2, "damping": 0.7, "name": "f"},
        "Lead": {"zero": 1.0, "pole": (2.0, 5.0), "name": "f"},
        "Notch": {"frequency": (1.0, 2.0), "zero_damping": 0.1, "name": "f"},
        "StaticGain": {
            **{"measured": "q_b", "inputs": "tau_b", "pattern": None, "largest": 1.0},
            "name": "k",
        },
        "StateSpaceLaw": {"order": 2, "measured": "q_b", "inputs": "tau_b"}
        | {"feedthrough": True, "bandwidth": 1.0, "name": "k"},
        "CustomLaw": {
            "matrices": lambda parameters: ([], [], [], [[-1.0]]),
            **{"parameters": {"k": (0.5, 1.0)}, "measured": "q_b.x"},
            "inputs": "tau_b.x",
        },
        "MaxGain": {
            **{"inputs": "tau_b", "outputs": {"q_b": 1.0}, "below": 1.0},
            **{"band": (0.1, 1.0), "hard": True},
        },
        "RollOff": {"inputs": "q_b", "outputs": "tau_b", "above": 1.0, "below": 1.0}
        | {"hard": False},
        "Margin": {"disk": 0.7, "at": "outputs", "hard": True},
        "Decay": {"rate": 0.1, "hard": True},
        "Damping": {"ratio": 0.5, "band": (0.1, 1.0), "hard": True},
        "Variance": {"inputs": {"tau_b": 1.0}, "outputs": {"q_b": 1.0}, "hard": True},
        "Track": {
            **{"output": "q_b.x", "settling": 5.0, "within": 0.1, "overshoot": 0.2},
            **{"duration": 20.0, "hard": False},
        },
        "hinf": {
            "lin": lin,
            "goals": fflin.MaxGain({"tau_b": 1.0, "q_b": 1.0}, ("q_b", "tau_b")),
            **{"measured": "q_b", "inputs": "tau_b"},
        },
        "tune": {
            "plant": lin,
            "structure": fflin.PD("q_b", "tau_b", rates="omega_b"),
            "goals": fflin.Decay(0.1),
            **{"dt": 1.0, "delay": 0.0, "q": q, "starts": 1, "steps": 2, "seed": 0},
        },
        "plot_tuned": {"tuned": None, "path": None, "axes": None},
        "load_dispersions": {"path": "nosuch.toml"},
        "load_inputs": {"path": "nosuch.toml"},
        "line_up": {"gain": gain, "lin": lin},
        "lqg": {"gain": gain, "estimator": filtered, "zero_error": ["q_b"]},
        "lqr": {"lin": lin} | weights | {"N": None},
        "Momentum": {} | sensor,
        "MultirateFeedback": {"lin": slow, "compensator": slow_law, "noise": None},
        "from_tool": {
            **{
                "robot": robot,
                "tool": "mujoco",
                "q": given.q,
                "v": given.v,
                "u": given.u0,
            },
            **{"A": given.A, "B": given.B, "dt": None, "frame": "hybrid"},
            **{"reference": pin.SE3.Identity(), "moving": False},
        },
        "transform": {"robot": robot, "lin": lin, "tool": "mujoco", "dt": 0.1},
        "LinearModel.to": {"self": lin, "tool": "euler", "dt": None},
        "ToolModel.load": {"path": "nosuch.npz"},
        "ToolModel.save": {"self": given, "path": folder / "d.npz"},
        "plot_funnel": {"funnel": None, "path": None},
        "observability": {"lin": lin},
        "OutputFeedback": {
            "lin": lin,
            "compensator": fflin.lqg(gain, filtered),
            "noise": None,
        },
        "outputs": {"lin": lin} | result,
        "plot_loops": {
            "policy": gain,
            "path": None,
            "lin": lin,
            "delay": 0.1,
            "sample": 1.0,
        },
        "plot_matrices": {"lin": lin, "path": None},
        "plot_motion": {"motion": motion, "path": None, "show": None},
        "plot_poles": {"poles": gain, "path": None, "dt": 0.0, "title": "x"},
        "plot_validity": {"validity": None, "path": None},
        "random_configurations": {
            "robot": robot,
            "count": 3,
            "seed": 0,
            "ranges": None,
            "base": None,
        },
        "RelativePose": {"frame": "base", "to": "base"} | sensor,
        "ConstraintForce": {"name": "held", "components": ("force.x",)},
        "ReactionWheel": {
            "axis": vector,
            "frame": None,
            "inertia": 0.1,
            "name": "w",
            "momentum": 0,
            "lag": 0.1,
            "max": 1.0,
            "max_speed": 10.0,
        },
        "sampled_cost": {"lin": lin, "dt": 0.1} | weights,
        "sensitivity": {"lin": lin},
        "simulate": {
            **{
                "robot": robot,
                "policy": None,
                "q0": q,
                "v0": v,
                "duration": 0.02,
                "dt": 0.01,
            },
            **{
                "method": "cf4",
                "sample": None,
                "delay": 0.0,
                "limits": None,
                "events": (),
            },
            **{
                "disturbance": None,
                "callback": None,
                "linear": None,
                "every": 1,
                "x0": None,
            },
            **{"frame": "hybrid", "reference": None, "target": None},
        },
        "FlexibleAppendage": {
            **{"frame": "base", "frequency": [0.5], "translation": np.zeros((3, 1))},
            **{"rotation": np.zeros((3, 1)), "damping": 0.01, "name": "array"},
            **{"inertia": None, "rigid": False},
        },
        "Slosh": {
            **{"frame": "base", "mass": 1.0, "position": vector, "frequency": 0.2},
            **{"length": None, "axis": (0, 0, 1), "damping": 0.01, "name": "tank"},
        },
        **{
            name: {"frame": "base", "to": None, "placement": None, "name": "held"}
            for name in ("Weld", "Spherical")
        },
        "Hinge": {
            **{"frame": "base", "to": None, "axis": (0, 0, 1)},
            **{"placement": None, "name": "held"},
        },
        "StarTracker": {} | sensor,
        "StateFeedback": {"lin": lin, "K": gain.K},
        "StateMap": {"robot": robot, "reference": None, "frame": "hybrid"},
        "Thruster": {
            **{"frame": "base", "position": vector, "direction": vector, "name": "t"},
            **{
                "lag": 0.1,
                "max": 1.0,
                "min": None,
                "on_off": True,
                "least_impulse": 0.1,
                "isp": 220.0,
            },
            "torque": 0.02,
        },
        "Trajectory": knots | {"robot": robot, "hold": None, "frame": "local"},
        "uncertain": {
            "robot": robot,
            "ranges": {"base.mass": 0.1, "link_1.com.x": (0.1, 0.2)},
        },
        "velocity": {"robot": robot, "values": {}},
        "Sensitivity.along": {"self": sensitive, "direction": {"base.mass": 1.0}},
        "Sensitivity.check": {"self": sensitive, "names": ["base.mass"]},
        "Sensitivity.poles": {"self": sensitive, "gain": gain.K},
        "Uncertain.at": {"self": uncertain, "values": {"base.mass": 100.0}},
        "Uncertain.samples": {"self": uncertain, "n": 1, "seed": 0},
        "LFT.load": {"path": "nosuch.npz"},
        "LinearTrajectory.discretize": {"self": along, "dt": 0.01},
        "LinearTrajectory.load": {"path": "nosuch.npz", "robot": robot},
        "LinearTrajectory.matrices": {"self": along, "t": 0.015},
        "Trajectory.load": {
            "path": "nosuch.csv",
            "robot": robot,
            "hold": None,
            "frame": None,
        },
        "Trajectory.point": {"self": along, "t": 0.015},
        "Trajectory.resampled": {"self": along, "dt": 0.01},
        "Trajectory.save": {"self": along, "path": folder / "c.npz"},
        "LinearModel.discretize": {"self": lin, "dt": 0.1},
        "LinearModel.with_lags": {"self": lin, "lag": 0.1, "output_lag": None},
        "LinearModel.is_equilibrium": {"self": lin, "tol": 1e-9},
        "LinearModel.load": {"path": "nosuch.npz"},
        "LinearModel.save": {"self": lin, "path": folder / "a.npz"},
        "Motion.save": {"self": motion, "path": folder / "b.npz"},
        "Robot.perturbed": {
            "self": robot,
            "mass": 0.1,
            "com": 0.1,
            "inertia": 0.1,
            "seed": 0,
        },
        "Robot.with_mass_properties": {
            "self": robot,
            "bodies": {"base": {"mass": 1.0}},
        },
        "Robot.replace": {
            **{
                "self": robot,
                "inputs": robot.inputs,
                "outputs": robot.outputs,
                "gravity": vector,
                "disturbance": {"tau_b": vector},
            },
            **{
                "stiffness": 1.0,
                "damping": {},
                "rest": {},
                "passive": [],
                "weights": {},
            },
            **{"point": {}, "target": {}, "start": {}},
        },
        "StateMap.to_pinocchio": {"self": fflin.StateMap(robot), "x": lin.x0},
        "StateMap.to_state": {"self": fflin.StateMap(robot), "q": q, "v": v},
        "CircularOrbit.from_json": {"text": "{}"},
        "EllipticOrbit.at": {
            "self": fflin.EllipticOrbit(perigee=5e5, apogee=9e5),
            "t": 10.0,
        },
        "EllipticOrbit.from_json": {"text": "{}"},
        "Compensator.load": {"path": "nosuch.npz"},
        "Estimator.load": {"path": "nosuch.npz"},
        "MultirateEstimator.load": {"path": "nosuch.npz"},
        "MultirateCompensator.load": {"path": "nosuch.npz"},
        "FilterSchedule.load": {"path": "nosuch.npz"},
        "Funnel.load": {"path": "nosuch.npz", "robot": robot},
        "Gain.load": {"path": "nosuch.npz"},
        "Gain.save": {"self": gain, "path": folder / "gain.json"},
        "Gain.to": {"self": gain, "tool": "mujoco"},
        "GainBatch.load": {"path": "nosuch.npz"},
        "GainSchedule.load": {"path": "nosuch.npz"},
        "Campaign.load": {"path": "nosuch.npz"},
        "LinearBatch.load": {"path": "nosuch.npz", "robot": robot, "verify": True},
        "LinearTrajectory.check": {"self": along, "tolerance": 1e-3},
        "LinearTrajectory.save": {"self": along, "path": folder / "along.npz"},
        "Motion.load": {"path": "nosuch.npz"},
        "Motion.plot": {"self": motion, "path": None, "show": None},
        "Motion.pointing": {
            "self": motion,
            "window": 0.01,
            "after": None,
            "apart": None,
            "accuracy": None,
            "line_of_sight": None,
        },
        "Motion.trajectory": {"self": motion, "robot": robot},
        "Robot.checked_configuration": {"self": robot, "q": q},
        "Robot.checked_velocity": {"self": robot, "v": v},
        "Robot.joint": {"self": robot, "name": joint},
        "Sensitivity.save": {"self": sensitive, "path": folder / "sensitivity.npz"},
        "Sensitivity.table": {"self": sensitive, "top": 3, "only": None},
        "Slosh.cylinder": {
            **{
                "frame": "base",
                "radius": 0.1,
                "height": 0.2,
                "density": 1e3,
                "acceleration": 1.0,
            },
            **{
                "bottom": vector,
                "axis": vector,
                "pendulum": True,
                "damping": 0.0,
                "name": "t",
            },
        },
        "ToolGain.load": {"path": "nosuch.npz"},
    }


def sound(folder):
    """What each public function takes, by the names of its arguments: a call that works."""
    robot, lin, gain, _, _, along = _objects()
    q, v, u = robot.neutral(), np.zeros(robot.nv), np.zeros(6 + robot.n)
    motion = fflin.simulate(robot, fflin.StateFeedback(lin, gain.K), duration=0.05)
    schedule = fflin.tvlqr(along, 1.0, 1.0, 1.0)
    uncertain = fflin.uncertain(robot, {"base.mass": 0.1})
    batch = fflin.sweep(robot, [q, q])
    campaign = fflin.monte_carlo(robot, None, {"q_b": 0.01}, runs=2, duration=0.02)
    result = {"robot": robot, "q": q, "v": v, "u": u}
    place = {"frame": "hybrid", "reference": pin.SE3.Identity(), "moving": False}
    weights = {"Q": 1.0, "R": 1.0}
    filtered_model = fflin.linearize(robot.replace(stiffness=1.0, damping=1.0))
    return light(folder) | {
        "acceleration_lqr": {"lin": lin, "Qp": 1.0, "Qv": 1.0, "Ra": 1.0},
        "check": {"robot": robot, "lin": lin, "tolerance": 1e-6},
        "lqr_batch": {"batch": batch} | weights,
        "modes": {"lin": lin},
        "effective_masses": {"lin": lin},
        "relative_equilibria": {
            "robot": robot.replace(orbit=7e5),
            "q": q,
            "frame": "hill",
        },
        "mpc": {
            **{
                "lin": lin,
                "Q": 1.0,
                "R": 1.0,
                "horizon": 2,
                "dt": 0.1,
                "limits": {"tau_b": 1.0},
            },
            **{"Qf": "steady", "weights": None, "disturbance": None},
        },
        "funnel": {
            **{
                "robot": robot,
                "schedule": schedule,
                "goal": {"attitude": 1.0},
                "within": None,
            },
            **{
                "knots": 1,
                "samples": 1,
                "seed": 0,
                "confidence": 0.9,
                "dt": 0.01,
                "engine": None,
            },
            **dict.fromkeys(
                ("executor", "workers", "threads", "progress", "limits", "sample")
            ),
        },
        "momentum_reduction": {
            "lin": fflin.linearize(robot.replace(inputs=robot.inputs[2:]))
        },
        "monte_carlo": {
            **{
                "robot": robot,
                "policy": None,
                "dispersions": {"q_b": 0.01},
                "runs": 2,
                "seed": 0,
            },
            **{
                "duration": 0.02,
                "until": None,
                "width": 0.1,
                "confidence": 0.9,
                "threads": 1,
            },
            **{
                "executor": None,
                "chunk": None,
                "progress": None,
                "out": None,
                "engine": None,
            },
            **{"goals": (), "histories": 0},
        },
        "plan": {
            **{
                "robot": robot,
                "goal": (q, None),
                "duration": 1.0,
                "q0": q,
                "v0": v,
                "x0": None,
            },
            **{"knots": 3, "hold": "previous", "limits": None, "R": 1.0, "free": ()},
            "guess": None,
        },
        "plot_campaign": {
            "campaign": campaign,
            **{"path": None, "worst": 1},
        },
        "plot_check": {"check": fflin.check(robot, lin), "path": None},
        "plot_modes": {"modes": fflin.modes(filtered_model), "path": None},
        "ScheduledFeedback": {"lin": lin, "gains": fflin.lqr_batch(batch, **weights)},
        "sweep": result
        | {"q": [q]}
        | place
        | dict.fromkeys(("executor", "threads", "chunk", "progress", "out")),
        "TrajectoryFeedback": {"trajectory": along, "schedule": schedule},
        "TrajectoryOutputFeedback": {
            **{
                "trajectory": along,
                "filter": fflin.tvkalman(along, 1.0, 1.0, P0=1.0, sample=0.01),
            },
            **{"schedule": fflin.tvlqr(along, 1.0, 1.0, 1.0, 0.01), "noise": None},
        },
        "tvkalman": {
            "traj": along,
            "W": 1.0,
            "V": 1.0,
            "G": along.B,
            "P0": 1.0,
            "sample": 0.01,
        },
        "tvlqr": {"traj": along, "Qf": 1.0, "sample": None, "weights": None} | weights,
        "validity": {
            **{
                "robot": robot,
                "lin": lin,
                "gain": None,
                "attitude": 5.0,
                "position": 0.1,
            },
            **{
                "joint": 0.1,
                "samples": 1,
                "seed": 0,
                "confidence": 0.9,
                "executor": None,
            },
            **{"limits": None, "workers": None, "threads": 1, "engine": None},
        },
        "CLaw": {"folder": fflin.write_c(gain, folder / "c_code"), "compiler": "cc"},
        "write_c": {
            **{
                "law": gain,
                "folder": folder / "c_code_2",
                "robot": robot,
                "limits": "urdf",
            },
            **{"name": "controller", "real": "double"},
        },
        "visualize": {
            **{
                "robot": robot,
                "motion": motion,
                "html": folder / "a.html",
                "open": False,
            },
            **{"tool": None, "fps": 10.0, "speed": 1.0, "scene": "space"},
        },
        "Uncertain.lft": {"self": uncertain, "q": q},
        "LFT.at": {"self": uncertain.lft(), "values": {"base.mass": 100.0}},
        "Campaign.fraction": {
            "self": campaign,
            "condition": "settled",
            "confidence": 0.9,
        },
        "Campaign.mean": {"self": campaign, "name": "attitude", "confidence": 0.9},
        "Campaign.met": {"self": campaign, "condition": "settled"},
        "Campaign.quantile": {
            "self": campaign,
            "name": "attitude",
            "p": 0.5,
            "confidence": 0.9,
        },
        "Campaign.replay": {"self": campaign, "run": 0},
        "Campaign.save": {"self": campaign, "path": folder / "campaign.npz"},
        "Campaign.sensitivity": {"self": campaign, "name": None},
        "Campaign.values": {"self": campaign, "name": "attitude"},
        "Campaign.worst": {"self": campaign, "k": 1},
        "GainSchedule.cost_to_go": {"self": schedule, "t": 0.0},
        "GainSchedule.gain": {"self": schedule, "t": 0.0},
        "GainSchedule.trajectory": {"self": schedule, "robot": robot},
        "LinearBatch.nearest": {"self": batch, "joints": {"joint_1": 0.0}},
        "LinearBatch.save": {"self": batch, "path": folder / "batch.npz"},
        "LinearBatch.select": {"self": batch, "joints": {"joint_1": 0.0}},
        "Uncertain.worst": {
            **{"self": uncertain, "gain": gain.K, "q": q, "samples": 1, "seed": 0},
        },
        "FlexibleAppendage.from_nastran": {
            **{
                "op4": "nosuch.op4",
                "asm": "nosuch.asm",
                "frame": "base",
                "origin": None,
            },
            **{
                "modes": None,
                "length": "m",
                "mass": "kg",
                "damping": 0.01,
                "name": None,
            },
        },
    }
