"""The nonlinear robot: state, forces, inertia, accelerations and their slopes, outputs.

The state x of (q, v) and its chart, the inputs as joint-space forces, the inertia M, the
acceleration by RNEA (which makes A and B) and by ABA (which checks them), the outputs. Imports
`base` and `robot`.
"""
