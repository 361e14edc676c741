"""Data of a Kalman filter: the estimated states with their model and noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array
from fflin.control.augmented import AddedStates
from fflin.linear.model import LinearModel


class FilterProblem(NamedTuple):
    """Model and noise of a filter that estimates some states x of a model, and added states.

    Attributes
    ----------
    model : LinearModel
        Whole model about a fixed point.
    added : AddedStates
        Disturbances and biases.
    names : tuple of str (n,)
        Names of the estimated states; the added states are the last.
    A, C : ndarray (n, n), (k, n)
        Matrices of the estimated states and of the outputs that the filter uses.
    W, V : ndarray (n, n), (k, k)
        Covariances or intensities of the noise on these states and outputs.
    covariance : ndarray (ny, ny)
        V of all outputs.
    seen : ndarray (k, ny)
        Selection of the outputs that the filter uses.
    S : ndarray (n, nx)
        Selection of the estimated states from the states of the model and the added states.
    """

    model: LinearModel
    added: AddedStates
    names: tuple[str, ...]
    A: Array
    C: Array
    W: Array
    V: Array
    covariance: Array
    seen: Array
    S: Array

    @property
    def scale(self) -> Array:
        """Scale (n,) of the estimated states: the added states are scaled by their noise."""
        others = len(self.A) - len(self.added.size)
        return np.concatenate((np.ones(others), self.added.size))

    def whole(self) -> tuple[Array, Array, Array]:
        """Return A, B and C of the whole model with the added states."""
        model = self.model
        A, C = self.added.extend(
            model.A, model.C, np.eye(len(model.A)), np.eye(len(model.C))
        )
        count = len(self.added.names)
        B = np.vstack((model.B, np.zeros((count, model.B.shape[1]))))
        return A, B, C

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states of the model and of the added states."""
        return (*self.model.state_names, *self.added.names)
