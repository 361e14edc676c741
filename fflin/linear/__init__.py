"""Linear models A, B, C, D about a point or along a trajectory, and their verification.

`linearization` differentiates the accelerations and outputs of a robot. `state_equations` assembles
A, B, C and D from these derivatives. `check` computes A, B, C and D independently.
Imports `base`, `robot` and `dynamics`.
"""
