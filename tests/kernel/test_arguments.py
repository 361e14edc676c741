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
    words_of,
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


def test_every_kind_of_field_is_read_where_it_stands():
    opened = opener(OUTER)

    @numba.njit
    def read(words):
        of = opened(words)
        whole = (of.count, of.table[1, 2], of.indices[1], len(of.inner.values), of.table.shape[1])
        real = (of.reals[1], of.lanes[1, 7], of.inner.share, of.more.share, of.more.values[2])
        return whole, real, (of.on, of.flags[1], of.flags[2])

    value = laid_out(VALUE, OUTER)
    whole, real, flags = read(words_of(value, OUTER))
    assert whole == (-3, 6, 5, 0, 3)
    assert real == (2.0, 8.0, -1e-300, np.inf, 3.0)
    assert flags == (True, False, True)


def test_what_is_written_in_compiled_code_stands_in_the_arrays():
    opened = opener(OUTER)

    @numba.njit
    def write(words):
        of = opened(words)
        of.lanes[0, 3] = of.more.values[0] = 9.0
        of.indices[0] = of.count

    fresh = []
    value = laid_out(VALUE, OUTER, lambda *pair: fresh.append(pair))
    write(words_of(value, OUTER))
    assert value.lanes[0].tolist() == [7.0] * 3 + [9.0] + [7.0] * 4
    assert value.more.values[0] == 9.0 and value.indices[0] == -3
    (array, before), *others = fresh
    assert array is value.lanes and before.tolist() == [[7.0], [8.0]] and not others


def test_arrays_of_another_kind_are_refused():
    value = laid_out(VALUE, OUTER)
    for wrong in (value.reals.astype(np.float32), value.reals[:, None], value.indices):
        with pytest.raises(AssertionError):
            words_of(value._replace(reals=wrong), OUTER)
    with pytest.raises(AssertionError):
        words_of(value._replace(reals=np.zeros(4)[::2]), OUTER)


def test_an_empty_value_has_all_fields():
    value = empty(OUTER)
    assert value.count == 0 and value.lanes.shape == (0, 8) and value.table.shape == (0, 0)
    assert laid_out(value, OUTER) is value and value.inner is value.more
    assert len(words_of(value, OUTER)) == OUTER.size == 20


@called
def square(x):
    return x * x + 1.0


def twice(x):
    return 2.0 * square(x)


def test_parts_are_compiled_with_what_calls_them():
    one, other = translated(square), translated(twice)

    @numba.njit
    def total(x):
        return other(x) - one(3.0 * x)

    assert total(2.0) == twice(2.0) - square(6.0) == 10.0 - 37.0
    for part in (one, other):
        (made,) = part.overloads.values()
        assert isinstance(made.library, PartLibrary)
        assert made.library.get_pointer_to_function(made.fndesc.llvm_func_name) == 0
