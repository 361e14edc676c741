"""Simulation of the nonlinear closed loop. Its result is a `Motion`.

Imports `base`, `robot`, `dynamics`, `kernel`, `linear` and `control`.
"""
