"""Arguments of the kernel: named tuples of arrays, such as the kinematic tree of a robot.

numba compiles a function again for each new set of argument types, and passes a named tuple as many
separate arrays. To avoid repeated compilation and many arguments, the functions of `kernel.loop`
receive one array of 64-bit words in place of a named tuple. In compiled code, a `Struct` is a
pointer into the array of words. Each use of a field reads the field from the array. So the argument
types are always the same, and a call within compiled code passes one pointer. The words must not
change during a call.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from fflin.base.validation import Array
from fflin.dynamics.coordinates import PIN_ANGULAR, PIN_LINEAR
from fflin.dynamics.integrals import screw_of
from fflin.dynamics.state import Actuation, StateMap
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot

LANES = 8  # number of points or runs that compiled code computes at a time


def address_of(array: NDArray[np.generic]) -> int:
    """Return the address of the first entry of an array in memory."""
    address: int = array.__array_interface__["data"][0]
    return address


def work_space(size: int, lanes: int = LANES) -> Array:
    """Return an uninitialised array (size, lanes)."""
    space = np.empty(size * lanes + LANES)
    # An entry with eight lanes consists of eight doubles, which have 64 bytes. Access is faster if
    # the address of each entry is a multiple of 64 bytes.
    first = -(address_of(space) // 8) % LANES
    return space[first : first + size * lanes].reshape(size, lanes)


class Kind(NamedTuple):
    """Type of a field: a number if `axes` is 0, else a C-contiguous array with `axes` axes.

    If `lanes` is not 0, the array has a further axis of this length in Python.
    """

    dtype: type[np.generic]
    axes: int = 0
    lanes: int = 0


WHOLE, REAL, FLAG = Kind(np.intp), Kind(np.float64), Kind(np.bool_)
INDICES, REALS, FLAGS = Kind(np.intp, 1), Kind(np.float64, 1), Kind(np.bool_, 1)
# Array of doubles with one column per lane. Compiled code sees a single lane as an array of
# numbers, which has one axis.
LANED = Kind(np.float64, 2, LANES)
ONE_LANE = Kind(np.float64, 1, 1)

T_co = TypeVar("T_co", bound=NamedTuple, covariant=True)
T = TypeVar("T", bound=NamedTuple)


class Struct(Generic[T_co]):
    """Kind of each field in a named tuple of kernel arguments.

    `made` is the class of the named tuple. The keyword arguments `others` are {field: kind}. The
    entries of `groups` are {kind: names of fields, separated by spaces}. All other fields have the
    kind `rest`.
    """

    def __init__(
        self,
        made: type[T_co],
        rest: Kind = REALS,
        groups: Mapping[Kind, str] | None = None,
        /,
        **others: Kind | Struct[NamedTuple],
    ) -> None:
        for kind, fields in (groups or {}).items():
            others |= dict.fromkeys(fields.split(), kind)
        self.made = made
        self.kinds = {field: others.get(field, rest) for field in made._fields}
        sizes = [
            k.size if isinstance(k, Struct) else 1 + k.axes for k in self.kinds.values()
        ]
        ends = np.cumsum([0, *sizes]).tolist()
        self.places = dict(zip(self.kinds, ends, strict=False))
        self.size: int = ends[-1]
        self.name = f"Struct({made.__name__})"

    def with_one_lane(self) -> Struct[T_co]:
        """Return the struct for a single lane, which is the same struct if no array has lanes."""
        kinds: dict[str, Kind | Struct[NamedTuple]] = {}
        for field, kind in self.kinds.items():
            if isinstance(kind, Struct):
                kinds[field] = kind.with_one_lane()
            elif kind == LANED:
                kinds[field] = ONE_LANE
            else:
                kinds[field] = kind
        if kinds == self.kinds:
            return self
        struct = Struct(self.made, **kinds)
        # numba compares types by name, so the name must differ from the name of `self`.
        struct.name = f"Struct({self.made.__name__}, one lane)"
        return struct

    def __call__(self, words: T) -> T:
        """Return a named tuple unchanged. In compiled code, `opener` replaces this method."""
        return words


@cache
def empty(kind: Struct[T]) -> T:
    """Return a named tuple with the fields of a struct: empty arrays, and 0 for each number."""
    parts: list[object] = []
    for field_kind in kind.kinds.values():
        if isinstance(field_kind, Struct):
            parts.append(empty(field_kind))
        elif field_kind.axes:
            no_entries = (0,) * field_kind.axes
            parts.append(np.zeros(no_entries, field_kind.dtype))
        else:
            parts.append(0)
    return kind.made._make(parts)


def laid_out(
    value: T, kind: Struct[T]
) -> tuple[T, NDArray[np.int64], list[tuple[Array, Array]]]:
    """Convert the fields of a named tuple to the kinds that the struct `kind` requires.

    Return the converted tuple, the words of the tuple, and one pair for each array with lanes. A
    pair consists of the array, and of the column of values that every lane contains at first. The
    words contain the addresses of the converted arrays. So the converted tuple must exist as long
    as the words are used.
    """
    words, fresh = list[int](), list[tuple[Array, Array]]()
    return _lay_out(value, kind, words, fresh), np.array(words, dtype=np.int64), fresh


def _lay_out(
    value: T, kind: Struct[T], words: list[int], fresh: list[tuple[Array, Array]]
) -> T:
    """Return the converted tuple of `laid_out`, and append to the lists `words` and `fresh`.

    The words of the tuple are appended to `words`. One pair for each array with lanes is appended
    to `fresh`.
    """
    parts: list[object] = []
    for part, field_kind in zip(value, kind.kinds.values(), strict=True):
        if isinstance(field_kind, Struct):
            parts.append(_lay_out(part, field_kind, words, fresh))
        elif field_kind.axes:
            array = np.ascontiguousarray(part, field_kind.dtype)
            if field_kind.lanes:
                column = array.reshape(-1, 1).copy()
                array = work_space(len(array), field_kind.lanes)
                array[:] = column
                fresh.append((array, column))
            else:
                assert array.ndim == field_kind.axes
            parts.append(array)
            words += (address_of(array), *array.shape[: field_kind.axes])
        else:
            number = field_kind.dtype(part).item()
            parts.append(number)
            words.append(
                int(np.float64(number).view(np.int64))
                if field_kind == REAL
                else int(number)
            )
    return value._make(parts)


# PLACE is the number of entries of a body's pose: x axis, y axis, z axis, and origin relative to
# the parent's origin. INERTIA is the number of entries of a body's inertia: m, m c, and I as xx xy
# xz yy yz zz.
PLACE, INERTIA = 12, 10
# MOTION is the number of entries for a body's motion. LOAD is the number of entries for the forces
# and momenta of the body's subtree. The offsets of the entries are in `kernel.bodies`.
MOTION, LOAD = 30, 27
# FIELD is the number of entries of a body for the gravity gradient: the position of its joint
# relative to the base's origin, and the moment and force on its subtree.
FIELD = 9


class WorkOffsets(
    namedtuple(
        "WorkOffsets",
        "places body_inertias subtree_inertias packed scaled diagonal square motion load bias "
        "c columns lower block field size",
    )
):
    """Offsets of the arrays in the work space of a tree. `size` is the size of the work space.

    - `places`, `body_inertias`, `subtree_inertias`: pose of each body, inertia of each body, and
      inertia of the subtree of each body.
    - `motion`, `load`: motion vectors of each body, and forces and momenta of its subtree.
    - `packed`, `scaled`: M and its factors, packed as in `kernel.bodies`.
    - `diagonal` (6 + n,): the diagonal of M. `square` (6 + n, 6 + n): the inverse of M.
    - `bias`, `c` (6 + n,): the bias forces and the accelerations.
    - `columns` (6 + n, number of body-fixed inputs): the columns of B_u of body-fixed inputs.
    - `lower` (6 + n, 12 + 2 n): the matrix of `kernel.derivatives.differentiate`. `block` (6 + n,
      6): a copy of six of its columns.
    - `field`: positions and forces of `kernel.orbit.add_gradient`; empty without an orbit.
    """


class Tree(
    namedtuple(
        "Tree",
        "parent fixed index unbounded turns slides bodies axes coordinate factor armature "
        "target share row depth path common driven wrench_body wrench input magnetic stored_body "
        "stored stiffness damping offsets",
    )
):
    """Kinematic tree of a robot, with inputs, stored momenta, springs and dampers.

    Body 0 is the base, which has the coordinates 0 to 5. Every other body has one joint, which
    connects the body to its parent. Bodies are in Pinocchio's order, and coordinates are in the
    order of nu. In the compiled code of `kernel.loop`, the fields `fixed`, `bodies`, `wrench`,
    `stored`, `stiffness` and `damping` have one column per lane.

    Fields with one value or row per body:

    - `parent`: index of the parent body.
    - `fixed` (12): pose of the joint frame relative to the parent's joint frame, if the joint
      position is zero. The pose consists of the three columns of the rotation, and of the origin.
      The z axis of the joint frame is along the joint axis.
    - `index`: index of the joint position in q. `unbounded`: False if q contains the joint position
      at `index`. True if q contains the cosine of the joint angle at `index`, and the sine at
      `index` + 1.
    - `turns`, `slides`: rotation about z and translation along z per unit of the joint position.
    - `bodies` (10): the mass m, the first moment m c with the centre of mass c, and the inertia
      about the joint's origin as xx xy xz yy yz zz.
    - `axes` (3, 3): rotation from the joint frame to Pinocchio's joint frame.
    - `coordinate`: the coordinate that moves the joint. `factor`: the joint motion per unit of the
      coordinate.

    Fields for M, whose rows are packed as in `kernel.bodies`:

    - `armature` (6 + n,): the inertia of rotors, which is added to the diagonal of M.
    - `row` (6 + n,): the offset of each row. `depth` (6 + n,): the number of entries before the
      diagonal in each row.
    - `path`: the column of each entry.
    - `common` (6 + n, 6 + n): for each pair of rows, the number of columns that both rows have.
    - `target`, `share`: the contributions of the bodies to M, from the last body to the first. A
      body forms a pair with itself, and with each body on the path to the base. Each pair
      contributes to one entry of M: `target` is the index of the entry, and `share` is the factor
      of the contribution. After the pairs of each body, both fields have one further value for the
      six entries of M that couple the body's coordinate to the base. Here `target` is the index of
      the first entry, and `share` is the factor of all six entries.

    Fields for the forces:

    - `driven`: the coordinate that each input drives, -1 for a body-fixed wrench.
    - `wrench_body`: the body of each body-fixed input. `wrench`: the wrench per unit of the input,
      about the body's joint and in joint axes. `input`: the index of the body-fixed input among all
      inputs. `magnetic`: True for a magnetorquer, whose axis replaces the moment in `wrench`.
    - `stored_body`: the bodies with a stored momentum. `stored`: the stored momenta in joint axes.
    - `stiffness`, `damping` (n,): the springs and dampers of the joints.

    `offsets` are the `WorkOffsets` of the tree.
    """


_OF_TREE = {
    INDICES: "parent index coordinate target row depth path driven wrench_body input stored_body",
    LANED: "fixed bodies wrench stored stiffness damping",
}
_AXES, _COMMON = Kind(np.float64, 3), Kind(np.intp, 2)
WORK_OFFSETS = Struct(WorkOffsets, WHOLE)
TREE = Struct(
    Tree,
    REALS,
    _OF_TREE,
    unbounded=FLAGS,
    magnetic=FLAGS,
    axes=_AXES,
    common=_COMMON,
    offsets=WORK_OFFSETS,
)


@lru_cache(maxsize=16)  # robots do not change
def batch_tree(robot: Robot) -> Tree | None:
    """Return the tree of a robot.

    Return None if a joint is not a screw joint. A screw joint is revolute, prismatic or helical,
    with a constant axis.
    """
    model = robot.model
    joints = model.joints.tolist()[ROOT:]
    screws = [screw_of(model, joint) for joint in joints[1:]]
    if None in screws:
        return None
    places, turns, slides = zip((pin.SE3.Identity(), 0.0, 0.0), *screws, strict=True)
    bodies = len(joints)
    parent = [max(0, model.parents[ROOT + body] - ROOT) for body in range(bodies)]
    fixed, inertias = _body_parameters(model, parent, places)
    axes = np.array([place.rotation for place in places])
    state = StateMap(robot)
    size = 6 + robot.n
    # In v = S nu, the row of S for a joint has one nonzero entry: the joint motion per unit of the
    # coordinate that moves the joint.
    S = state.spread(np.eye(size)).T
    of_v = [joint.idx_v for joint in joints]
    coordinate = np.abs(S).argmax(axis=1)[of_v].tolist()
    factor = S[of_v, coordinate].tolist()
    paths = _paths(size, parent, coordinate)
    row = np.cumsum([0, *map(len, paths[:-1])])
    target, share = _contributions(parent, coordinate, factor, paths, row)
    # For each pair of paths, count the coordinates that both paths contain.
    common = np.array([[len({*one} & {*other}) for other in paths] for one in paths])
    actuation = Actuation(state)
    driven = np.abs(actuation.fixed).argmax(axis=0)
    driven = np.where(actuation.fixed.any(axis=0), driven, -1)
    wrench_body, inputs, wrench = _wrenches(actuation, axes)
    stored_body = [joint - ROOT for joint, _ in robot.stored_momentum]
    stored = [axes[joint - ROOT].T @ h for joint, h in robot.stored_momentum]
    return Tree(
        parent=np.array(parent),
        fixed=fixed.ravel(),
        index=np.array([joint.idx_q for joint in joints]),
        unbounded=np.array([joint.nq == 2 for joint in joints]),
        turns=np.array(turns),
        slides=np.array(slides),
        bodies=inertias.ravel(),
        axes=axes,
        coordinate=np.array(coordinate),
        factor=np.array(factor),
        armature=S.T**2 @ model.armature,
        target=np.array(target, dtype=np.intp),
        share=np.array(share, dtype=float),
        row=row,
        depth=np.array([len(path) - 1 for path in paths]),
        path=np.array([index for path in paths for index in path]),
        common=common,
        driven=driven,
        wrench_body=np.array(wrench_body, dtype=np.intp),
        wrench=np.array(wrench).ravel(),
        input=np.array(inputs, dtype=np.intp),
        magnetic=np.isin(inputs, [index for _, index, _ in actuation.torquers]),
        stored_body=np.array(stored_body, dtype=np.intp),
        stored=np.array(stored).ravel(),
        stiffness=np.array(robot.springs.stiffness),
        damping=np.array(robot.springs.damping),
        offsets=_work_offsets(
            bodies,
            size,
            sum(map(len, paths)),
            len(inputs),
            bodies * FIELD if robot.orbit else 0,
        ),
    )


def _body_parameters(
    model: pin.Model, parent: list[int], places: Sequence[pin.SE3]
) -> tuple[Array, Array]:
    """Return the fields `fixed` (number of bodies, 12) and `bodies` (number of bodies, 10).

    `places` are the poses of the joint frames of the tree relative to Pinocchio's joint frames.
    """
    fixed = np.zeros((len(places), PLACE))
    inertias = np.zeros((len(places), INERTIA))
    for body, place in enumerate(places):
        placement = model.jointPlacements[ROOT + body] * place
        placement = places[parent[body]].inverse() * placement
        fixed[body, :9] = placement.rotation.ravel("F")
        fixed[body, 9:] = placement.translation
        # Pinocchio's order is m, m c, and I as xx xy yy xz yz zz.
        dynamic = place.actInv(model.inertias[ROOT + body]).toDynamicParameters()
        inertias[body] = dynamic[[0, 1, 2, 3, 4, 5, 7, 6, 8, 9]]
    return fixed, inertias


def _contributions(
    parent: list[int],
    coordinate: list[int],
    factor: list[float],
    paths: list[list[int]],
    row: NDArray[np.intp],
) -> tuple[list[int], list[float]]:
    """Return the fields `target` and `share` of `Tree`: the contributions of the bodies to M.

    `paths[i]` contains the columns of the entries of M that are packed in row i, and `row[i]` is
    the offset of this row.
    """
    target: list[int] = []
    share: list[float] = []
    for body in range(len(parent) - 1, 0, -1):
        above = body
        while above > 0:
            low, high = sorted((coordinate[body], coordinate[above]))
            target.append(row[high] + paths[high].index(low))
            # With a mimic joint, two bodies on one path can move with the same coordinate. M is
            # symmetric, so this pair contributes to the diagonal entry twice, once in each order.
            # Off the diagonal, the two orders contribute to two entries, of which one is packed.
            twice = 2.0 if low == high and above != body else 1.0
            share.append(twice * factor[body] * factor[above])
            above = parent[above]
        # the six entries that couple the coordinate to the base, which begin each packed row
        target.append(row[coordinate[body]])
        share.append(factor[body])
    return target, share


def _wrenches(
    actuation: Actuation, axes: Array
) -> tuple[list[int], list[int], list[Array]]:
    """Return, for each body-fixed input, its body, its index and its wrench per unit (6,)."""
    wrench_body: list[int] = []
    inputs: list[int] = []
    wrenches: list[Array] = []
    for joint, numbers, columns in actuation.wrench_columns:
        body = joint - ROOT
        to_joint = axes[body].T
        for number, wrench in zip(numbers.tolist(), columns.T, strict=True):
            moment = to_joint @ wrench[PIN_ANGULAR]
            force = to_joint @ wrench[PIN_LINEAR]
            wrench_body.append(body)
            inputs.append(number)
            wrenches.append(np.concatenate((moment, force)))
    for joint, number, axis in actuation.torquers:
        body = joint - ROOT
        wrench_body.append(body)
        inputs.append(number)
        wrenches.append(np.concatenate((axes[body].T @ axis, np.zeros(3))))
    return wrench_body, inputs, wrenches


def _work_offsets(
    bodies: int, size: int, entries: int, fixed: int, of_field: int
) -> WorkOffsets:
    """Return the offsets in the work space, whose arrays follow one another.

    M has `size` rows and `entries` packed entries. `fixed` is the number of body-fixed inputs, and
    `of_field` the number of entries for the gravity gradient.
    """
    places = 0
    body_inertias = places + bodies * PLACE
    subtree_inertias = body_inertias + bodies * INERTIA
    packed = subtree_inertias + bodies * INERTIA
    scaled = packed + entries
    diagonal = scaled + entries
    square = diagonal + size
    motion = square + size * size
    load = motion + bodies * MOTION
    bias = load + bodies * LOAD
    c = bias + size
    columns = c + size
    lower = columns + size * fixed
    block = lower + size * 2 * size
    field = block + size * 6
    return WorkOffsets(
        places=places,
        body_inertias=body_inertias,
        subtree_inertias=subtree_inertias,
        packed=packed,
        scaled=scaled,
        diagonal=diagonal,
        square=square,
        motion=motion,
        load=load,
        bias=bias,
        c=c,
        columns=columns,
        lower=lower,
        block=block,
        field=field,
        size=field + of_field,
    )


def _paths(size: int, parent: list[int], coordinate: list[int]) -> list[list[int]]:
    """Return, for each coordinate, its path from the base in the elimination tree of M = L^T D L.

    Row i of L and row i of L^-1 can be nonzero only in the columns of path i. Path i ends with i.
    """
    # Without mimic joints, path i contains the coordinates of the base and of the joints from the
    # base to joint i. With mimic joints, one coordinate moves several bodies. The ancestors of
    # these bodies may be on different branches. The factorisation of M then makes further entries
    # nonzero. So the coordinates of all ancestors must be on one path, as in Liu's elimination
    # tree.
    reached: list[set[int]] = [
        set(range(index)) if index < 6 else set() for index in range(size)
    ]
    for body in range(1, len(parent)):
        above = body
        while above > 0:
            low, high = sorted((coordinate[body], coordinate[above]))
            if low < high:
                reached[high].add(low)
            above = parent[above]
        reached[coordinate[body]].update(range(6))
    paths: list[list[int]] = [[] for _ in range(size)]
    for index in range(size - 1, 0, -1):
        if reached[index]:
            nearest = max(reached[index])
            reached[nearest] |= reached[index] - {nearest}
    # Each row has an entry for every coordinate on the path to the base, because all entries of
    # L^-1 on the path may be nonzero.
    for index in range(size):
        paths[index] = [*(paths[max(reached[index])] if reached[index] else ()), index]
    return paths
