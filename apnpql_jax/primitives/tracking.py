"""Action primitives inside jit: their joint targets, updated and followed.

A primitive is the velocity from the present to a target configuration (paper
Sec. IV-A). mink solves the targets of every reset state (``reset_bank``); from there a
few damped least-squares steps per control period track the moving scene.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float

from apnpql_jax.sim import arm
from apnpql_jax.sim.motors import MAX_VELOCITY
from apnpql_jax.types import Array

GAIN = 2.0  # 1/s, close to the target
# rad/s^2, far from the target: v = sqrt(2 a d) stops within d. Below the limit of 1.2
# because a command is held for 0.15 s. GAIN alone would overshoot by 0.06 rad.
BRAKING = 0.7
DAMPING = 1e-3  # m or rad; far below the Jacobian's singular values in the workspace
REFINE_STEPS = 4  # per control period; two reduce a jump of 10 cm to below 1 mm
MAX_REFINEMENT = 0.3  # rad; longest joint step, a trust region near singularities


def follow(
  target: Float[Array, "*b 6"], q: Float[Array, "*b 6"]
) -> Float[Array, "*b 6"]:
  """Returns velocities (rad/s) toward joint angles; one factor scales all joints."""
  error = target - q
  farthest = jnp.abs(error).max(-1, keepdims=True)
  speed = jnp.minimum(GAIN * farthest, jnp.sqrt(2 * BRAKING * farthest))
  speed = jnp.minimum(speed, MAX_VELOCITY)
  return error * (speed / jnp.maximum(farthest, 1e-6))


def destination(
  velocity: Float[Array, "*b 6"], q: Float[Array, "*b 6"]
) -> Float[Array, "*b 6"]:
  """Returns the joint angles (rad) to which ``follow`` leads with these velocities.

  This inverts ``follow``. It stops at the distance from which the full speed is
  reached, 0.7 rad, because a velocity does not tell how far beyond it the target is.
  """
  fastest = jnp.abs(velocity).max(-1, keepdims=True)
  speed = jnp.minimum(fastest, MAX_VELOCITY)
  farthest = jnp.maximum(speed / GAIN, speed**2 / (2 * BRAKING))
  return q + velocity * (farthest / jnp.maximum(fastest, 1e-6))


def refine(
  chain: arm.ArmChain,
  last: Float[Array, "*b 6"],
  present: Float[Array, "*b 6"],
  pos: Float[Array, "*b 3"],
  mat: Float[Array, "*b 3 3"],
) -> Float[Array, "*b 6"]:
  """Moves joint targets (rad) toward tool poses by damped least squares.

  Starts from the last target, or from the present configuration if that is nearer to
  the pose. After a jump of the pose, as when an object has been grasped, steps from a
  distant start could end in another branch of the arm's configurations.
  """
  damping = DAMPING**2 * jnp.eye(6)

  def error(q: Array) -> tuple[Array, Array]:
    tool_pos, tool_mat, jacobian = arm.forward(chain, q)
    turn = arm.rotation_error(tool_mat, mat)
    return jnp.concatenate([pos - tool_pos, turn], axis=-1), jacobian

  def newton_step(q: Array, _) -> tuple[Array, None]:
    missing, jacobian = error(q)
    transposed = jnp.swapaxes(jacobian, -1, -2)
    gram = jacobian @ transposed + damping
    step = (transposed @ jnp.linalg.solve(gram, missing[..., None]))[..., 0]
    longest = jnp.abs(step).max(-1, keepdims=True)
    return q + step * jnp.minimum(1.0, MAX_REFINEMENT / (longest + 1e-9)), None

  far = [(error(q)[0] ** 2).sum(-1, keepdims=True) for q in (last, present)]
  start = jnp.where(far[0] <= far[1], last, present)
  return jax.lax.scan(newton_step, start, length=REFINE_STEPS)[0]
