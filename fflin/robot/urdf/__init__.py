"""Reader that turns the text of a URDF into a checked Pinocchio model.

It parses XML, expands xacro, and checks links, joints, the tree, mimic joints and inertias. Within
fflin, it imports only `base`.
"""
