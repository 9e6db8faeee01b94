"""Densities of mixtures: by scipy in double precision, and by distrax."""

from __future__ import annotations

import distrax
import jax
import numpy as np
from scipy import special, stats

from apnpql_jax.dists.gmm import GripperGMM


def scipy_log_prob(mixture: GripperGMM, actions: np.ndarray) -> np.ndarray:
  """Returns log densities f64[S] of actions [S, D + 1] under one unbatched mixture."""
  log_weights = special.log_softmax(np.asarray(mixture.logits, np.float64))
  parts = []
  for k, log_weight in enumerate(log_weights):
    scale = np.asarray(mixture.scale_tril[k], np.float64)
    arm = stats.multivariate_normal(np.asarray(mixture.loc[k]), scale @ scale.T)
    gripper = stats.bernoulli(special.expit(float(mixture.gripper_logits[k])))
    parts.append(
      log_weight
      + arm.logpdf(actions[:, :-1])
      + gripper.logpmf(np.round(actions[:, -1]))
    )
  return special.logsumexp(parts, axis=0)


def distrax_log_prob(mixture: GripperGMM, actions: jax.Array) -> jax.Array:
  """Returns log densities f32[*s, *b] of actions f32[*s, *b, D + 1]."""
  components = distrax.Joint(
    (
      distrax.MultivariateNormalTri(mixture.loc, mixture.scale_tril),
      distrax.Bernoulli(logits=mixture.gripper_logits),
    )
  )
  parts = components.log_prob((actions[..., None, :-1], actions[..., -1:]))
  weights = distrax.Categorical(logits=mixture.logits)
  return jax.nn.logsumexp(parts + weights.logits, axis=-1)
