"""Eight points to an instruction, compiled by numba where it is installed.

Imports `base`, `robot` and `dynamics`.
"""
