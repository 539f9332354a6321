"""The Franka Panda arm with a rod, on a table: the scene that every task builds on.

The arm's description and meshes are the files of the installed gymnasium-robotics package (Farama
Foundation, MIT; the robot files are marked Apache-2.0 there). They are only read: the package is
never imported. Gains, filters and solver options below were measured for set-points that move at up
to 0.36 m/s.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Literal

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
TOOL_BODY = "panda0_link7"
TOOL_SITE = "rod_tip"  # the end effector of every task with a rod
ROD_GEOM = "rod"
TABLE_GEOM = "table"
CONTACT_SENSOR = "rod_contact"
ROD_RADIUS = 0.01  # m, as D3IL
ROD_TIP = 0.30  # m from the tool body along its axis

TOOL_BIT = 2  # contact bits: rod and table carry 2, objects carry 1 and meet both
OBJECT_BIT = 1

_STIFFNESS = (4500.0, 4500.0, 3500.0, 3500.0, 2000.0, 2000.0, 2000.0)  # N m / rad
_DAMPING = (225.0, 225.0, 175.0, 175.0, 100.0, 100.0, 100.0)  # N m s / rad
_MAX_TORQUE = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)  # N m, the real arm's limits


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
    _add_rod(spec, rod_radius)
    _add_servos(spec)
    _add_table(spec)
    return spec


def add_cube(
    spec: mujoco.MjSpec, name: str, *, half: float, mass: float, friction: float, rgba: list[float]
) -> None:
    """A free cube of half edge `half` (m) and `mass` (kg) that the rod, the table and other objects
    touch; where it starts is the context's business."""
    body = spec.worldbody.add_body(name=name, pos=[0.5, 0.0, half])
    body.add_freejoint(name=f"{name}_joint")
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[half, half, half],
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
    """Drop the fingers, keep the wanted meshes, balance gravity, let arm geoms touch nothing."""
    for name in ("panda0_leftfinger", "panda0_rightfinger"):
        spec.delete(spec.body(name))
    spec.delete(spec.site("end_effector"))
    for asset in list(spec.meshes):
        if asset.name.startswith("finger") or (mesh == "col" and asset.name.endswith("_viz")):
            for geom in list(spec.geoms):
                if geom.meshname == asset.name:
                    spec.delete(geom)
            spec.delete(asset)
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
        name="front",
        pos=[1.05, 0.0, 1.2],
        quat=[0.683, 0.183, 0.183, 0.683],
        fovy=45.0,  # D3IL's camera
    )
