"""Kernel: dynamics at many points and simulation of many runs, compiled if numba is installed.

Compiled code computes eight points or runs at a time, for any number of points or runs.

Imports `base`, `robot` and `dynamics`.
"""
