"""Monte Carlo campaigns: many runs of a closed loop with random errors.

The errors are in the parameters of the robot, in the initial state and in the sensors. The modules
draw the errors, compute the runs, and report the statistics of all runs. Runs are computed eight at
a time in compiled code, or one by one in Python.
"""
