"""A file or a `pinocchio.Model` becomes a `Robot`.

What floats, what acts on it (inputs), what is watched (outputs), springs, locks, the catalogue of
names. Imports `base`; `robot.urdf` reads the file.
"""
