"""World poses from a physics state: one JAX path for both engines."""

from __future__ import annotations

from collections.abc import Callable

from flax import struct
import jax

from apnpql_jax.sim.mjx_patches import patch_mjx
from apnpql_jax.sim.physics import PhysicsState, model_fields
from apnpql_jax.sim.quiet_mjx import mjx
from apnpql_jax.sim.scene import Scene
from apnpql_jax.types import Array

_POSES = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat")


class Kinematics(struct.PyTreeNode):
  """World poses of geoms, sites and cameras by MuJoCo id; positions in m."""

  geom_xpos: Array  # f32[*b, ngeom, 3]
  geom_xmat: Array  # f32[*b, ngeom, 3, 3]
  site_xpos: Array  # f32[*b, nsite, 3]
  site_xmat: Array  # f32[*b, nsite, 3, 3]
  cam_xpos: Array  # f32[*b, ncam, 3]
  cam_xmat: Array  # f32[*b, ncam, 3, 3]
  fields: dict[str, Array]  # of ``PhysicsState``: some change the image


def make_kinematics(scene: Scene) -> Callable[[PhysicsState], Kinematics]:
  """Returns ``f(state) -> Kinematics`` over [worlds, ...]."""
  patch_mjx()
  device = jax.local_devices()[0]  # MJX's default is the first of all processes.
  model = mjx.put_model(scene.model, device, impl="jax")
  template = mjx.make_data(scene.model, device, impl="jax")

  def kinematics(state: PhysicsState) -> Kinematics:
    world = model.replace(**model_fields(state.fields))
    data = template.replace(
      qpos=state.qpos, mocap_pos=state.mocap_pos, mocap_quat=state.mocap_quat
    )
    data = mjx.camlight(world, mjx.kinematics(world, data))
    return Kinematics(**{k: getattr(data, k) for k in _POSES}, fields=state.fields)

  # Jitted, so that all programs of a process share one trace, which takes a second.
  return jax.jit(jax.vmap(kinematics))
