"""Solvers of optimal control problems: Riccati equations, and programs over stages of a motion."""
