"""Solvers of optimal control problems: Riccati equations, and nonlinear trajectory planning."""
