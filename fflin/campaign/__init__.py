"""Campaigns: many runs of a closed loop whose robot, start and sensors are drawn at random.

What is drawn, the runs eight at a time in the compiled loop or one by one in Python, what is kept
of each, and the record of all with its statistics.
"""
