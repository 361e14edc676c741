"""Robots and motions in meshcat: one page, pictures, live; JavaScript in `view/assets`.

Imports `base`, `robot`, `dynamics` and `simulation`.
"""
