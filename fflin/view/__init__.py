"""Robots, motions and modes in meshcat: one page, pictures, live; JavaScript in `view/assets`.

Imports `base`, `robot`, `dynamics`, `linear`, `analysis` and `simulation`.
"""
