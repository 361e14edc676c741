"""Arguments of compiled functions as words, and functions that are compiled into others."""

from collections import namedtuple

import numpy as np
import pytest

pytest.importorskip("numba")

import numba

from fflin.kernel.machine_code import PartLibrary, opener, translated
from fflin.kernel.tree import (
    FLAG,
    FLAGS,
    INDICES,
    LANED,
    REAL,
    WHOLE,
    Kind,
    Struct,
    empty,
    laid_out,
)
from fflin.kernel.vectors import called

pytestmark = pytest.mark.compiled

Inner = namedtuple("Inner", "values share")
Outer = namedtuple("Outer", "count on reals flags indices table lanes inner more")
INNER = Struct(Inner, share=REAL)
OUTER = Struct(
    Outer,
    count=WHOLE,
    on=FLAG,
    flags=FLAGS,
    indices=INDICES,
    table=Kind(np.intp, 2),
    lanes=LANED,
    inner=INNER,
    more=INNER,
)
VALUE = Outer(
    count=-3,
    on=True,
    reals=[0.5, 2.0],
    flags=[True, False, True],
    indices=[4, 5],
    table=[[1, 2, 3], [4, 5, 6]],
    lanes=[7.0, 8.0],
    inner=Inner([], -1e-300),
    more=Inner([1.0, 2.0, 3.0], np.inf),
)


def test_every_kind_of_field_is_read_from_its_words():
    opened = opener(OUTER)

    @numba.njit
    def read(words):
        fields = opened(words)
        whole = (
            fields.count,
            fields.table[1, 2],
            fields.indices[1],
            len(fields.inner.values),
            fields.table.shape[1],
        )
        real = (
            fields.reals[1],
            fields.lanes[1, 7],
            fields.inner.share,
            fields.more.share,
            fields.more.values[2],
        )
        return whole, real, (fields.on, fields.flags[1], fields.flags[2])

    value, words, _ = laid_out(VALUE, OUTER)
    whole, real, flags = read(words)
    assert value.lanes.shape == (2, 8)
    assert whole == (-3, 6, 5, 0, 3)
    assert real == (2.0, 8.0, -1e-300, np.inf, 3.0)
    assert flags == (True, False, True)


def test_compiled_code_writes_to_the_arrays():
    opened = opener(OUTER)

    @numba.njit
    def write(words):
        fields = opened(words)
        fields.lanes[0, 3] = fields.more.values[0] = 9.0
        fields.indices[0] = fields.count

    value, words, fresh = laid_out(VALUE, OUTER)
    write(words)
    assert value.lanes[0].tolist() == [7.0] * 3 + [9.0] + [7.0] * 4
    assert value.more.values[0] == 9.0 and value.indices[0] == -3
    (array, before), *others = fresh
    assert array is value.lanes and before.tolist() == [[7.0], [8.0]] and not others


def test_arrays_are_converted_to_their_kind_or_refused():
    for reals in (
        np.array([0.5, 2.0], np.float32),
        np.array([0.5, 9.0, 2.0, 9.0])[::2],
    ):
        value, words, _ = laid_out(VALUE._replace(reals=reals), OUTER)
        assert value.reals.dtype == float and value.reals.flags.c_contiguous
        assert (
            value.reals.tolist() == [0.5, 2.0] and words[2] == value.reals.ctypes.data
        )
    with pytest.raises(AssertionError):
        laid_out(VALUE._replace(reals=np.zeros((2, 1))), OUTER)


def test_an_empty_value_has_all_fields():
    value, words, fresh = laid_out(empty(OUTER), OUTER)
    assert (
        value.count == 0 and value.lanes.shape == (0, 8) and value.table.shape == (0, 0)
    )
    assert len(words) == OUTER.size == 20 and len(fresh) == 1


@called
def square(x):
    return x * x + 1.0


def twice(x):
    return 2.0 * square(x)


def test_parts_are_compiled_with_their_callers():
    one, other = translated(square), translated(twice)

    @numba.njit
    def total(x):
        return other(x) - one(3.0 * x)

    assert total(2.0) == twice(2.0) - square(6.0) == 10.0 - 37.0
    for part in (one, other):
        (made,) = part.overloads.values()
        assert isinstance(made.library, PartLibrary)
        assert made.library.get_pointer_to_function(made.fndesc.llvm_func_name) == 0
