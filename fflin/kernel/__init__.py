"""Kernel: dynamics and simulation of eight robots at once, compiled if numba is installed.

Imports `base`, `robot` and `dynamics`.
"""
