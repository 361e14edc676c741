"""Characteristic multipliers: eigenvalues of a product of transition matrices."""

import math

import numpy as np

from fflin.base.validation import Array, Complex

# Multipliers are the powers of the eigenvalues of a cyclic matrix with this many blocks. Within one
# block, small and large solutions differ much less than over a whole period.
_BLOCKS = 16

# Multipliers below this fraction of the largest one are reported as "below".
NEGLIGIBLE = 1e-16


def multipliers(factors: Array) -> Complex:
    r"""Return the eigenvalues (nx,) of :math:`\Phi_N \cdots \Phi_1`, the largest first.

    The product itself is not formed, because rounding errors of its large eigenvalues would hide
    the small ones. Instead, groups of factors are the blocks of a cyclic matrix, see (17.4). Its
    eigenvalues are the roots of the multipliers, and their magnitudes differ far less.

    Parameters
    ----------
    factors : ndarray (N, nx, nx)
        Transition matrices, the earliest first.
    """
    nx = factors.shape[-1]
    blocks = _grouped(factors)
    count = len(blocks)
    cyclic = np.zeros((count * nx, count * nx))
    for k, block in enumerate(blocks):
        rows = (k + 1) % count * nx
        cyclic[rows : rows + nx, k * nx : (k + 1) * nx] = block
    roots: Complex = np.linalg.eigvals(cyclic).astype(complex)
    return _powers(roots, count)


def _grouped(factors: Array) -> list[Array]:
    """Return at most `_BLOCKS` products of successive factors."""
    groups = np.array_split(np.arange(len(factors)), min(_BLOCKS, len(factors)))
    blocks = list[Array]()
    for group in groups:
        product = np.eye(factors.shape[-1])
        for k in group:
            product = factors[k] @ product
        blocks.append(product)
    return blocks


def _powers(roots: Complex, count: int) -> Complex:
    """Return the multipliers for the eigenvalues of a cyclic matrix with `count` blocks.

    Each multiplier has `count` roots, which differ by rotations of 2 pi / count. The function
    rotates the largest remaining root, and takes the nearest root for each rotation.
    """
    left = list(roots[np.argsort(-np.abs(roots), kind="stable")])
    turns = np.exp(2j * np.pi * np.arange(1, count) / count)
    values = list[complex]()
    while left:
        first = left.pop(0)
        group = [first**count]
        for turn in turns:
            nearest = int(np.abs(np.array(left) - turn * first).argmin())
            group.append(left.pop(nearest) ** count)
        values.append(complex(np.mean(group)))
    return _paired(np.array(values))


def _paired(values: Complex) -> Complex:
    """Return multipliers of a real matrix: sorted, with exact zeros for rounded imaginary parts."""
    size = np.abs(values)
    real = np.abs(values.imag) <= 1e-12 * size
    values = np.where(real, values.real, values)
    order = np.lexsort((-values.imag, -np.round(np.log10(size + 1e-300), 6)))
    ordered: Complex = values[order]
    return ordered


def multiplier_text(values: Array | Complex) -> str:
    """Return a line about multipliers: the largest magnitude, and how many are negligible."""
    size = np.abs(values)
    largest = float(size.max())
    small = int((size < NEGLIGIBLE * max(largest, 1.0)).sum())
    text = f"largest multiplier {largest:.6g}"
    if not math.isfinite(largest):
        return "the multipliers overflow"
    if small:
        text += f"; {small} of {len(values)} are below {NEGLIGIBLE:g}"
    return text
