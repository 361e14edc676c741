"""Kernel: dynamics and simulation of eight robots at once, compiled by numba if it is installed.

Imports `base`, `robot` and `dynamics`.
"""
