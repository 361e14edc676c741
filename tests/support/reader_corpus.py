"""Small robot descriptions, right and wrong, and what the reader is to make of each."""

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ACCEPT, WARN, REFUSE = "accept", "warn", "refuse"

INERTIA = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
INERTIAL = f'<inertial><mass value="1"/>{INERTIA}</inertial>'
AXIS = '<axis xyz="0 0 1"/>'
LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'


@dataclass(frozen=True)
class Case:
    """One entry: words are those that the one line on stderr must hold."""

    name: str
    document: str | bytes | Callable[[Path], Path]
    expected: str
    words: tuple[str, ...]
    suffix: str = ".urdf"


CASES: list[Case] = []


def accept(name, document, suffix=".urdf"):
    CASES.append(Case(name, document, ACCEPT, (), suffix))


def warn(name, document, *words):
    CASES.append(Case(name, document, WARN, words))


def refuse(name, document, *words, suffix=".urdf"):
    CASES.append(Case(name, document, REFUSE, words, suffix))


def robot(*parts, attributes='name="r"'):
    return f"<robot {attributes}>\n" + "\n".join(parts) + "\n</robot>\n"


def link(name, inside=INERTIAL):
    return f'<link name="{name}">{inside}</link>'


def joint(name, parent, child, kind="continuous", inside=AXIS):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{inside}</joint>'


def inertial(mass="1", inertia=INERTIA, origin=""):
    return link("arm", f'<inertial>{origin}<mass value="{mass}"/>{inertia}</inertial>')


def moments(ixx=1, ixy=0, ixz=0, iyy=1, iyz=0, izz=1):
    return f'<inertia ixx="{ixx}" ixy="{ixy}" ixz="{ixz}" iyy="{iyy}" iyz="{iyz}" izz="{izz}"/>'


def arm(*, child=None, kind="revolute", inside=AXIS + LIMIT, more="", **keywords):
    """Build a base with one arm on a joint named "hinge"."""
    parts = (
        link("base"),
        child or link("arm"),
        joint("hinge", "base", "arm", kind, inside),
    )
    return robot(*parts, more, **keywords)


def three(first="", second="", third=""):
    """Build a chain of four links; the arguments stand inside its joints j1, j2, j3."""
    links = [link(name) for name in ("base", "a", "b", "c")]
    ends = (("base", "a"), ("a", "b"), ("b", "c"))
    joints = [
        joint(f"j{k}", *pair, inside=AXIS + inside)
        for k, (pair, inside) in enumerate(
            zip(ends, (first, second, third), strict=True), 1
        )
    ]
    return robot(*links, *joints)


def chain(number, kind):
    links = [link(f"l{k}") for k in range(number)]
    return robot(
        *links, *(joint(f"j{k}", f"l{k}", f"l{k + 1}", kind) for k in range(number - 1))
    )


# --- Numbers -------------------------------------------------------------------------------------

BAD_NUMBERS = {
    "nan": "nan",
    "infinity": "inf",
    "overflow": "1e999",
    "decimal comma": "2,0",
    "unit": "2kg",
    "hexadecimal": "0x2",
    "underscore": "1_000",
    "two points": "1.2.3",
    "two numbers": "1 2",
    "word": "heavy",
    "Fortran exponent": "1d0",
    "fullwidth digit": "２",
    "sign alone": "-",
    "expression": "1+1",
}
for title, text in BAD_NUMBERS.items():
    refuse(
        f"mass: {title}",
        arm(child=inertial(text)),
        ":3:",
        f"'{text}'",
        "link 'arm'",
        "finite",
    )
for entry in ("ixx", "ixy", "izz"):
    refuse(
        f"{entry} nan",
        arm(child=inertial("1", moments(**{entry: "nan"}))),
        ":3:",
        entry,
    )
for attribute in ("damping", "friction"):
    inside = AXIS + f'<dynamics {attribute}="1,5"/>'
    refuse(
        f"{attribute} with comma",
        arm(inside=inside),
        ":4:",
        attribute,
        "'hinge'",
        "'1,5'",
    )
    inside = AXIS + f'<dynamics {attribute}=""/>'
    refuse(
        f"{attribute} empty",
        arm(inside=inside),
        ":4:",
        f"empty '{attribute}'",
        "'hinge'",
    )
for attribute, texts in {
    "lower": ("1,5", "", "nan", "inf", "1e999"),
    "upper": ("1,5", "", "nan", "-inf"),
    "effort": ("1,5", "", "nan", "-inf", "-1"),
    "velocity": ("1,5", "", "nan", "-inf", "-1"),
}.items():
    for text in texts:
        inside = AXIS + f'<limit {attribute}="{text}"/>'
        warn(
            f"{attribute} of '{text}'",
            arm(inside=inside),
            ":4:",
            attribute,
            "'hinge'",
            "lim",
        )
accept(
    "infinite limits",
    arm(
        inside=AXIS
        + '<limit lower="-inf" upper="INF" effort="+inf" velocity="Infinity"/>'
    ),
)
warn(
    "limits in the wrong order",
    arm(inside=AXIS + '<limit lower="1" upper="-1"/>'),
    ":4:",
    "'hinge'",
    "upper",
)
for title, text, words in (
    ("two entries", "1 2", "has 2 entries"),
    ("four entries", "1 2 3 4", "has 4 entries"),
    ("commas", "1,2,3", "commas"),
    ("commas and spaces", "1, 2, 3", "'1,'"),
    ("nan", "0 nan 0", "'nan'"),
    ("empty", "", "empty"),
    ("words", "left of it", "'left'"),
):
    refuse(
        f"xyz: {title}",
        arm(inside=f'{AXIS}<origin xyz="{text}"/>'),
        ":4:",
        words,
        "'hinge'",
    )
    refuse(
        f"rpy: {title}",
        arm(inside=f'{AXIS}<origin rpy="{text}"/>'),
        ":4:",
        words,
        "rpy",
    )
    refuse(
        f"axis: {title}", arm(inside=f'<axis xyz="{text}"/>'), ":4:", words, "<axis>"
    )
refuse(
    "com of two entries",
    arm(child=inertial(origin='<origin xyz="0 0"/>')),
    ":3:",
    "'arm'",
)
refuse("rpy beyond anything", arm(inside=f'{AXIS}<origin rpy="1e40 0 0"/>'), "'hinge'")
refuse(
    "xyz of 1e29",
    arm(inside=f'{AXIS}<origin xyz="0 -1e29 0"/>'),
    ":4:",
    "'hinge'",
    "1e+07 m",
)
refuse(
    "xyz of 1e8",
    arm(inside=f'{AXIS}<origin xyz="1e8 0 0"/>'),
    ":4:",
    "'hinge'",
    "1e+08 m",
)
accept("xyz of 1e7", arm(inside=f'{AXIS}<origin xyz="1e7 0 0"/>'))
refuse(
    "com of 1e29",
    arm(child=inertial(origin='<origin xyz="1e29 0 0"/>')),
    ":3:",
    "'arm'",
    "m;",
)
refuse("mass beyond anything", arm(child=inertial("1e40")), "'arm'")
accept(
    "numbers in every form",
    arm(child=inertial("+1.", moments(".5", "-0", "0e5", "5E-1"))),
)
accept(
    "spaces around numbers",
    arm(inside='<axis xyz="  0\t0\n1 "/>', child=inertial(" 1 ")),
)

# --- Inertias ------------------------------------------------------------------------------------

refuse(
    "inertial without mass",
    arm(child=link("arm", f"<inertial>{INERTIA}</inertial>")),
    "<mass>",
)
refuse(
    "inertial without inertia",
    arm(child=link("arm", '<inertial><mass value="1"/></inertial>')),
    ":3:",
    "<inertia>",
)
refuse(
    "mass without value",
    arm(child=link("arm", f"<inertial><mass/>{INERTIA}</inertial>")),
    "val",
)
refuse(
    "mass as text",
    arm(child=link("arm", f"<inertial><mass>1</mass>{INERTIA}</inertial>")),
    "no 'value'",
)
refuse("mass empty", arm(child=inertial("")), "empty 'value'")
refuse(
    "inertia without iyz",
    arm(child=inertial("1", '<inertia ixx="1" ixy="0" ixz="0" iyy="1" izz="1"/>')),
    "'iyz'",
)
refuse("negative mass", arm(child=inertial("-1")), ":3:", "-1 kg", "0 or more")
refuse(
    "negative mass of the root",
    robot(link("base", INERTIAL.replace('"1"', '"-1"', 1))),
    "'base'",
)
refuse(
    "negative moment", arm(child=inertial("1", moments(izz=-1))), ":3:", "'arm'", "-1"
)
refuse(
    "all moments negative",
    arm(child=inertial("1", moments(-1, 0, 0, -1, 0, -1))),
    "0 or more",
)
refuse(
    "products too large", arm(child=inertial("1", moments(ixy=2))), "'arm'", "principal"
)
refuse(
    "negative moment of a link that is welded to another",
    arm(child=inertial("1", moments(izz=-0.5)), kind="fixed"),
    "'arm'",
    "0 or more",
)
refuse(
    "negative moment without mass",
    arm(child=inertial("0", moments(izz=-1))),
    "0 or more",
)
refuse(
    "two inertial",
    arm(child=link("arm", INERTIAL * 2)),
    "second <inertial>",
    "'arm'",
    "line 3",
)
refuse(
    "two mass",
    arm(
        child=link(
            "arm", f'<inertial><mass value="1"/><mass value="2"/>{INERTIA}</inertial>'
        )
    ),
    "second <mass>",
)
refuse("two inertia", arm(child=inertial("1", INERTIA * 2)), "second <inertia>")
refuse(
    "two origins of an inertial",
    arm(child=inertial(origin="<origin/>" * 2)),
    "second <origin>",
)
refuse(
    "mass outside of inertial",
    arm(child=link("arm", '<mass value="1"/>')),
    "<inertial>",
)
refuse("inertia outside of inertial", arm(child=link("arm", INERTIA)), "<inertial>")
refuse(
    "Inertial in capitals",
    arm(child=link("arm", INERTIAL.replace("inertial", "Inertial"))),
    "mean",
)
refuse(
    "intertial",
    arm(child=link("arm", INERTIAL.replace("inertial", "intertial"))),
    "<inertial>",
)
warn("unit of a mass", arm(child=inertial('1" unit="kg')), ":3:", "'unit'", "<mass>")
refuse("mass misspelt", arm(child=inertial('1" vaule="2')), ":3:", "'vaule'", "<mass>")
warn(
    "triangle inequality", arm(child=inertial("1", moments(izz=3))), "'arm'", "inertia"
)
warn("inertia without mass", arm(child=inertial("0")), "'arm'", "mass")
warn(
    "tiny negative moment of a link that is welded to another",
    arm(
        child=inertial("1e-6", moments("2e-8", "6e-8", 0, "3e-8", 0, "4e-8")),
        kind="fixed",
    ),
    "'arm'",
    "negative",
)
accept(
    "a flat plate in three digits",
    arm(child=inertial("1", moments(0.333, 0, 0, 0.333, 0, 0.6664))),
)
accept("a rod", arm(child=inertial("1", moments(ixx=0))))
accept(
    "a point mass off the axis",
    arm(child=inertial("1", moments(0, 0, 0, 0, 0, 0), '<origin xyz="1 0 0"/>')),
)
warn(
    "rounding for an inertia",
    robot(
        link("a"),
        inertial("1", moments("-1e-20", 0, 0, 0, 0, 0)),
        joint("j", "a", "arm", "fixed"),
    ),
    "'arm'",
    "inertia",
)
refuse(
    "a point mass on the axis",
    arm(child=inertial("1", moments(0, 0, 0, 0, 0, 0))),
    "'hinge'",
    "mass",
)
refuse("massless leaf", arm(child=link("arm", "")), "'hinge'", "mass")
refuse(
    "massless leaf with zeros",
    arm(child=inertial("0", moments(0, 0, 0, 0, 0, 0))),
    "'hinge'",
)
refuse("massless robot", robot(link("base", "")), "the base", "mass")
accept(
    "massless root",
    robot(link("root", ""), link("base"), joint("j", "root", "base", "fixed")),
)
accept(
    "massless link amid a chain",
    robot(
        link("a"),
        link("b", ""),
        link("c"),
        joint("j", "a", "b"),
        joint("k", "b", "c", inside='<axis xyz="1 0 0"/>'),
    ),
)
accept(
    "massless flange",
    arm(more=link("tool", "") + joint("weld", "arm", "tool", "fixed", "")),
)

# --- The document --------------------------------------------------------------------------------

refuse("empty", b"", "no element")
refuse("blank", b" \n\t\n", "no element")
refuse("binary", bytes(range(256)) * 40, "well-formed")
refuse("zeros", bytes(10_000), "well-formed")
refuse("an ELF file", b"\x7fELF\x02\x01\x01" + bytes(500), "well-formed")
refuse("plain text", "A robot with an arm.", ":1:", "well-formed")
refuse("JSON", '{"robot": {}}', "well-formed")
refuse("cut off", arm()[:-30], "well-formed")
refuse("cut off in a tag", arm()[:60], "well-formed")
refuse(
    "end tags crossed",
    "<robot name='r'><link name='a'></robot></link>",
    "mismatched tag",
)
refuse(
    "attribute twice",
    '<robot name="r"><link name="a" name="b"/></robot>',
    "duplicate attribute",
)
refuse(
    "attribute unquoted", "<robot name=r><link name='a'/></robot>", ":1:", "well-formed"
)
refuse("two robots", arm() + arm(), ":7:", "document element")
refuse("text after the robot", arm() + "done", "document element")
refuse("robot in robot", robot(link("base"), robot(link("arm"))), ":3:", "<robot>")
refuse("another root", "<model name='r'><link name='a'/></model>", "<model>", "<robot>")
refuse(
    "SDF", '<sdf version="1.9"><model name="r"><link name="a"/></model></sdf>', "<sdf>"
)
refuse("MJCF", "<mujoco><worldbody/></mujoco>", "<mujoco>")
refuse("entity", '<!DOCTYPE r [<!ENTITY m "1">]>' + arm(child=inertial("&m;")), "entit")
BOMB = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 12))
refuse(
    "entity bomb",
    f'<!DOCTYPE r [<!ENTITY a0 "x">{BOMB}]><robot name="&a11;"/>',
    "entit",
)
refuse(
    "external entity",
    '<!DOCTYPE r [<!ENTITY x SYSTEM "/etc/passwd">]><robot name="&x;"/>',
    "entit",
)
refuse(
    "entity of an external subset",
    '<!DOCTYPE robot SYSTEM "gone.dtd">' + arm(child=inertial("1&m;")),
    "entit",
)
refuse(
    "entity of a parameter",
    "<!DOCTYPE robot [%p;]>" + arm(child=inertial("1&m;")),
    "entit",
)
refuse("document type", "<!DOCTYPE robot>" + arm(), "<!DOCTYPE>")
refuse("undefined entity", arm(child=inertial("&m;")), "undefined entity")
refuse(
    "unknown encoding",
    '<?xml version="1.0" encoding="klingon"?>' + arm(),
    "encoding",
    "UTF-8",
)
refuse(
    "Latin-1 that is said to be UTF-8",
    arm(child=link("arm", INERTIAL), more="<!--\u00e4-->").encode("latin-1"),
    "well-formed",
)
refuse("nested 200 deep", robot(link("base"), "<x>" * 200 + "</x>" * 200), "nested")
refuse("nested 100,000 deep", "<robot>" + "<x>" * 100_000, "nested")
refuse("a million elements", robot("<x/>" * 1_000_000), "elements")
refuse(
    "a million attributes",
    robot(link("a", "<x " + " ".join(f'a{k}=""' for k in range(1_000_000)) + "/>")),
    "longer",
)
accept("name of a megabyte cut short", robot(link("x" * 100_000)))
accept("byte order mark", "\ufeff".encode() + arm().encode())
accept("CRLF", arm().replace("\n", "\r\n").encode())
accept("CR", arm().replace("\n", "\r").encode())
accept("UTF-16", arm().encode("utf-16"))
accept(
    "Latin-1",
    (
        '<?xml version="1.0" encoding="iso-8859-1"?>'
        + arm(child=link("arm"), more="<!--\u00e4-->")
    ).encode("latin-1"),
)
accept(
    "declaration and comments",
    '<?xml version="1.0"?><!-- a --><?pi?>' + arm(more="<!-- b -->"),
)
accept("CDATA and stray text", arm(more="stray <![CDATA[<text>]]>"))
accept("no name", robot(link("base"), attributes=""))
accept("empty name", robot(link("base"), attributes='name=""'))
accept("version 1.2", robot(link("base"), attributes='name="r" version="1.2"'))
accept("one link", robot(link("base")))
accept("apostrophes", arm().replace('"', "'"))

# --- Names ---------------------------------------------------------------------------------------

refuse(
    "link without a name",
    robot(link("base"), f"<link>{INERTIAL}</link>"),
    ":3:",
    "<link>",
    "name",
)
refuse("link of empty name", robot(link("base"), link("")), ":3:", "empty 'name'")
refuse(
    "joint without a name", arm().replace('name="hinge"', ""), ":4:", "<joint>", "name"
)
refuse("two links of one name", arm(more=link("arm")), ":5:", "'arm'", "line 3")
refuse(
    "two joints of one name",
    arm(more=link("b") + joint("hinge", "arm", "b")),
    "second joint",
)
refuse(
    "joint named universe", arm().replace('"hinge"', '"universe"'), "differ", "rename"
)
refuse(
    "a control character as name",
    robot(link("a&#10;b", INERTIAL.replace('"1"', '"-1"', 1))),
    "'a\\nb'",
)
accept("joint named root_joint", arm().replace('"hinge"', '"root_joint"'))
accept("link named root_joint", arm().replace('"arm"', '"root_joint"'))
accept("root link named root_joint", arm().replace('"base"', '"root_joint"'))
accept("link named universe", arm().replace('"arm"', '"universe"'))
accept("root link named world", arm().replace('"base"', '"world"'))
accept("leaf named world", arm().replace('"arm"', '"world"'))
accept("joint and link of one name", arm().replace('"hinge"', '"arm"'))
accept(
    "unicode names", arm().replace('"hinge"', '"Gelenk-\u00fc \u95a2\u7bc0 \U0001f916"')
)
accept("escaped names", arm().replace('"arm"', '"a&lt;&amp;&quot;&apos;&gt;"'))
accept("spaces in names", arm().replace('"hinge"', '" the hinge "'))

# --- The tree ------------------------------------------------------------------------------------

refuse("no links", robot(), ":1:", "no <link>")
refuse("no links but joints", robot(joint("j", "a", "b")), "no <link>")
refuse("unknown parent", robot(link("arm"), joint("j", "bass", "arm")), ":3:", "'bass'")
refuse(
    "unknown child",
    robot(link("base"), link("arm"), joint("j", "base", "amr")),
    ":4:",
    "arm",
)
refuse(
    "no parent",
    robot(link("a"), '<joint name="j" type="fixed"><child link="a"/></joint>'),
    "<parent>",
)
refuse(
    "no child",
    robot(link("a"), '<joint name="j" type="fixed"><parent link="a"/></joint>'),
    "<child>",
)
refuse(
    "parent without link", arm().replace('<parent link="base"/>', "<parent/>"), "'link'"
)
refuse(
    "two parents in one joint",
    arm(inside=AXIS + '<parent link="arm"/>'),
    "second <parent>",
)
refuse(
    "two children in one joint",
    arm(inside=AXIS + '<child link="arm"/>'),
    "second <child>",
)
refuse(
    "two parents of one link",
    robot(
        *map(link, "abc"),
        joint("j", "a", "b"),
        joint("k", "a", "c"),
        joint("l", "b", "c"),
    ),
    ":7:",
    "'c'",
    "'k'",
    "line 6",
)
refuse(
    "two joints on one pair",
    robot(*map(link, "ab"), joint("j", "a", "b"), joint("k", "a", "b")),
    ":5:",
    "'k'",
    "'j'",
)
refuse(
    "a link its own parent",
    arm(more=joint("k", "arm", "arm")),
    "only one parent",
    "'k'",
)
refuse("a detached link", arm(more=link("lost")), ":5:", "2 separate trees", "'lost'")
refuse(
    "a detached arm",
    arm(more=link("x") + link("y") + joint("k", "x", "y")),
    "2 separate trees",
    "'x'",
)
refuse(
    "a detached loop",
    arm(more=link("x") + link("y") + joint("k", "x", "y") + joint("l", "y", "x")),
    "loop",
)
refuse(
    "one loop and no root",
    robot(*map(link, "ab"), joint("j", "a", "b"), joint("k", "b", "a")),
    "loop",
)
refuse(
    "a loop of three",
    robot(
        *map(link, "abc"),
        joint("j", "a", "b"),
        joint("k", "b", "c"),
        joint("l", "c", "a"),
    ),
    "loop",
)
refuse(
    "links in a wrapper",
    robot(link("base"), f"<arms>{link('arm')}</arms>"),
    ":3:",
    "<arms>",
)
refuse(
    "joint in a wrapper",
    robot(link("base"), f"<arms>{joint('j', 'base', 'arm')}</arms>"),
    "<arms>",
)
refuse(
    "joint in a link",
    robot(link("base", INERTIAL + joint("j", "base", "arm"))),
    "<joint>",
)
refuse(
    "Link in capitals",
    robot(link("base"), link("arm").replace("link", "Link")),
    "<Link>",
)
refuse("Joint in capitals", arm().replace("joint", "Joint"), "<Joint>")
refuse("a chain of 10,000 links", chain(10_000, "fixed"), "10000", "1000")
refuse("1,000 joints", chain(999, "continuous"), "998 joints", "GiB")
refuse(
    "20,000 links", robot(*(link(f"l{k}", "") for k in range(20_000))), "20000 links"
)
refuse("317 joints", chain(318, "continuous"), "317 joints", "GiB")
accept("a chain of 900 links", chain(900, "fixed"))
refuse(
    "a world that the base floats in",
    robot(link("world", ""), link("a"), link("b"), joint("j", "a", "b")).replace(
        "</robot>", joint("free", "world", "a", "floating", "") + "</robot>"
    ),
    "'free'",
    "lock",
)
refuse(
    "a world that two bases float in",
    robot(
        link("world", ""),
        *(link(name) + joint(f"{name}_", "world", name, "floating") for name in "ab"),
    ),
    "'a_'",
    "lock",
)
refuse(
    "a floating joint below a link of mass", arm(kind="floating", inside=""), "'hinge'"
)
accept("a joint before its links", robot(joint("j", "a", "b"), link("b"), link("a")))
accept(
    "branches",
    robot(
        *map(link, "abcd"),
        joint("z", "a", "b"),
        joint("y", "a", "c"),
        joint("x", "b", "d"),
    ),
)

# --- Joints --------------------------------------------------------------------------------------

refuse("no type", arm().replace('type="revolute"', ""), ":4:", "'type'", "'hinge'")
for kind in (
    "hinge",
    "Revolute",
    "ball",
    "universal",
    "revolute2",
    "screw",
    "${type}x",
):
    if "$" not in kind:
        refuse(
            f"type {kind}", arm(kind=kind), ":4:", f"'{kind}'", "revolute", "'hinge'"
        )
refuse("type spherical", arm(kind="spherical"), "'spherical'", "revolute")
refuse("type floating", arm(kind="floating"), "'hinge'", "lock")
refuse("type planar", arm(kind="planar"), "'hinge'", "lock")
refuse("axis zero", arm(inside='<axis xyz="0 0 0"/>'), ":4:", "length 0", "'hinge'")
refuse("axis 1e-200", arm(inside='<axis xyz="0 0 1e-200"/>'), "length 1e-200")
refuse("axis 1e20", arm(inside='<axis xyz="0 1e20 0"/>'), "length 1e+20")
refuse("axis without xyz", arm(inside="<axis/>"), "'xyz'")
refuse("axis by rpy", arm(inside='<axis rpy="0 0 1"/>'), "no 'xyz'")
warn(
    "axis with an rpy",
    arm(inside='<axis xyz="0 0 1" rpy="0 0 1"/>'),
    ":4:",
    "'rpy'",
    "<axis>",
)
refuse("two axes", arm(inside=AXIS * 2), "second <axis>", "'hinge'")
refuse("two origins", arm(inside=AXIS + "<origin/>" * 2), "second <origin>")
refuse("two limits", arm(inside=AXIS + LIMIT * 2), "second <limit>")
refuse("two dynamics", arm(inside=AXIS + "<dynamics/>" * 2), "second <dynamics>")
refuse(
    "origin misspelt", arm(inside=AXIS + '<orgin xyz="1 0 0"/>'), "<orgin>", "<origin>"
)
refuse("Axis in capitals", arm(inside='<Axis xyz="0 0 1"/>'), "<Axis>", "<axis>")
refuse("xzy in an origin", arm(inside=AXIS + '<origin xzy="1 0 0"/>'), "'xzy'")
refuse(
    "quaternion as quat",
    arm(inside=AXIS + '<origin quat="0 0 0 1"/>'),
    "'quat'",
    "quat_xyzw",
)
refuse(
    "quaternion as quat_wxyz",
    arm(inside=AXIS + '<origin quat_wxyz="1 0 0 0"/>'),
    "quat_xyzw",
)
refuse(
    "quaternion and rpy",
    arm(inside=AXIS + '<origin rpy="0 0 0" quat_xyzw="0 0 0 1"/>'),
    "both",
)
refuse(
    "quaternion of length 2",
    arm(inside=AXIS + '<origin quat_xyzw="0 0 0 2"/>'),
    "length 2",
)
refuse(
    "quaternion zero", arm(inside=AXIS + '<origin quat_xyzw="0 0 0 0"/>'), "length 0"
)
refuse(
    "quaternion of three",
    arm(inside=AXIS + '<origin quat_xyzw="0 0 1"/>'),
    "has 3 entries",
)
refuse(
    "negative damping",
    arm(inside=AXIS + '<dynamics damping="-1"/>'),
    "damping",
    "0 or more",
)
refuse(
    "negative friction",
    arm(inside=AXIS + '<dynamics friction="-1"/>'),
    "friction",
    "0 or more",
)
warn("damping", arm(inside=AXIS + '<dynamics damping="0.1"/>'), "'hinge'")
warn("friction", arm(inside=AXIS + '<dynamics friction="0.1"/>'), "friction", "'hinge'")
warn(
    "stiffness of a spring",
    arm(inside=AXIS + '<dynamics spring_stiffness="1"/>'),
    ":4:",
    "'spring_stiffness'",
)
accept("damping of zero", arm(inside=AXIS + '<dynamics damping="0" friction="0.0"/>'))
accept("damping of a fixed joint", arm(kind="fixed", inside='<dynamics damping="1"/>'))
for kind in ("revolute", "prismatic", "continuous", "fixed"):
    accept(f"{kind}, nothing inside", arm(kind=kind, inside=""))
    accept(f"{kind}, axis and limit", arm(kind=kind))
accept("limit without effort", arm(inside=AXIS + '<limit lower="-1" upper="1"/>'))
accept("limit without bounds", arm(inside=AXIS + '<limit effort="1" velocity="1"/>'))
accept("limit of nothing", arm(inside=AXIS + "<limit/>"))
accept("axis of length 2", arm(inside='<axis xyz="0 0 -2"/>'))
accept("axis askew", arm(inside='<axis xyz="1 -2 3"/>'))
accept("fixed joint with a zero axis", arm(kind="fixed", inside='<axis xyz="0 0 0"/>'))
accept(
    "fixed joint with a bad limit",
    arm(kind="fixed", inside='<limit lower="" upper="-"/>'),
)
accept("quaternion", arm(inside=AXIS + '<origin xyz="1 0 0" quat_xyzw="0 0.6 0 0.8"/>'))
accept("empty origin", arm(inside=AXIS + "<origin/>"))

# --- Mimic joints --------------------------------------------------------------------------------

refuse("mimic of nothing", three("<mimic/>"), ":6:", "'joint'", "'j1'")
refuse("mimic of an unknown joint", three('<mimic joint="j9"/>'), ":6:", "'j1'", "'j9'")
refuse(
    "mimic of Drake", three("", '<drake:mimic joint="j1"/>'), ":7:", "'j2'", "<mimic>"
)
refuse("mimic of itself", three('<mimic joint="j1"/>'), ":6:", "loop", "'j1'")
refuse(
    "mimics of each other",
    three('<mimic joint="j2"/>', '<mimic joint="j1"/>'),
    "loop",
    "'j2'",
)
refuse(
    "mimics in a circle of three",
    three(*(f'<mimic joint="j{k}"/>' for k in (2, 3, 1))),
    "loop",
    "'j3'",
)
refuse(
    "two mimics in one joint",
    three('<mimic joint="j2"/><mimic joint="j3"/>'),
    "second <mimic>",
)
refuse(
    "mimic of a fixed joint",
    arm(
        inside=AXIS + '<mimic joint="weld"/>',
        more=link("t") + joint("weld", "arm", "t", "fixed"),
    ),
    "'weld'",
    "fixed",
)
refuse(
    "mimic multiplier nan",
    three('<mimic joint="j2" multiplier="nan"/>'),
    "multiplier",
    "'nan'",
)
refuse(
    "mimic offset with unit",
    three('<mimic joint="j2" offset="90deg"/>'),
    "offset",
    "'90deg'",
)
refuse("mimic multipler", three('<mimic joint="j2" multipler="2"/>'), "'multipler'")
accept(
    "mimic of a leader that comes later",
    three('<mimic joint="j3" multiplier="-2" offset="0.1"/>'),
)
accept("mimic of a leader that comes earlier", three("", "", '<mimic joint="j1"/>'))
accept("mimic in a fixed joint", arm(kind="fixed", inside='<mimic joint="nothing"/>'))

# --- Extensions ----------------------------------------------------------------------------------

VISUAL = (
    '<visual><geometry><mesh filename="package://no/where.stl" scale="a b"/>'
    "</geometry></visual>"
)
accept("mesh that is not there", arm(child=link("arm", INERTIAL + VISUAL)))
accept(
    "collision with nonsense",
    arm(child=link("arm", INERTIAL + "<collision><origin xyz='?'/></collision>")),
)
accept("gazebo", arm(more='<gazebo reference="arm"><mu1>0.2</mu1></gazebo>'))
accept(
    "gazebo with names", arm(more=f"<gazebo>{link('x', '')}<joint name='y'/></gazebo>")
)
for wrapper in ("gazebo", "group", "transmission", "ros2_control", "drake:group"):
    both = link("tip") + joint("k", "arm", "tip")
    refuse(
        f"{wrapper} around a link and its joint",
        arm(more=f"<{wrapper}>{both}</{wrapper}>"),
        ":5:",
        "'tip'",
        f"<{wrapper}>",
        "<robot>",
    )
    refuse(
        f"{wrapper} around a joint",
        arm(more=f"<{wrapper}>{joint('k', 'arm', 'tip')}</{wrapper}>"),
        ":5:",
        "'k'",
    )
accept(
    "transmission",
    arm(more='<transmission name="t"><joint name="hinge"/></transmission>'),
)
accept(
    "ros2_control",
    arm(
        more='<ros2_control name="c"><joint name="hinge"><param>1</param></joint></ros2_control>'
    ),
)
accept("unbound prefix", arm(more='<drake:proximity_properties drake:x="1"/>'))
accept("prefixed attribute", arm(inside=AXIS + '<origin xyz="0 0 1" drake:note="1"/>'))
accept(
    "unknown elements",
    arm(
        child=link("arm", INERTIAL + "<contact/><self_filter/>"), more="<sensor/><foo/>"
    ),
)
accept(
    "unknown attributes",
    arm(attributes='name="r" foo="1"').replace("<link ", '<link type="x" '),
)
accept("materials", arm(more='<material name="m"><color rgba="x"/></material>' * 2))
accept(
    "safety and calibration",
    arm(inside=AXIS + '<safety_controller k="?"/><calibration rising="?"/>'),
)
accept(
    "xacro merely declared",
    arm(attributes='name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"'),
)
accept(
    "dollar in a mesh", arm(child=link("arm", INERTIAL + VISUAL.replace("no", "${no}")))
)
for place in ("material", "plugin", "sensor", "gazebo"):
    accept(
        f"dollar in a {place}",
        arm(more=f'<{place} name="${{x}}"><a b="$(find y)"/></{place}>'),
    )
for place in ("safety_controller", "calibration"):
    accept(f"dollar in a {place}", arm(inside=AXIS + f'<{place} a="${{x}}"/>'))
accept("dollar in a comment", arm(more="<!-- ${mass} <xacro:if/> -->"))

# --- Xacro ---------------------------------------------------------------------------------------

XACRO = 'name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"'
MACRO = (
    f'<xacro:macro name="make" params="m">{inertial("${2 * m}")}</xacro:macro>'
    '<xacro:make m="1"/>'
)
accept("xacro in a URDF", arm(child=MACRO, attributes=XACRO))
accept("xacro file", arm(child=MACRO, attributes=XACRO), ".xacro")
accept("xacro file of plain URDF", arm(), ".urdf.xacro")
accept("property without declaration", arm(child=inertial("${2 + 3}")))
refuse(
    "xacro: unknown property",
    arm(child=inertial("${m}"), attributes=XACRO),
    "xacro",
    "'m'",
)
refuse("xacro: its first use", arm(child=inertial("${m}")), "<mass>", "line 3")
refuse(
    "xacro: unknown macro", arm(child="<xacro:take/>", attributes=XACRO), "xacro:take"
)
refuse(
    "xacro: missing include",
    arm(more='<xacro:include filename="gone.xacro"/>', attributes=XACRO),
    "gone.xacro",
)
refuse(
    "xacro: endless macro",
    arm(
        more='<xacro:macro name="a"><xacro:a/></xacro:macro><xacro:a/>',
        attributes=XACRO,
    ),
    "xacro",
)
refuse(
    "xacro: error after expansion",
    arm(child=MACRO.replace("2 * m", "-m"), attributes=XACRO),
    "xacro",
    "-1 kg",
)
refuse(
    "xacro: bad expression",
    arm(child=inertial("${1/0}"), attributes=XACRO),
    "xacro",
    "division",
)
refuse("xacro: not well-formed", "<robot><xacro:", "well-formed", suffix=".xacro")

# --- What is no file -----------------------------------------------------------------------------


def _no_text(path):
    path = path.with_name(os.fsdecode(b"\xff.urdf"))
    path.write_text(arm(attributes=""))
    return path


def _fifo(path):
    os.mkfifo(path)
    return path


def _sparse(path):
    path.touch()
    os.truncate(path, 3 * 10**9)
    return path


def _folder(path):
    path.mkdir()
    return path


def _unreadable(path):
    path.write_text(arm())
    path.chmod(0)
    return path


def _dangling(path):
    path.symlink_to(path.with_name("nowhere"))
    return path


def _looping(path):
    path.symlink_to(path)
    return path


refuse(
    "a name that is too long",
    lambda path: path.with_name("x" * 5000 + ".urdf"),
    "no file",
)
if sys.platform == "linux":
    accept("a file name that is no text", _no_text)
refuse("a missing file", lambda path: path, "no file")
refuse("a folder", _folder, "folder")
refuse("a dangling link", _dangling, "no file")
if sys.platform != "win32":
    refuse("a pipe", _fifo, "regular")
    refuse("/dev/zero", lambda _: Path("/dev/zero"), "regular")
    refuse("/dev/null", lambda _: Path("/dev/null"), "regular")
    refuse("a sparse file of 3 GB", _sparse, "64 MiB")
    refuse("a symbolic link to itself", _looping, "")
    if os.geteuid() != 0:
        refuse("no permission", _unreadable, "ermission")  # root may read it
