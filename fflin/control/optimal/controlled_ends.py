"""Final values of deflections that the inputs can choose."""

import numpy as np

from fflin.base.validation import Array, Mask
from fflin.control.optimal.shooting import Shooting

# The inputs can choose the final value of a deflection if at least this fraction of their effect on
# it is independent of their effect on the other prescribed states. With less, the effort is large.
_CHOSEN = 0.2

# Singular values below this fraction of the largest count as 0.
_RANK = 1e-6

# Largest importance of an error of a deflection, relative to other states.
_MOST_IMPORTANT = 1e6


def controlled_ends(
    shooting: Shooting, q: Array, v: Array, u: Array, weights: Array, asked: Mask
) -> tuple[Mask, Array]:
    """Return which prescribed states the inputs can choose, and the importance of their errors.

    Deflections are positions of springs without motors, such as modes of flexible appendages. Two
    equal wings bend symmetrically and antisymmetrically, and torques on the base excite only one of
    the two. Also, inputs that are held over whole periods of a mode hardly excite it. Then some
    deflections follow from the other states, and are not prescribed.

    Both results have the shape (nx,). An error of another state has the importance 1. Deflections
    are small, so an error has the importance at which it takes about the same effort to correct.

    `asked` (nx,) is True for the prescribed states, and `weights` (nu,) are the weights of the
    squared inputs. The effect of the inputs is computed along the motion q, v, u.
    """
    half = shooting.state.nx // 2
    importance = np.ones(len(asked))
    springs = [i for i in shooting.deflections if asked[i] or asked[half + i]]
    if not springs:
        return asked, importance
    ends, _ = shooting.jacobians(q, v, u)
    effect = _of_inputs(ends) * np.tile(weights**-0.5, len(u))
    elastic = [i for k in springs for i in (k, half + k) if asked[i]]
    chosen = asked.copy()
    chosen[elastic] = False
    sizes = np.linalg.norm(effect, axis=1) * chosen
    frequencies = np.sqrt(shooting.spring_rates(q, v, u))
    for k, frequency in zip(shooting.deflections, frequencies.tolist(), strict=True):
        # A deflection times its frequency has the size of its rate.
        pair = [k, half + k]
        scales = np.array((frequency, 1.0))
        size = np.linalg.norm(scales[:, None] * effect[pair])
        scales /= size or 1.0
        effect[pair] *= scales[:, None]
        if k in springs:
            of_others = sizes[:half].max(), sizes[half:].max()
            importance[pair] = np.clip(scales * of_others, 1.0, _MOST_IMPORTANT)
    rows = effect[chosen]
    rows /= np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
    _, singular, basis = np.linalg.svd(rows, full_matrices=False)
    basis = basis[singular > _RANK * singular.max(initial=0.0)]
    for i in elastic:
        rest = effect[i] - basis.T @ (basis @ effect[i])
        size = np.linalg.norm(rest)
        if size > _CHOSEN:
            chosen[i] = True
            basis = np.vstack((basis, rest / size))
    return chosen, importance


def _of_inputs(ends: Array) -> Array:
    """Return the derivative (nx, (N + 1) nu) of the last state with respect to all inputs.

    For `ends`, see `solve_stages`.
    """
    N, nx, n = ends.shape
    nu = (n - nx) // 2
    effect = np.zeros((nx, N + 1, nu))
    costate = np.eye(nx)
    for k in range(N - 1, -1, -1):
        by_end = costate @ ends[k]
        effect[:, k] += by_end[:, nx : nx + nu]
        effect[:, k + 1] += by_end[:, nx + nu :]
        costate = by_end[:, :nx]
    return effect.reshape(nx, -1)
