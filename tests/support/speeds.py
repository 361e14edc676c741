"""Speeds of joints between the knots of a planned motion."""

import numpy as np


def largest_speeds(motion, parts=64):
    """Return the largest speeds of the joints (n,) of the motion integrated between knots."""
    largest = np.abs(motion.v[:, 6:]).max(axis=0)
    for k in range(len(motion.t) - 1):
        q, v = motion.q[k], motion.v[k]
        for part in range(parts):
            q, v = motion.end(k, 1, q, v, (part / parts, (part + 1) / parts))
            largest = np.maximum(largest, np.abs(v[6:]))
    return largest
