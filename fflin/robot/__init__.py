"""Robots, made from a file or from a `pinocchio.Model`.

A robot is a free-flying tree of joints with inputs, outputs, springs and locked joints. The package
also contains the catalogue of robot names; `robot.urdf` reads URDF files. It imports `base`.
"""
