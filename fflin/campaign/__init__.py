"""Monte Carlo campaigns: many runs of a closed loop with random robot, start and sensor errors.

The package has the dispersions, the runs (eight at a time in the compiled loop, or one by one in
Python), the record of each run, and the campaign with its statistics.
"""
