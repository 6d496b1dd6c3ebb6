"""The MuJoCo model: source, gripper, receiver, floor and spheres as MJCF."""

from __future__ import annotations

import functools
import math

import mujoco
import numpy as np

from sims.pouring.geometry import (
    GRAVITY,
    INNER,
    LIP_WALL,
    RECEIVER_WALL,
    SOURCE_HEIGHT,
    SOURCE_WALL,
    SOURCE_WIDTH,
    SPHERE_RADIUS,
    SPHERES,
    WALL,
    Receiver,
    Source,
)
from sims.pouring.materials import Material

CONTROL_STEP = 0.025  # time between two commands, the step of the published simulator
SUBSTEPS = 2  # physics steps per command; one would let spheres through the walls
TIME_STEP = CONTROL_STEP / SUBSTEPS
SPHERE_DENSITY = 1000.0  # scales all forces alike
SPHERE_MASS = SPHERE_DENSITY * 4 / 3 * math.pi * SPHERE_RADIUS**3

GRIPPER_SIZE = (0.105, 0.35, 0.1)  # each of two blocks, before and behind the source
RECEIVER_DENSITY = 5000.0  # heavy: it weighs more than all spheres together
# Half a period of the undamped contact; from 4 steps down the bounce is left to chance.
CONTACT_TIME = 6 * TIME_STEP
ITERATIONS = 25  # of the contact solver, per physics step; with 15, bouncing spheres gain energy
# So large that the source follows its commands, so small that the solver stays accurate.
KINEMATIC_INERTIA = 20.0

# Spheres dropped on each other and on walls with these damping ratios came back with these shares of their
# speed (mean over 4 speeds and 10 phases of the step; the textbook's exp(-pi d / sqrt(1 - d^2)) is far lower
# for strong damping).
_DAMPING = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
_BOUNCE = (0.942, 0.862, 0.748, 0.652, 0.57, 0.443, 0.35, 0.278, 0.228, 0.184, 0.156, 0.132)


def contact_damping(bounce: float) -> float:
    """Damping ratio of the contact springs that lets spheres bounce back with that share of their speed.

    Measured, not derived: 0.132 is the least bounce that the time step resolves, and less is taken for that.
    """
    return float(np.interp(-bounce, [-value for value in _BOUNCE], _DAMPING))


@functools.lru_cache(maxsize=16)
def compile_scene(material: Material, source: Source, receiver: Receiver) -> mujoco.MjModel:
    """Return the compiled model; nothing in it changes afterwards, so equal scenes share one.

    Joints, in order: source x, z, tilt; gripper height on the source; receiver x, y, yaw; x, y, z of each
    sphere.
    """
    stiffness = (math.pi / CONTACT_TIME) ** 2
    damping = 2 * contact_damping(material.bounce) * math.sqrt(stiffness)
    return mujoco.MjModel.from_xml_string(f"""
<mujoco model="pouring">
  <compiler angle="radian" autolimits="true"/>
  <!-- Bodies of so few geoms are tested faster pair by pair than through a midphase's trees. -->
  <option timestep="{TIME_STEP}" gravity="0 0 {-GRAVITY}" integrator="Euler" solver="CG" cone="elliptic"
          iterations="{ITERATIONS}" ls_iterations="8" tolerance="1e-6" jacobian="sparse">
    <flag autoreset="disable" island="disable" midphase="disable"/>
  </option>
  <size memory="64M"/>
  <visual><global offwidth="1280" offheight="960"/><headlight ambient="0.5 0.5 0.5"/></visual>
  <asset><texture type="skybox" builtin="flat" rgb1="1 1 1" rgb2="1 1 1" width="8" height="48"/></asset>
  <default>
    <geom condim="3" friction="{material.friction} 0.005 0.0001" solref="{-stiffness} {-damping}"
          solimp="0.95 0.99 0.001 0.5 2"/>
    <default class="sphere">
      <geom type="sphere" size="{SPHERE_RADIUS}" density="{SPHERE_DENSITY}" contype="1" conaffinity="1"/>
    </default>
    <default class="source"><geom contype="0" conaffinity="1" mass="0.1" rgba="0.6 0.8 1 0.25"/></default>
    <default class="gripper">
      <!-- Soft pads that push the receiver and nothing else. -->
      <geom contype="0" conaffinity="2" mass="0.1" priority="1" solref="0.2 1" rgba="0.3 0.3 0.3 0.6"/>
    </default>
    <default class="receiver">
      <geom contype="2" conaffinity="1" density="{RECEIVER_DENSITY}" rgba="0.5 1 0.5 0.35"/>
    </default>
  </default>
  <worldbody>
    <light pos="0.5 -2 3" dir="0 0.5 -1" castshadow="false"/>
    <geom name="floor" type="plane" size="5 5 0.1" contype="0" conaffinity="1" rgba="0.75 0.75 0.75 1"/>
    <body name="source" gravcomp="1">
      {_kinematic_joint("slide", "1 0 0")}
      {_kinematic_joint("slide", "0 0 1")}
      {_kinematic_joint("hinge", "0 1 0")}
      {_source_geoms(source)}
      <body name="gripper" pos="{-SOURCE_WIDTH / 2} 0 {-SOURCE_HEIGHT}" gravcomp="1">
        {_kinematic_joint("slide", "0 0 1")}
        {_gripper_geoms()}
      </body>
    </body>
    <body name="receiver">
      <!-- It stands on the floor: dry friction holds it until it is pushed. -->
      <joint type="slide" axis="1 0 0" frictionloss="5" damping="5"/>
      <joint type="slide" axis="0 1 0" frictionloss="5" damping="5"/>
      <joint type="hinge" axis="0 0 1" frictionloss="1" damping="1"/>
      {_receiver_geoms(receiver)}
    </body>
    {"".join(_sphere(i) for i in range(SPHERES))}
  </worldbody>
</mujoco>""")


def _kinematic_joint(kind: str, axis: str) -> str:
    return f'<joint type="{kind}" axis="{axis}" armature="{KINEMATIC_INERTIA}"/>'


def _box(kind: str, centre: tuple[float, float, float], half: tuple[float, float, float], turn: str = "0 0 0") -> str:
    pos, size = (" ".join(f"{value:.9g}" for value in triple) for triple in (centre, half))
    return f'<geom class="{kind}" type="box" pos="{pos}" size="{size}" euler="{turn}"/>'


def _sphere(index: int) -> str:
    joints = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    return f'<body name="sphere{index}">{joints}<geom class="sphere"/></body>'


def _source_geoms(source: Source) -> str:
    """Walls, bottom and lip in the frame of the shoulder; they grow outwards from their inner faces."""
    x0, z0 = -SOURCE_WIDTH / 2, -SOURCE_HEIGHT
    half = SOURCE_WALL / 2
    out = INNER + SOURCE_WALL
    side = INNER + half
    boxes = [_box("source", (x0, 0, z0 + WALL - half), (out, out, half))]
    for sign in (1, -1):
        boxes.append(_box("source", (x0 + sign * side, 0, -SOURCE_HEIGHT / 2), (half, out, SOURCE_HEIGHT / 2)))
        boxes.append(_box("source", (x0, sign * side, -SOURCE_HEIGHT / 2), (out, half, SOURCE_HEIGHT / 2)))
    length, thickness = source.lip / math.sqrt(2), LIP_WALL / 2
    across = INNER - source.lip / 2 + thickness * math.sqrt(0.5)
    height = source.lip / 2 + thickness * math.sqrt(0.5)
    for sign in (1, -1):
        lean = sign * math.pi / 4
        boxes.append(_box("source", (x0 + sign * across, 0, height), (length, INNER, thickness), f"0 {lean} 0"))
        boxes.append(_box("source", (x0, sign * across, height), (INNER, length, thickness), f"{-lean} 0 0"))
    return "".join(boxes)


def _gripper_geoms() -> str:
    length, width, height = GRIPPER_SIZE
    across = SOURCE_WIDTH / 2 + WALL + length / 2
    return "".join(_box("gripper", (sign * across, 0, 0), (length / 2, width / 2, height / 2)) for sign in (1, -1))


def _receiver_geoms(receiver: Receiver) -> str:
    """Bottom and walls; the walls grow outwards from inner faces 0.005 inside the nominal size."""
    length, width, height = receiver.size
    half = RECEIVER_WALL / 2
    x, y = length / 2 - WALL + half, width / 2 - WALL + half
    boxes = [_box("receiver", (0, 0, half / 2), (x - half, y - half, half / 2))]
    for sign in (1, -1):
        boxes.append(_box("receiver", (sign * x, 0, height / 2), (half, y + half, height / 2)))
        boxes.append(_box("receiver", (0, sign * y, height / 2), (x - half, half, height / 2)))
    return "".join(boxes)
