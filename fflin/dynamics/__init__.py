"""The nonlinear robot: state, forces, inertia, accelerations and their slopes, outputs."""
