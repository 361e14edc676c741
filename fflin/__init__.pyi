"""Public names of fflin: type checkers read them here, `fflin/__init__.py` at run time."""

__version__: str

# Robots
from fflin.robot.loading import load as load
from fflin.robot.loading import from_model as from_model
from fflin.robot.catalog import list_robots as list_robots
from fflin.robot.robot import Robot as Robot
from fflin.robot.orbit import CircularOrbit as CircularOrbit
from fflin.robot.orbit import EllipticOrbit as EllipticOrbit
from fflin.robot.equipment.appendages import FlexibleAppendage as FlexibleAppendage
from fflin.robot.equipment.appendages import Slosh as Slosh
from fflin.robot.constraints import Weld as Weld
from fflin.robot.constraints import Hinge as Hinge
from fflin.robot.constraints import Spherical as Spherical
from fflin.dynamics.points import configuration as configuration
from fflin.dynamics.points import velocity as velocity
from fflin.dynamics.points import effort as effort
from fflin.dynamics.closure import closed as closed
from fflin.dynamics.impact import capture as capture
from fflin.dynamics.impact import Capture as Capture
from fflin.dynamics.impact import jam as jam
from fflin.dynamics.impact import Impact as Impact
from fflin.dynamics.latching import latch as latch

# Inputs
from fflin.robot.inputs import BaseTorque as BaseTorque
from fflin.robot.inputs import BaseForce as BaseForce
from fflin.robot.inputs import JointTorque as JointTorque
from fflin.robot.inputs import Thruster as Thruster
from fflin.robot.inputs import ReactionWheel as ReactionWheel
from fflin.robot.inputs import Magnetorquer as Magnetorquer
from fflin.robot.loading import load_inputs as load_inputs

# Outputs
from fflin.robot.outputs import FullState as FullState
from fflin.robot.outputs import JointPositions as JointPositions
from fflin.robot.outputs import JointVelocities as JointVelocities
from fflin.robot.outputs import BasePose as BasePose
from fflin.robot.outputs import StarTracker as StarTracker
from fflin.robot.outputs import FramePose as FramePose
from fflin.robot.outputs import FrameVelocity as FrameVelocity
from fflin.robot.outputs import RelativePose as RelativePose
from fflin.robot.outputs import Gyroscope as Gyroscope
from fflin.robot.outputs import Accelerometer as Accelerometer
from fflin.robot.outputs import CenterOfMass as CenterOfMass
from fflin.robot.outputs import Momentum as Momentum
from fflin.robot.outputs import ConstraintForce as ConstraintForce

# Linear models
from fflin.linear.linearization import linearize as linearize
from fflin.linear.linearization import Linearizer as Linearizer
from fflin.linear.model import LinearModel as LinearModel
from fflin.linear.model import Certificate as Certificate
from fflin.dynamics.state import StateMap as StateMap
from fflin.linear.fit import outputs as outputs
from fflin.linear.equilibrium import equilibrium as equilibrium
from fflin.linear.equilibrium import Equilibrium as Equilibrium
from fflin.linear.trajectory import Trajectory as Trajectory
from fflin.linear.linear_trajectory import linearize_trajectory as linearize_trajectory
from fflin.linear.orbit_motion import linearize_orbit as linearize_orbit
from fflin.linear.linear_trajectory import LinearTrajectory as LinearTrajectory
from fflin.linear.exchange import transform as transform
from fflin.linear.exchange import from_tool as from_tool
from fflin.linear.exchange import ToolModel as ToolModel
from fflin.linear.exchange import ToolGain as ToolGain
from fflin.linear.tool_trajectory import ToolTrajectory as ToolTrajectory
from fflin.linear.tool_trajectory import ToolSchedule as ToolSchedule
from fflin.linear.check import check as check
from fflin.linear.check import Check as Check

# Analysis
from fflin.analysis.controllability import controllability as controllability
from fflin.analysis.controllability import Controllability as Controllability
from fflin.analysis.observability import observability as observability
from fflin.analysis.observability import Observability as Observability
from fflin.analysis.observability import gramians as gramians
from fflin.analysis.observability import Gramians as Gramians
from fflin.analysis.modes import modes as modes
from fflin.analysis.modes import Modes as Modes
from fflin.analysis.modes import Mode as Mode
from fflin.analysis.effective_masses import effective_masses as effective_masses
from fflin.analysis.effective_masses import EffectiveMasses as EffectiveMasses
from fflin.linear.equilibrium import relative_equilibria as relative_equilibria
from fflin.linear.equilibrium import RelativeEquilibria as RelativeEquilibria
from fflin.linear.equilibrium import RelativeEquilibrium as RelativeEquilibrium
from fflin.analysis.reduction import momentum_reduction as momentum_reduction
from fflin.analysis.reduction import ReducedModel as ReducedModel
from fflin.analysis.reduction import generalized_inertia as generalized_inertia
from fflin.analysis.reduction import generalized_jacobian as generalized_jacobian

# Control
from fflin.control.lqr import lqr as lqr
from fflin.linear.fit import line_up as line_up
from fflin.control.weights import bryson as bryson
from fflin.control.gain import Gain as Gain
from fflin.control.margins import margins as margins
from fflin.control.loop_margins import Margins as Margins
from fflin.control.loop_margins import ChannelMargins as ChannelMargins
from fflin.control.lqr import acceleration_lqr as acceleration_lqr
from fflin.control.weights import sampled_cost as sampled_cost
from fflin.control.plan import plan as plan
from fflin.control.unloading import unload_wheels as unload_wheels
from fflin.control.mpc import mpc as mpc
from fflin.control.tvlqr import tvlqr as tvlqr
from fflin.control.tvlqr import GainSchedule as GainSchedule
from fflin.control.tvkalman import tvkalman as tvkalman
from fflin.control.tvlqr import FilterSchedule as FilterSchedule
from fflin.control.kalman import kalman as kalman
from fflin.control.estimator import Estimator as Estimator
from fflin.control.lqg import lqg as lqg
from fflin.control.compensator import Compensator as Compensator
from fflin.control.multirate import MultirateEstimator as MultirateEstimator
from fflin.control.multirate import MultirateCompensator as MultirateCompensator

# Uncertainty
from fflin.uncertainty.sensitivity import sensitivity as sensitivity
from fflin.uncertainty.sensitivity import Sensitivity as Sensitivity
from fflin.uncertainty.uncertain import uncertain as uncertain
from fflin.uncertainty.uncertain import Uncertain as Uncertain
from fflin.uncertainty.lft import LFT as LFT

# Tuning
from fflin.tuning.tune import tune as tune
from fflin.tuning.tuned import Tuned as Tuned
from fflin.tuning.goal_values import GoalValue as GoalValue
from fflin.tuning.parameters import Tunable as Tunable
from fflin.tuning.structures import PD as PD
from fflin.tuning.structures import PID as PID
from fflin.tuning.structures import LowPass as LowPass
from fflin.tuning.structures import Lead as Lead
from fflin.tuning.structures import Notch as Notch
from fflin.tuning.structures import StaticGain as StaticGain
from fflin.tuning.structures import StateSpaceLaw as StateSpaceLaw
from fflin.tuning.structures import CustomLaw as CustomLaw
from fflin.tuning.structures import Structure as Structure
from fflin.tuning.goals import Goal as Goal
from fflin.tuning.goals import MaxGain as MaxGain
from fflin.tuning.goals import RollOff as RollOff
from fflin.tuning.goals import Margin as Margin
from fflin.tuning.goals import Decay as Decay
from fflin.tuning.goals import Damping as Damping
from fflin.tuning.goals import Variance as Variance
from fflin.tuning.goals import Track as Track
from fflin.tuning.hinf import hinf as hinf
from fflin.tuning.hinf import HInfinity as HInfinity
from fflin.tuning.plots import plot_tuned as plot_tuned

# Policies
from fflin.control.policy import Policy as Policy
from fflin.control.policy import StateForm as StateForm
from fflin.control.policies import StateFeedback as StateFeedback
from fflin.control.bdot import BDot as BDot
from fflin.control.bdot import RateDamping as RateDamping
from fflin.control.tracking import TrajectoryFeedback as TrajectoryFeedback
from fflin.control.policies import Allocation as Allocation
from fflin.control.linear_controller import OutputFeedback as OutputFeedback
from fflin.control.linear_controller import LinearController as LinearController
from fflin.control.multirate_feedback import MultirateFeedback as MultirateFeedback
from fflin.control.tracking import TrajectoryOutputFeedback as TrajectoryOutputFeedback
from fflin.batch.gains import ScheduledFeedback as ScheduledFeedback

# C code
from fflin.export.c_code import write_c as write_c
from fflin.export.c_code import CLaw as CLaw

# Simulation
from fflin.simulation.simulate import simulate as simulate
from fflin.simulation.motion import Motion as Motion
from fflin.simulation.detumbling import detumbling_time as detumbling_time
from fflin.simulation.pointing import Pointing as Pointing
from fflin.simulation.pointing import PointingError as PointingError
from fflin.simulation.error_budget import error_budget as error_budget
from fflin.simulation.error_budget import ErrorBudget as ErrorBudget
from fflin.simulation.error_budget import Contribution as Contribution
from fflin.view.visualize import visualize as visualize

# Campaigns
from fflin.campaign.monte_carlo import monte_carlo as monte_carlo
from fflin.campaign.campaign import Campaign as Campaign
from fflin.campaign.pointing import CampaignPointing as CampaignPointing
from fflin.campaign.spreads import load_dispersions as load_dispersions
from fflin.campaign.funnel import funnel as funnel
from fflin.campaign.funnel import Funnel as Funnel
from fflin.campaign.validity import validity as validity
from fflin.campaign.validity import Validity as Validity

# Sweeps
from fflin.batch.sweep import sweep as sweep
from fflin.batch.linear_batch import LinearBatch as LinearBatch
from fflin.batch.tool_batch import ToolBatch as ToolBatch
from fflin.batch.gains import lqr_batch as lqr_batch
from fflin.batch.gains import GainBatch as GainBatch
from fflin.batch.configurations import grid as grid
from fflin.batch.configurations import Grid as Grid
from fflin.batch.configurations import random_configurations as random_configurations
from fflin.batch.configurations import RandomConfigurations as RandomConfigurations

# Figures
from fflin.control.plots import plot_matrices as plot_matrices
from fflin.control.plots import plot_check as plot_check
from fflin.control.plots import plot_modes as plot_modes
from fflin.campaign.plots import plot_validity as plot_validity
from fflin.campaign.plots import plot_funnel as plot_funnel
from fflin.control.plots import plot_poles as plot_poles
from fflin.control.plots import plot_loops as plot_loops
from fflin.simulation.plots import plot_motion as plot_motion
from fflin.campaign.plots import plot_campaign as plot_campaign

# Errors
from fflin.base.errors import FflinError as FflinError
from fflin.base.errors import InputError as InputError
from fflin.base.errors import UnknownNameError as UnknownNameError
from fflin.base.errors import FileError as FileError
from fflin.base.errors import MissingPackageError as MissingPackageError
from fflin.base.errors import ModelError as ModelError
from fflin.base.errors import UrdfError as UrdfError
from fflin.base.errors import ChartError as ChartError
from fflin.base.errors import EquilibriumError as EquilibriumError
from fflin.base.errors import SingularInertiaError as SingularInertiaError
from fflin.base.errors import ConstraintError as ConstraintError
from fflin.base.errors import StabilizabilityError as StabilizabilityError
from fflin.base.errors import DetectabilityError as DetectabilityError
from fflin.base.errors import SweepError as SweepError
from fflin.base.errors import FflinWarning as FflinWarning
