"""Linear models A, B, C, D about a point or along a trajectory, and their verification.

`linearization` prepares the equations and `state_equations` assembles them. `check` computes the
same matrices independently.
Imports `base`, `robot` and `dynamics`.
"""
