"""Nonlinear dynamics: state, forces, inertia, accelerations and their derivatives, outputs."""
