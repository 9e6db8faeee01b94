"""Kinematics of the arm in JAX: tool pose and geometric Jacobian in the world."""

from __future__ import annotations

from flax import struct
import jax.numpy as jnp
from jaxtyping import Float
import mujoco
import numpy as np

from apnpql_jax.sim.scene import Scene
from apnpql_jax.types import ARM_DOF, Array


class ArmChain(struct.PyTreeNode):
  """The serial chain from the world to the tool site; lengths in m."""

  base_pos: Float[Array, "*b 3"]  # parent of the first link in the world
  base_mat: Float[Array, "*b 3 3"]
  link_pos: Float[Array, "6 3"]  # joint frame in its parent link at q = 0
  link_mat: Float[Array, "6 3 3"]
  axis: Float[Array, "6 3"]  # unit joint axes in the link frame
  tool_pos: Float[Array, " 3"]  # tool site in the last link
  tool_mat: Float[Array, "3 3"]


def make_chain(scene: Scene) -> ArmChain:
  """Reads the chain from the compiled model."""
  model = scene.model
  data = mujoco.MjData(model)
  mujoco.mj_kinematics(model, data)
  joints = model.dof_jntid[scene.arm_dof]
  bodies = model.jnt_bodyid[joints]
  base, last = model.body_parentid[bodies[0]], bodies[-1]
  link_mat = np.zeros((ARM_DOF, 9))
  for mat, body in zip(link_mat, bodies, strict=True):
    mujoco.mju_quat2Mat(mat, model.body_quat[body])
  # The tool site may belong to a body fixed to the last link.
  last_mat = data.xmat[last].reshape(3, 3)
  tool_mat = data.site_xmat[scene.tool_site].reshape(3, 3)
  arrays = {
    "base_pos": data.xpos[base],
    "base_mat": data.xmat[base].reshape(3, 3),
    "link_pos": model.body_pos[bodies],
    "link_mat": link_mat.reshape(-1, 3, 3),
    "axis": model.jnt_axis[joints],
    "tool_pos": last_mat.T @ (data.site_xpos[scene.tool_site] - data.xpos[last]),
    "tool_mat": last_mat.T @ tool_mat,
  }
  return ArmChain(**{k: jnp.asarray(v, jnp.float32) for k, v in arrays.items()})


def with_base(chain: ArmChain, scene: Scene, fields: dict[str, Array]) -> ArmChain:
  """Returns the chain with each world's base pose, for joint angles [worlds, n, 6].

  ``fields`` are those of ``PhysicsState``, [worlds, ...]; a pose they lack is kept.
  """
  base = scene.id("body", "base")
  if "body_pos" in fields:
    chain = chain.replace(base_pos=fields["body_pos"][:, None, base])
  if "body_quat" in fields:
    chain = chain.replace(base_mat=_rotation(fields["body_quat"][:, None, base]))
  return chain


def forward(
  chain: ArmChain, q: Float[Array, "*b 6"]
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3 3"], Float[Array, "*b 6 6"]]:
  """Returns tool position (m), rotation, and Jacobian (rows: linear, then angular)."""
  batch = q.shape[:-1]
  pos = jnp.broadcast_to(chain.base_pos, (*batch, 3))
  mat = jnp.broadcast_to(chain.base_mat, (*batch, 3, 3))
  origins, axes = [], []
  for i in range(ARM_DOF):
    # Joint frame in the world, then the rotation by the joint angle.
    pos = pos + mat @ chain.link_pos[i]
    mat = mat @ chain.link_mat[i]
    origins.append(pos)
    axes.append(mat @ chain.axis[i])
    mat = mat @ _axis_rotation(chain.axis[i], q[..., i])
  pos = pos + mat @ chain.tool_pos
  mat = mat @ chain.tool_mat
  # Each joint moves the tool by axis x lever.
  axis, origin = jnp.stack(axes, -1), jnp.stack(origins, -1)
  linear = jnp.cross(axis, pos[..., None] - origin, axis=-2)
  return pos, mat, jnp.concatenate([linear, axis], axis=-2)


def rotation_error(
  current: Float[Array, "*b 3 3"], target: Float[Array, "*b 3 3"]
) -> Float[Array, "*b 3"]:
  """Returns the rotation vector (rad, world) from current to target."""
  delta = target @ jnp.swapaxes(current, -1, -2)
  # The skew part of a rotation is sin(angle) * axis, its trace 1 + 2 cos(angle).
  pairs = (2, 1), (0, 2), (1, 0)
  skew = 0.5 * jnp.stack([delta[..., i, j] - delta[..., j, i] for i, j in pairs], -1)
  sine = jnp.sqrt((skew**2).sum(-1, keepdims=True) + 1e-12)
  cosine = 0.5 * (jnp.trace(delta, axis1=-2, axis2=-1)[..., None] - 1)
  return skew * jnp.arctan2(sine, cosine) / sine


def _axis_rotation(
  axis: Float[Array, " 3"], angle: Float[Array, "*b"]
) -> Float[Array, "*b 3 3"]:
  """Returns the rotation by Rodrigues' formula."""
  skew = _skew(axis)
  sine, cosine = jnp.sin(angle)[..., None, None], jnp.cos(angle)[..., None, None]
  return jnp.eye(3) + sine * skew + (1 - cosine) * (skew @ skew)


def _rotation(quat: Float[Array, "*b 4"]) -> Float[Array, "*b 3 3"]:
  """Returns the rotations of unit quaternions (wxyz)."""
  w, skew = quat[..., :1, None], _skew(quat[..., 1:])
  return jnp.eye(3) + 2 * (w * skew + skew @ skew)


def _skew(v: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
  """Returns the matrices of the cross products with the vectors."""
  x, y, z = jnp.moveaxis(v, -1, 0)
  zero = jnp.zeros_like(x)
  return jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape, 3)
