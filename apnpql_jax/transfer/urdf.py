"""A compiled MuJoCo model as URDF files, one for each tree of bodies.

Bodies become links, geoms the primitive shapes of visuals and, where the scene pairs
them for contact, of collisions. Armature, equalities, actuators and contact parameters
are left out, because URDF cannot express them.
"""

from collections.abc import Iterator
import warnings

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from apnpql_jax.colors import geom_rgba
from apnpql_jax.errors import ConfigError
from apnpql_jax.sim.scene import Scene

KINDS = "plane", "sphere", "box", "capsule", "cylinder"
"""Types of geoms."""

PLANE = np.array([2.0, 2.0, 0.05])
"""Half sizes of the box whose upper side stands for a plane, m."""


def check(scene: Scene) -> None:
  """Checks that a scene can be simulated: joints are the robot's, or free.

  Raises:
    ConfigError: Another body has a joint, or there is a geom of another type.
  """
  model = scene.model
  tree, free = model.body_rootid[model.jnt_bodyid], mujoco.mjtJoint.mjJNT_FREE
  others = (tree != tree[model.actuator_trnid[0, 0]]) & (model.jnt_type != free)
  found = [f"the joint {model.joint(i).name}" for i in np.flatnonzero(others)]
  kinds = sorted({_kind(model, geom) for geom in range(model.ngeom)} - {*KINDS})
  found += [f"geoms of the type {kind}" for kind in kinds]
  if found:
    what = " and ".join(found)
    raise ConfigError(f"{scene.name}.xml has {what}, which --physics bullet lacks")


def roots(model: mujoco.MjModel) -> list[int]:
  """Returns the world, for the geoms fixed to it, and its children."""
  return [0, *np.flatnonzero(model.body_parentid[1:] == 0) + 1]


def write(model: mujoco.MjModel, root: int) -> str:
  """Returns the URDF of a body and its descendants; of the world, only its geoms.

  Links are named "body_<id>" and joints "joint_<id>", by the ids of MuJoCo.

  Raises:
    ValueError: URDF cannot express a joint or a shape; see ``check``.
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
  first, colors = model.body_geomadr[body], geom_rgba(model)
  for geom in range(first, first + model.body_geomnum[body]):
    shape = _shape(model, geom)
    rgba = colors[geom]
    if rgba[3] > 0 and model.geom_group[geom] < 3:
      color = f'<color rgba="{_numbers(rgba)}"/>'
      material = f'<material name="geom_{geom}">{color}</material>'
      yield f"<visual>{shape}{material}</visual>"
    if geom in model.pair_geom1 or geom in model.pair_geom2:
      yield f"<collision>{shape}</collision>"


def _kind(model: mujoco.MjModel, geom: int) -> str:
  name = mujoco.mjtGeom(model.geom_type[geom]).name
  return name.removeprefix("mjGEOM_").lower()


def _shape(model: mujoco.MjModel, geom: int) -> str:
  kind = _kind(model, geom)
  size, pos = model.geom_size[geom], model.geom_pos[geom]
  if kind == "plane":
    kind, size, pos = "box", PLANE, pos - PLANE * [0, 0, 1]
  shapes = {
    "sphere": f'<sphere radius="{size[0]}"/>',
    "box": f'<box size="{_numbers(2 * size)}"/>',
    "capsule": f'<capsule radius="{size[0]}" length="{2 * size[1]}"/>',
    "cylinder": f'<cylinder radius="{size[0]}" length="{2 * size[1]}"/>',
  }
  if kind not in shapes:
    raise ValueError(f"no URDF for a geom of type {kind}")
  return f"{_origin(pos, model.geom_quat[geom])}<geometry>{shapes[kind]}</geometry>"


def _joint(model: mujoco.MjModel, body: int) -> str:
  frame = (
    f'<parent link="body_{model.body_parentid[body]}"/><child link="body_{body}"/>'
    f"{_origin(model.body_pos[body], model.body_quat[body])}"
  )
  joint, count = model.body_jntadr[body], model.body_jntnum[body]
  if not count:
    return f'<joint name="fixed_{body}" type="fixed">{frame}</joint>'
  hinge = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
  if count > 1 or not hinge or model.jnt_pos[joint].any():
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
  return bool(joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE)


def _origin(pos: np.ndarray, quat: np.ndarray) -> str:
  with warnings.catch_warnings(action="ignore"):  # Of pitches of 90 degrees.
    rpy = Rotation.from_quat(quat, scalar_first=True).as_euler("xyz")
  return f'<origin xyz="{_numbers(pos)}" rpy="{_numbers(rpy)}"/>'


def _numbers(values: np.ndarray) -> str:
  return " ".join(str(float(value)) for value in values)
