"""Robots, made from a file or from a `pinocchio.Model`.

The free-flying tree of joints, its inputs and outputs, springs, locks, and the catalogue of robot
names. Imports `base`; `robot.urdf` reads the file.
"""
