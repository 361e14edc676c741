"""Bundled robots, mutated: each ends in an error of fflin or in a model that `check` confirms."""

import math
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import fflin

ROBOTS = Path(__file__).parents[3] / "robots"

VALUES = (
    *(
        "",
        " ",
        "nan",
        "inf",
        "-inf",
        "1e999",
        "2,0",
        "2kg",
        "0x2",
        "1e40",
        "-1",
        "0",
        "1e-300",
    ),
    *(
        "0 0",
        "0 0 0",
        "0 0 0 0",
        "1 0 0",
        "0,0,1",
        "0 0 1e200",
        "1e-9 0 0",
        "\u0663",
        "a" * 5000,
    ),
    *(
        "base",
        "root_joint",
        "universe",
        "world",
        "link_1",
        "joint_1",
        "tool",
        "\U0001f916",
        "&<>",
    ),
)
TYPES = (
    "fixed",
    "revolute",
    "continuous",
    "prismatic",
    "planar",
    "floating",
    "spherical",
    "x",
)
TAGS = (
    *(
        "robot",
        "link",
        "joint",
        "inertial",
        "mass",
        "inertia",
        "origin",
        "axis",
        "parent",
        "child",
    ),
    *("limit", "dynamics", "mimic", "Link", "x", "visual", "gazebo"),
)
# Beyond 1e4 between neighbours M is ill-conditioned, which is not the reader's to judge.
SCALES = (0.0, -1.0, 1e-3, 0.5, 2.0, 1e3, 1e40)

position = st.integers(0, 10_000)
mutation = st.tuples(
    st.sampled_from(
        (
            *("drop", "duplicate", "move", "tag", "mimic"),
            *(
                "drop attribute",
                "copy attribute",
                "value",
                "type",
                "scale",
                "rename",
                "swap ends",
            ),
        )
    ),
    position,
    position,
    position,
)


def mutate(root: ET.Element, kind: str, i: int, j: int, k: int) -> None:
    """Change one thing; i picks an element, j another, k an attribute or a value."""
    parents = {child: parent for parent in root.iter() for child in parent}
    if not parents:
        return
    # What lies in visuals is ignored, so it is picked seldom.
    elements = [e for e in parents if i % 10 == 0 or not _ignored(e, parents)] or list(
        parents
    )
    element, other = elements[i % len(elements)], elements[j % len(elements)]
    attributes = sorted(element.attrib)
    attribute = attributes[k % len(attributes)] if attributes else "name"
    if kind == "drop":
        parents[element].remove(element)
    elif kind == "duplicate":
        parents[element].insert(j % 20, element)
    elif kind == "move":
        if element not in set(other.iter()) and other not in set(element.iter()):
            parents[element].remove(element)
            other.append(element)
    elif kind == "tag":
        element.tag = TAGS[j % len(TAGS)]
    elif kind == "mimic":
        joints = root.findall("joint")
        if joints:
            leader = joints[j % len(joints)].get("name", "")
            ET.SubElement(joints[i % len(joints)], "mimic", joint=leader)
    elif kind == "drop attribute":
        element.attrib.pop(attribute, None)
    elif kind == "copy attribute":
        element.set(
            attribute, other.get(attribute, next(iter(other.attrib.values()), ""))
        )
    elif kind == "value":
        element.set(attribute, VALUES[j % len(VALUES)])
    elif kind == "type":
        joints = root.findall("joint")
        if joints:
            joints[i % len(joints)].set("type", TYPES[j % len(TYPES)])
    elif kind == "scale":
        try:
            numbers = [float(text) for text in element.get(attribute, "").split()]
        except ValueError:
            return
        element.set(
            attribute, " ".join(repr(x * SCALES[j % len(SCALES)]) for x in numbers)
        )
    elif kind == "rename":
        names = [e for e in root if "name" in e.attrib]
        if names:
            names[i % len(names)].set(
                "name", names[j % len(names)].get("name", "") + "x" * (k % 2)
            )
    elif kind == "swap ends":
        for joint in root.findall("joint")[i % 8 : i % 8 + 1]:
            ends = joint.find("parent"), joint.find("child")
            if None not in ends:
                ends[0].tag, ends[1].tag = "child", "parent"


def _ignored(element: ET.Element, parents: dict[ET.Element, ET.Element]) -> bool:
    while element in parents:
        if element.tag in ("visual", "collision", "material"):
            return True
        element = parents[element]
    return False


def _mass(root: ET.Element) -> float:
    return math.fsum(
        float(m.get("value", "nan")) for m in root.findall("link/inertial/mass")
    )


@pytest.mark.fuzz
@pytest.mark.parametrize(
    "path", sorted(ROBOTS.glob("*.urdf")), ids=lambda path: path.stem
)
@settings(
    max_examples=150,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
@given(mutations=st.lists(mutation, min_size=1, max_size=3))
def test_mutated(path, mutations, tmp_path, capfd):
    root = ET.parse(path).getroot()
    for change in mutations:
        mutate(root, *change)
    mutated = tmp_path / "mutated.urdf"
    mutated.write_bytes(ET.tostring(root))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", fflin.FflinWarning)
            robot = fflin.load(mutated)
    except fflin.FflinError as error:
        assert "\n" not in str(error)
        if isinstance(error, fflin.UrdfError):
            assert str(error).startswith(f"{mutated}:")
    else:
        # Nothing was passed over: all joints that move are there, and all mass.
        moving = [
            j.get("name") for j in root.findall("joint") if j.get("type") != "fixed"
        ]
        followers = [follower.joint.name for follower in robot.followers]
        assert sorted([*robot.joint_names, *followers]) == sorted(moving)
        assert math.isclose(robot.mass, _mass(root), rel_tol=1e-12)
        try:
            result = fflin.check(robot, fflin.linearize(robot))
        except fflin.SingularInertiaError:
            pass
        else:
            assert result.ok, str(result)
    assert capfd.readouterr() == ("", "")
