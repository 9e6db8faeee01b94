"""Densities of mixtures by scipy, in double precision."""

from __future__ import annotations

import numpy as np
from scipy import special, stats

from apnpql_jax.dists.gmm import GripperGMM


def scipy_log_prob(mixture: GripperGMM, actions: np.ndarray) -> np.ndarray:
  """Of one unbatched mixture; actions [S, D + 1]."""
  log_weights = special.log_softmax(np.asarray(mixture.logits, np.float64))
  parts = []
  for k, log_weight in enumerate(log_weights):
    scale = np.asarray(mixture.scale_tril[k], np.float64)
    arm = stats.multivariate_normal(np.asarray(mixture.mean[k]), scale @ scale.T)
    gripper = stats.bernoulli(special.expit(float(mixture.gripper_logits[k])))
    parts.append(
      log_weight
      + arm.logpdf(actions[:, :-1])
      + gripper.logpmf(np.round(actions[:, -1]))
    )
  return special.logsumexp(parts, axis=0)
