"""Action primitives inside jit: keep their joint targets and follow them.

A primitive is the velocity that leads from the present to a target configuration
(paper Sec. IV-A). mink solves the targets of every reset state (``bank``); from
there a few damped least-squares steps per control period keep up with the scene.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from apnpql_jax.sim import arm
from apnpql_jax.sim.physics import MAX_VELOCITY
from apnpql_jax.types import Array

GAIN = 2.0
"""1/s, close to the target."""

BRAKING = 0.7
"""rad/s^2, far from it: v = sqrt(2 a d) stops within d. Less than the limit of 1.2,
because a command is held for 0.15 s. Without this profile a gain of 2.0 overshoots
by 0.06 rad from full speed, and only 1.7 would not."""

DAMPING = 1e-3
"""m or rad; small against the Jacobian's singular values in the workspace."""

REFINE_STEPS = 4
"""Newton steps per control period; two bring a 10 cm jump to below 1 mm."""

MAX_REFINEMENT = 0.3
"""rad; longest joint step of one iteration, a trust region near singularities."""


def follow(target: Array, q: Array) -> Array:
  """Velocity towards a target, scaled as a whole into the velocity limit.

  Args:
    target: f32[*b, 6], joint angles, rad.
    q: f32[*b, 6], present joint angles, rad.

  Returns:
    f32[*b, 6], rad/s.
  """
  error = target - q
  farthest = jnp.abs(error).max(-1, keepdims=True)
  speed = jnp.minimum(GAIN * farthest, jnp.sqrt(2 * BRAKING * farthest))
  speed = jnp.minimum(speed, MAX_VELOCITY)
  return error * (speed / jnp.maximum(farthest, 1e-6))


def refine(chain: arm.ArmChain, q: Array, pos: Array, mat: Array) -> Array:
  """Moves joint targets towards tool poses by damped least squares.

  Args:
    chain: the arm.
    q: f32[*b, 6], start, rad.
    pos: f32[*b, 3], desired tool position, m.
    mat: f32[*b, 3, 3], desired tool rotation.

  Returns:
    f32[*b, 6], rad.
  """
  damping = DAMPING**2 * jnp.eye(6)

  def newton_step(q: Array, _) -> tuple[Array, None]:
    tool_pos, tool_mat, jacobian = arm.forward(chain, q)
    error = jnp.concatenate(
      [pos - tool_pos, arm.rotation_error(tool_mat, mat)], axis=-1
    )
    transposed = jnp.swapaxes(jacobian, -1, -2)
    gram = jacobian @ transposed + damping
    step = transposed @ jnp.linalg.solve(gram, error[..., None])
    return q + step[..., 0].clip(-MAX_REFINEMENT, MAX_REFINEMENT), None

  return jax.lax.scan(newton_step, q, length=REFINE_STEPS)[0]
