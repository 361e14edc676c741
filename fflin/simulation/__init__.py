"""The nonlinear loop in time, and its `Motion`.

Imports `base`, `robot`, `dynamics`, `linear` and `control`.
"""
