"""The Franka Panda arm on a table, with a rod or with its gripper: what every task builds on.

The arm's description and meshes are the files of the installed gymnasium-robotics package (Farama
Foundation, MIT; the robot files are marked Apache-2.0 there). They are only read: the package is
never imported. Gains, filters and solver options below were measured for set-points that move at up
to 0.36 m/s.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import mujoco

Mesh = Literal["col", "viz"]

PHYSICS_DT = 0.0025  # s per physics step
PHYSICS_STEPS = 14  # physics steps per control step
CONTROL_DT = PHYSICS_DT * PHYSICS_STEPS  # 35 ms = 28.57 Hz, as D3IL

# Joint positions (rad) with the rod straight down and its tip at (0.5, 0, 0.03) m: the posture that
# redundancy is resolved towards. Joints 6 and 7 of these files are pi/2 and pi/4 off the real
# arm's.
HOME_QPOS = (0.0, 0.223, 0.0, -2.401, 0.0, 1.054, 0.0)

ARM_JOINTS = 7
# rad; what the files allow, less 0.01 so that servos do not press against the stops.
JOINT_LOW = (-2.887, -1.752, -2.887, -3.061, -2.887, -1.647, -2.887)
JOINT_HIGH = (2.887, 1.752, 2.887, -0.410, 2.887, 2.102, 2.887)
TOOL_BODY = "panda0_link7"
FRONT_CAMERA, HAND_CAMERA = "front", "hand"  # D3IL's two views
TOOL_SITE = "tool"  # the end effector: the tip of the rod, the middle between the finger pads
ROD_GEOM = "rod"
TABLE_GEOM = "table"
CONTACT_SENSOR = "rod_contact"
ROD_RADIUS = 0.01  # m, as D3IL
ROD_TIP = 0.30  # m from the tool body along its axis

# The same for the gripper, straight down at (0.5, 0, 0.12) m.
GRIPPER_HOME_QPOS = (0.0, 0.144, 0.0, -2.397, 0.0, 0.972, 0.0)
MAX_OPENING = 0.08  # m between the pads
FINGER_JOINTS = 2
FINGERS = ("panda0_leftfinger", "panda0_rightfinger")
PAD_HALF = (0.010, 0.0075, 0.014)  # m, half lengths of the box that stands for a finger's pad
PAD_HEIGHT = 0.078  # m from the finger's frame to the middle of its pad
TOOL_FRAME = 0.1654  # m from the tool body to the fingers' frames
# The hand is mounted turned by 45 degrees; this quaternion turns the tool's frame with it, so that
# the fingers close along its y.
HAND_QUAT = (0.92388, 0.0, 0.0, -0.382683)

TOOL_BIT = 2  # contact bits: rod and table carry 2, objects carry 1 and meet both
OBJECT_BIT = 1

_STIFFNESS = (4500.0, 4500.0, 3500.0, 3500.0, 2000.0, 2000.0, 2000.0)  # N m / rad
_DAMPING = (225.0, 225.0, 175.0, 175.0, 100.0, 100.0, 100.0)  # N m s / rad
_MAX_TORQUE = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)  # N m, the real arm's limits
_FINGER_STIFFNESS = 1000.0  # N / m
_FINGER_DAMPING = 50.0  # N s / m
_FINGER_MAX_FORCE = 40.0  # N
_PAD_FRICTION = (1.0, 0.02, 0.0005)  # sliding; m of torsion and of rolling


def panda_files() -> Path:
    """Folder of the Panda's MuJoCo files.

    Raises FileNotFoundError when gymnasium-robotics is not installed.
    """
    found = importlib.util.find_spec("gymnasium_robotics")
    if found is None or found.origin is None:
        raise FileNotFoundError(
            "the Panda arm's files come with gymnasium-robotics, which is not installed"
        )
    folder = Path(found.origin).parent / "envs/assets/kitchen_franka/franka_assets"
    if not (folder / "chain.xml").is_file():
        raise FileNotFoundError(f"gymnasium-robotics is installed, but {folder} has no chain.xml")
    return folder


def rod_scene(mesh: Mesh = "col", *, rod_radius: float = ROD_RADIUS) -> mujoco.MjSpec:
    """A table and the Panda with a rod, ready for a task to add its objects.

    mesh        "col": low-poly arm (2,300 faces), fast to draw; "viz": detailed arm (134,000
                faces). The physics are the same.
    rod_radius  m; the rod's length is the same for all
    """
    spec = _arm_scene(mesh)
    for name in FINGERS:
        spec.delete(spec.body(name))
    _delete_meshes(spec, lambda name: name.startswith("finger"))
    _add_rod(spec, rod_radius)
    return spec


def gripper_scene(mesh: Mesh = "col") -> mujoco.MjSpec:
    """A table and the Panda with its gripper, ready for a task to add its objects.

    The fingers' joints follow the arm's; each finger's servo takes half of the opening. `mesh` is
    that of `rod_scene`; the fingers' drawing is the same for both.
    """
    spec = _arm_scene(mesh)
    for side, name in zip((1.0, -1.0), FINGERS, strict=True):
        for geom in list(spec.body(name).geoms):
            if geom.type != mujoco.mjtGeom.mjGEOM_MESH:
                spec.delete(geom)
        _add_pad(spec.body(name), side)
    _add_finger_servos(spec)
    spec.body(TOOL_BODY).add_site(
        name=TOOL_SITE,
        pos=[0.0, 0.0, TOOL_FRAME + PAD_HEIGHT],
        quat=HAND_QUAT,
        size=[0.004, 0.0, 0.0],
        group=4,
    )
    return spec


def _arm_scene(mesh: Mesh) -> mujoco.MjSpec:
    """Table, arm and hand with its fingers; no tool yet."""
    folder = panda_files()
    # The meshdir must follow the include, which sets a relative one.
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco model="rodif">
          <include file="{folder}/assets.xml"/>
          <compiler angle="radian" meshdir="{folder}/meshes"/>
          <worldbody><include file="{folder}/chain.xml"/></worldbody>
        </mujoco>"""
    )
    spec.compiler.degree = False
    _set_options(spec)
    _prepare_arm(spec, mesh)
    _add_servos(spec)
    _add_table(spec)
    # In front of the hand, tilted towards the tool's tip.
    spec.body(TOOL_BODY).add_camera(
        name=HAND_CAMERA,
        pos=[0.0636, -0.0636, 0.107],
        quat=[0.1131, 0.9169, 0.3798, 0.0468],
        fovy=70.0,
    )
    return spec


def add_cube(
    spec: mujoco.MjSpec, name: str, *, half: float, mass: float, friction: float, rgba: list[float]
) -> None:
    """A free cube of half edge `half` (m): see `add_block`."""
    sizes = (half, half, half)
    add_block(spec, name, halves=sizes, mass=mass, friction=friction, rgba=rgba)


def add_block(
    spec: mujoco.MjSpec,
    name: str,
    *,
    halves: tuple[float, float, float],
    mass: float,
    friction: float,
    rgba: list[float],
) -> None:
    """A free block of half lengths `halves` (m) and `mass` (kg) that the robot's tool, the table
    and other objects touch; where it starts is the context's business."""
    body = spec.worldbody.add_body(name=name, pos=[0.5, 0.0, halves[2]])
    body.add_freejoint(name=f"{name}_joint")
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=list(halves),
        mass=mass,
        rgba=rgba,
        friction=[friction, 0.005, 0.0001],  # sliding; m of torsion and of rolling
        condim=4,  # torsion too: a cube that is pushed off its centre turns against friction
        contype=OBJECT_BIT,
        conaffinity=OBJECT_BIT | TOOL_BIT,
    )


def _set_options(spec: mujoco.MjSpec) -> None:
    spec.option.timestep = PHYSICS_DT
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    spec.option.impratio = 10.0
    spec.visual.quality.offsamples = 0
    spec.visual.headlight.diffuse = [0.3, 0.3, 0.3]
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]


def _prepare_arm(spec: mujoco.MjSpec, mesh: Mesh) -> None:
    """Keep the wanted meshes, balance gravity, let arm geoms touch nothing."""
    spec.delete(spec.site("end_effector"))
    # The fingers have one mesh for both kinds, and it is called _viz.
    if mesh == "col":
        _delete_meshes(spec, lambda name: name.endswith("_viz") and not name.startswith("finger"))
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
        if mesh == "col":
            geom.group = 0
            geom.rgba = [0.93, 0.94, 0.95, 1.0]
    for body in spec.bodies:
        body.gravcomp = 1.0
    for joint in spec.joints:
        joint.damping = [1.0, 0.0, 0.0]  # linear, quadratic, cubic term
        joint.armature = 0.1


def _delete_meshes(spec: mujoco.MjSpec, unwanted: Callable[[str], bool]) -> None:
    """Delete the meshes with such names, and what is drawn with them."""
    for asset in [asset for asset in spec.meshes if unwanted(asset.name)]:
        for geom in list(spec.geoms):
            if geom.meshname == asset.name:
                spec.delete(geom)
        spec.delete(asset)


def _add_pad(finger: Any, side: float) -> None:
    """One box for the 13 shapes that touch, so that a grasp has one flat, known surface.

    side  1 for the finger that opens along the tool's +y, -1 for the other
    """
    finger.add_geom(
        name=f"{finger.name}_pad",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0.0, side * PAD_HALF[1], PAD_HEIGHT],
        size=list(PAD_HALF),
        mass=0.0,
        rgba=[0.16, 0.18, 0.22, 1.0],
        friction=list(_PAD_FRICTION),
        condim=6,
        solref=[0.01, 1.0],
        priority=1,  # else the block's friction and solver values are mixed in
        contype=TOOL_BIT,
        conaffinity=OBJECT_BIT,
    )


def _add_finger_servos(spec: mujoco.MjSpec) -> None:
    joints = [f"robot:panda0_finger_joint{index}" for index in (1, 2)]
    # The real gripper has one motor: both fingers are always equally far out.
    spec.add_equality(
        name="fingers",
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1=joints[0],
        name2=joints[1],
        data=[0.0, 1.0] + [0.0] * 10,
    )
    for index, joint in enumerate(joints, start=1):
        servo = spec.add_actuator(
            name=f"finger_servo{index}", target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        servo.set_to_position(kp=_FINGER_STIFFNESS, kv=_FINGER_DAMPING)
        servo.forcelimited = True
        servo.forcerange = [-_FINGER_MAX_FORCE, _FINGER_MAX_FORCE]


def _add_rod(spec: mujoco.MjSpec, radius: float) -> None:
    flange = spec.body(TOOL_BODY)
    flange.add_geom(
        name=ROD_GEOM,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[0.0, 0.0, 0.14, 0.0, 0.0, ROD_TIP - radius],
        size=[radius, 0.0, 0.0],
        mass=0.05,
        rgba=[0.16, 0.18, 0.22, 1.0],
        contype=TOOL_BIT,
        conaffinity=OBJECT_BIT,
    )
    # How many contacts the rod has, found in collision detection, so also without any force.
    spec.add_sensor(
        name=CONTACT_SENSOR,
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_GEOM,
        objname=ROD_GEOM,
        intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1],
    )
    flange.add_site(name=TOOL_SITE, pos=[0.0, 0.0, ROD_TIP], size=[0.004, 0.0, 0.0], group=4)


def _add_servos(spec: mujoco.MjSpec) -> None:
    for index, (stiffness, damping, torque) in enumerate(
        zip(_STIFFNESS, _DAMPING, _MAX_TORQUE, strict=True), start=1
    ):
        servo = spec.add_actuator(
            name=f"servo{index}",
            target=f"robot:panda0_joint{index}",
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
        )
        servo.set_to_position(kp=stiffness, kv=damping)
        servo.forcelimited = True
        servo.forcerange = [-torque, torque]


def _add_table(spec: mujoco.MjSpec) -> None:
    spec.worldbody.add_geom(
        name=TABLE_GEOM,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0.35, 0.0, -0.02],
        size=[0.60, 0.60, 0.02],
        rgba=[0.80, 0.78, 0.74, 1.0],
        contype=TOOL_BIT,
        conaffinity=OBJECT_BIT,
    )
    spec.worldbody.add_light(
        pos=[0.3, -0.4, 2.0], dir=[0.1, 0.2, -1.0], diffuse=[0.55, 0.55, 0.55], castshadow=False
    )
    spec.worldbody.add_camera(
        name=FRONT_CAMERA,
        pos=[1.05, 0.0, 1.2],
        quat=[0.683, 0.183, 0.183, 0.683],
        fovy=45.0,  # D3IL's camera
    )
