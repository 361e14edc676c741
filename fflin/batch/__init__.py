"""Sweeps: linear models and gains at many points, on threads or worker processes.

The module `run` applies a job to the rows of arrays, chunk by chunk, on threads or worker
processes. It writes the results into a store, in memory or in a file (see `files`). If the store is
a file, the same call resumes from it after a crash. The module `sweep` uses `run` to linearise a
robot at the points of `configurations`. The result is a batch of models, see `linear_batch`. The
module `gains` designs a regulator for each model of such a batch.

Imports `base`, `robot`, `dynamics`, `kernel`, `linear` and `control`.
"""
