"""A quadrotor with an arm of two joints, written as URDF and inputs."""

import math

import fflin

K = 0.016  # [m] reaction torque for each newton of thrust
REACH = 0.2  # [m] from the centre to each rotor
MASS, INERTIA = 1.0, (0.01, 0.01, 0.02)
GRAVITY = (0.0, 0.0, -9.81)
PLACES = ((REACH, 0.0), (0.0, REACH), (-REACH, 0.0), (0.0, -REACH))
SIGNS = (-1.0, 1.0, -1.0, 1.0)

BODY = """<robot name="quad">
  <link name="base"><inertial><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
  ARM
</robot>"""

LINK = """<link name="LINK"><inertial><origin xyz="0 0 -0.1"/><mass value="0.1"/>
    <inertia ixx="4e-4" iyy="4e-4" izz="2e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="JOINT" type="revolute"><parent link="PARENT"/><child link="LINK"/>
    <origin xyz="0 0 PLACE"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="1.0" velocity="5"/></joint>
  """

ROTORS = [
    fflin.Thruster(
        "base", (x, y, 0.0), (0, 0, 1), f"rotor_{k + 1}", max=6.0, torque=K * sign
    )
    for k, ((x, y), sign) in enumerate(zip(PLACES, SIGNS, strict=True))
]


def quadrotor(folder, arm=True, **fields):
    """The robot in a folder, under gravity, with or without its arm."""
    links = [
        ("upper", "shoulder", "base", "-0.05"),
        ("lower", "elbow", "upper", "-0.2"),
    ]
    text = ""
    for link, joint, parent, place in links if arm else ():
        part = LINK.replace("LINK", link).replace("JOINT", joint)
        text += part.replace("PARENT", parent).replace("PLACE", place)
    path = folder / "quad.urdf"
    path.write_text(BODY.replace("ARM", text))
    inputs = [*ROTORS, fflin.JointTorque("*")] if arm else ROTORS
    return fflin.load(path, gravity=GRAVITY, inputs=inputs, **fields)


def canted(degrees):
    """Rotors without reaction torque, each inclined about its arm, so that they produce yaw."""
    rotors = []
    for k, ((x, y), sign) in enumerate(zip(PLACES, SIGNS, strict=True)):
        across = math.tan(math.radians(degrees)) * sign / REACH
        along = (-y * across, x * across, 1.0)
        rotors.append(
            fflin.Thruster("base", (x, y, 0.0), along, f"rotor_{k + 1}", max=6.0)
        )
    return [*rotors, fflin.JointTorque("*")]
