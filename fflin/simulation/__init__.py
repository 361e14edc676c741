"""Simulation of the nonlinear closed loop, and its result, a `Motion`.

Imports `base`, `robot`, `dynamics`, `linear` and `control`.
"""
