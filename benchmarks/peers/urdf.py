"""A compiled MuJoCo model as URDF files, one for each tree of bodies.

Bodies become links, geoms the primitive shapes of visuals and, where the scene pairs
them for contact, of collisions. Armature, equalities, actuators and contact parameters
are left out, because URDF cannot express them.
"""

from __future__ import annotations

from collections.abc import Iterator
import math

import mujoco
import numpy as np

PLANE_HALF = 2.0
"""m; a plane becomes the upper side of a box of this half size."""

_FREE = mujoco.mjtJoint.mjJNT_FREE
_HINGE = mujoco.mjtJoint.mjJNT_HINGE


def roots(model: mujoco.MjModel) -> list[int]:
  """Returns the world, for the geoms fixed to it, and its children."""
  return [0, *np.flatnonzero(model.body_parentid[1:] == 0) + 1]


def write(model: mujoco.MjModel, root: int) -> str:
  """Returns the URDF of a body and its descendants; of the world, only its geoms.

  Links are named "body_<id>" and joints "joint_<id>", by the ids of MuJoCo.

  Raises:
    ValueError: URDF cannot express a joint or a shape.
  """
  bodies = [root]
  for body in range(root + 1, model.nbody if root else 0):
    if model.body_parentid[body] in bodies:
      bodies.append(body)
  parts = [_link(model, body) for body in bodies]
  parts += [_joint(model, body) for body in bodies[1:]]
  return f'<robot name="tree_{root}">\n' + "\n".join(parts) + "\n</robot>\n"


def _link(model: mujoco.MjModel, body: int) -> str:
  xx, yy, zz = model.body_inertia[body]
  inertial = (
    f"<inertial>{_origin(model.body_ipos[body], model.body_iquat[body])}"
    f'<mass value="{model.body_mass[body]}"/><inertia ixx="{xx}" iyy="{yy}" '
    f'izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial>'
  )
  shapes = "\n".join(_shapes(model, body))
  return f'<link name="body_{body}">{inertial}\n{shapes}</link>'


def _shapes(model: mujoco.MjModel, body: int) -> Iterator[str]:
  first = model.body_geomadr[body]
  for geom in range(first, first + model.body_geomnum[body]):
    shape = _shape(model, geom)
    rgba = model.geom_rgba[geom]
    if rgba[3] > 0 and model.geom_group[geom] < 3:
      color = f'<color rgba="{_numbers(rgba)}"/>'
      material = f'<material name="geom_{geom}">{color}</material>'
      yield f"<visual>{shape}{material}</visual>"
    if geom in model.pair_geom1 or geom in model.pair_geom2:
      yield f"<collision>{shape}</collision>"


def _shape(model: mujoco.MjModel, geom: int) -> str:
  kinds, kind = mujoco.mjtGeom, mujoco.mjtGeom(model.geom_type[geom])
  size, pos = model.geom_size[geom], model.geom_pos[geom]
  if kind == kinds.mjGEOM_PLANE:
    depth = 0.1
    inside = f'<box size="{2 * PLANE_HALF} {2 * PLANE_HALF} {depth}"/>'
    pos = pos - [0.0, 0.0, depth / 2]
  elif kind == kinds.mjGEOM_SPHERE:
    inside = f'<sphere radius="{size[0]}"/>'
  elif kind == kinds.mjGEOM_BOX:
    inside = f'<box size="{_numbers(2 * size)}"/>'
  elif kind in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
    name = "capsule" if kind == kinds.mjGEOM_CAPSULE else "cylinder"
    inside = f'<{name} radius="{size[0]}" length="{2 * size[1]}"/>'
  else:
    raise ValueError(f"no URDF for a geom of type {kind.name}")
  return f"{_origin(pos, model.geom_quat[geom])}<geometry>{inside}</geometry>"


def _joint(model: mujoco.MjModel, body: int) -> str:
  frame = (
    f'<parent link="body_{model.body_parentid[body]}"/><child link="body_{body}"/>'
    f"{_origin(model.body_pos[body], model.body_quat[body])}"
  )
  joint, count = model.body_jntadr[body], model.body_jntnum[body]
  if not count:
    return f'<joint name="fixed_{body}" type="fixed">{frame}</joint>'
  if count > 1 or model.jnt_type[joint] != _HINGE or model.jnt_pos[joint].any():
    raise ValueError(f"body {body} does not turn about one axis through its origin")
  low, high = model.jnt_range[joint]
  return (
    f'<joint name="joint_{joint}" type="revolute">{frame}'
    f'<axis xyz="{_numbers(model.jnt_axis[joint])}"/>'
    f'<limit lower="{low}" upper="{high}" effort="150" velocity="3.14"/></joint>'
  )


def is_free(model: mujoco.MjModel, body: int) -> bool:
  """Returns whether a body floats."""
  joint = model.body_jntadr[body]
  return bool(joint >= 0 and model.jnt_type[joint] == _FREE)


def _origin(pos: np.ndarray, quat: np.ndarray) -> str:
  mat = np.zeros(9)
  mujoco.mju_quat2Mat(mat, quat)
  (m00, _, _), (m10, m11, m12), (m20, m21, m22) = mat.reshape(3, 3)
  level = math.hypot(m00, m10)
  pitch = math.atan2(-m20, level)
  # Straight up or down, roll and yaw turn about the same axis; roll is enough.
  steep = level < 1e-9
  roll = math.atan2(-m12, m11) if steep else math.atan2(m21, m22)
  yaw = 0.0 if steep else math.atan2(m10, m00)
  return f'<origin xyz="{_numbers(pos)}" rpy="{roll} {pitch} {yaw}"/>'


def _numbers(values: np.ndarray) -> str:
  return " ".join(str(float(value)) for value in values)
