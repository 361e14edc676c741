"""Robots, made from a file or from a `pinocchio.Model`.

This package contains the free-flying tree of joints, its inputs, outputs, springs and locks, and
the catalogue of robot names. `robot.urdf` reads URDF files. Imports `base`.
"""
