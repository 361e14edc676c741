"""Linear models of free-floating robots from URDF, for analysis, control and simulation."""

from importlib import import_module

from fflin.base import __version__

# Public names, as {task: {module: names}}. Each name is imported at its first use (PEP 562), so
# that commands which compute no dynamics do not load Pinocchio. Type checkers read `__init__.pyi`,
# which lists the same names and modules.
_PUBLIC = {
    "Robots": {
        "robot.loading": "load from_model",
        "robot.catalog": "list_robots",
        "robot.robot": "Robot",
        "robot.orbit": "CircularOrbit EllipticOrbit",
        "robot.equipment.appendages": "FlexibleAppendage Slosh",
        "robot.constraints": "Weld Hinge Spherical",
        "dynamics.points": "configuration velocity effort",
        "dynamics.closure": "closed",
        "dynamics.impact": "capture Capture jam Impact",
        "dynamics.latching": "latch",
    },
    "Inputs": {
        "robot.inputs": "BaseTorque BaseForce JointTorque Thruster ReactionWheel "
        "Magnetorquer",
        "robot.loading": "load_inputs",
    },
    "Outputs": {
        "robot.outputs": "FullState JointPositions JointVelocities BasePose StarTracker FramePose "
        "FrameVelocity RelativePose Gyroscope Accelerometer CenterOfMass Momentum "
        "ConstraintForce",
    },
    "Linear models": {
        "linear.linearization": "linearize Linearizer",
        "linear.model": "LinearModel Certificate",
        "dynamics.state": "StateMap",
        "linear.fit": "outputs",
        "linear.equilibrium": "equilibrium Equilibrium",
        "linear.trajectory": "Trajectory",
        "linear.linear_trajectory": "linearize_trajectory LinearTrajectory",
        "linear.orbit_motion": "linearize_orbit",
        "linear.exchange": "transform from_tool ToolModel ToolGain",
        "linear.tool_trajectory": "ToolTrajectory ToolSchedule",
        "linear.check": "check Check",
    },
    "Analysis": {
        "analysis.controllability": "controllability Controllability",
        "analysis.observability": "observability Observability gramians Gramians",
        "analysis.modes": "modes Modes Mode",
        "analysis.effective_masses": "effective_masses EffectiveMasses",
        "linear.equilibrium": "relative_equilibria RelativeEquilibria RelativeEquilibrium",
        "analysis.reduction": "momentum_reduction ReducedModel generalized_inertia "
        "generalized_jacobian",
    },
    "Control": {
        "control.lqr": "lqr acceleration_lqr",
        "linear.fit": "line_up",
        "control.weights": "bryson sampled_cost",
        "control.gain": "Gain",
        "control.margins": "margins",
        "control.loop_margins": "Margins ChannelMargins",
        "control.plan": "plan",
        "control.unloading": "unload_wheels",
        "control.mpc": "mpc",
        "control.tvlqr": "tvlqr GainSchedule FilterSchedule",
        "control.tvkalman": "tvkalman",
        "control.kalman": "kalman",
        "control.estimator": "Estimator",
        "control.lqg": "lqg",
        "control.compensator": "Compensator",
        "control.multirate": "MultirateEstimator MultirateCompensator",
    },
    "Uncertainty": {
        "uncertainty.sensitivity": "sensitivity Sensitivity",
        "uncertainty.uncertain": "uncertain Uncertain",
        "uncertainty.lft": "LFT",
    },
    "Tuning": {
        "tuning.tune": "tune",
        "tuning.tuned": "Tuned",
        "tuning.goal_values": "GoalValue",
        "tuning.parameters": "Tunable",
        "tuning.structures": "PD PID LowPass Lead Notch StaticGain StateSpaceLaw CustomLaw "
        "Structure",
        "tuning.goals": "Goal MaxGain RollOff Margin Decay Damping Variance Track",
        "tuning.hinf": "hinf HInfinity",
        "tuning.plots": "plot_tuned",
    },
    "Policies": {
        "control.policy": "Policy StateForm",
        "control.policies": "StateFeedback Allocation",
        "control.bdot": "BDot RateDamping",
        "control.tracking": "TrajectoryFeedback TrajectoryOutputFeedback",
        "control.linear_controller": "OutputFeedback LinearController",
        "control.multirate_feedback": "MultirateFeedback",
        "batch.gains": "ScheduledFeedback",
    },
    "C code": {
        "export.c_code": "write_c CLaw",
    },
    "Simulation": {
        "simulation.simulate": "simulate",
        "simulation.motion": "Motion",
        "simulation.detumbling": "detumbling_time",
        "simulation.pointing": "Pointing PointingError",
        "simulation.error_budget": "error_budget ErrorBudget Contribution",
        "view.visualize": "visualize",
    },
    "Campaigns": {
        "campaign.monte_carlo": "monte_carlo",
        "campaign.campaign": "Campaign",
        "campaign.pointing": "CampaignPointing",
        "campaign.spreads": "load_dispersions",
        "campaign.funnel": "funnel Funnel",
        "campaign.validity": "validity Validity",
    },
    "Sweeps": {
        "batch.sweep": "sweep",
        "batch.linear_batch": "LinearBatch",
        "batch.tool_batch": "ToolBatch",
        "batch.gains": "lqr_batch GainBatch",
        "batch.configurations": "grid Grid random_configurations RandomConfigurations",
    },
    "Figures": {
        "campaign.plots": "plot_validity plot_funnel plot_campaign",
        "control.plots": "plot_matrices plot_check plot_modes plot_poles plot_loops",
        "simulation.plots": "plot_motion",
    },
    "Errors": {
        "base.errors": "FflinError InputError UnknownNameError FileError MissingPackageError "
        "ModelError UrdfError ChartError EquilibriumError SingularInertiaError "
        "ConstraintError StabilizabilityError DetectabilityError SweepError FflinWarning",
    },
}

_MODULES: dict[str, str] = {}
for _title, _modules in _PUBLIC.items():
    _names = " ".join(_modules.values()).split()
    _rows = [", ".join(_names[at : at + 4]) for at in range(0, len(_names), 4)]
    __doc__ = "\n    ".join((f"{__doc__}\n\n{_title}", *_rows))
    _MODULES |= {
        name: module for module, names in _modules.items() for name in names.split()
    }

__all__ = sorted(_MODULES)  # noqa: PLE0605


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'fflin' has no attribute '{name}'")
    value = getattr(import_module(f"fflin.{_MODULES[name]}"), name)
    if type(value) is type(__getattr__):
        _untyped(value)
    globals()[name] = value
    return value


def _untyped(function: object) -> None:
    """Remove annotations from the signature that `help` shows; the docstring gives the types."""
    from inspect import Parameter, signature

    shown = signature(function)
    plain = [
        parameter.replace(annotation=Parameter.empty)
        for parameter in shown.parameters.values()
    ]
    function.__signature__ = shown.replace(
        parameters=plain, return_annotation=Parameter.empty
    )


def __dir__() -> list[str]:
    special = (
        name for name in globals() if name.startswith("__") and name.endswith("__")
    )
    return sorted({*special, *_MODULES})
