"""Kernel: dynamics and simulation of eight robots in one call, compiled if numba is installed.

Imports `base`, `robot` and `dynamics`.
"""
