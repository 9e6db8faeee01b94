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
"""1/s. Under the 1.2 rad/s^2 limit a joint at 1 rad/s can brake within
v^2 / 2a = 0.42 rad, so v = gain d needs a gain of at most 2.4 (2 a_max / v_max); the
rest is left for the 0.15 s during which a command is held."""

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
  velocity = GAIN * (target - q)
  fastest = jnp.abs(velocity).max(-1, keepdims=True)
  return velocity * (MAX_VELOCITY / jnp.maximum(fastest, MAX_VELOCITY))


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
