"""Robots, made from a file or from a `pinocchio.Model`.

A robot is a free-flying tree of links and joints with inputs, outputs and springs. Joints can be
locked. The package also contains the catalogue of robot names, and `robot.urdf`, which reads URDF
files. Within fflin, the package imports only `base`.
"""
