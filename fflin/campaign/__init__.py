"""Monte Carlo campaigns: many runs of a closed loop with random robot, start and sensor errors.

The package contains the dispersions, the runs and their statistics, and the campaign with its
report. Runs are computed eight at a time in compiled code, or one by one in Python.
"""
