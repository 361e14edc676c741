"""The cases: in each module a function `run` that returns its table."""

ORDER = (
    "at_rest",
    "at_point",
    "equipped",
    "growth",
    "number",
    "batch",
    "batch_at_points",
    "lqr",
    "sensitivity",
    "simulation_step",
    "trajectory",
    "loops",
    "campaigns",
    "plans",
    "start_up",
    "memory",
)
