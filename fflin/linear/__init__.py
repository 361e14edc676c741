"""A, B, C, D about a point or along a motion, and the figures that prove them.

`linearization` prepares and `state_equations` assembles; `certificate` and `check` reach the same
matrices by other routes.
Imports `base`, `robot` and `dynamics`.
"""
