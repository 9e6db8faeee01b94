"""Where candidate actions come from and how they are weighed (Table I, column 2)."""

from __future__ import annotations

from flax import struct
import jax
import jax.numpy as jnp

from apnpql_jax.agents.networks import Networks, Params
from apnpql_jax.dists import boltzmann, categorical, gmm
from apnpql_jax.types import Array


class Candidates(struct.PyTreeNode):
  """S candidate actions per state and the policy's weights on them. No gradients."""

  samples: Array  # f32[S, *b, 7]: as drawn, where log b is evaluated
  actions: Array  # f32[S, *b, 7]: clipped to the action box, where Q is evaluated
  logits: Array  # f32[S, *b, n]: Z(s, a_i)
  q_values: Array  # f32[S, *b]
  alpha: Array  # f32[*b]
  weights: Array  # f32[S, *b]: sum to one over S


def clip_action(actions: Array) -> Array:
  """Limits joint velocities to [-1, 1] rad/s; the gripper, in {0, 1}, is unchanged."""
  return jnp.clip(actions, -1.0, 1.0)


def behaviour_prior(networks: Networks, params: Params, phi: Array) -> gmm.GripperGMM:
  """b_theta: mixture around the predicted action primitives (paper Sec. IV-A)."""
  return networks.prior(params, phi)


def non_parametric(
  networks: Networks,
  params: Params,
  phi: Array,
  prior: gmm.GripperGMM,
  key: Array,
  *,
  num_samples: int,
) -> Candidates:
  """q = b exp(Q / alpha) / Z by self-normalised importance sampling (paper Eq. 6).

  Args:
    networks: what predicts.
    params: of the networks.
    phi: f32[*b, n] features.
    prior: the regulariser b at the same states.
    key: random key.
    num_samples: candidates S per state.

  Returns:
    Candidates drawn from ``prior`` with weights softmax(Q / alpha).
  """
  params, phi, prior = jax.lax.stop_gradient((params, phi, prior))
  samples = gmm.sample(key, prior, num_samples)
  actions = clip_action(samples)
  logits = networks.q_logits(params, phi, actions)
  q_values = categorical.mean(jax.nn.softmax(logits), networks.atoms)
  alpha = networks.alpha(params, phi)
  weights = boltzmann.importance_weights(q_values, alpha)
  return Candidates(samples, actions, logits, q_values, alpha, weights)
