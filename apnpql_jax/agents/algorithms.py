"""The rows of the paper's Table I.

An algorithm is one choice per column; the learner calls the columns and knows no
algorithm by name.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses

from apnpql_jax.agents import objectives, policies
from apnpql_jax.config import check_name


@dataclasses.dataclass(frozen=True)
class Algorithm:
  """One row of Table I; the columns are functions."""

  regulariser: Callable
  """b: (networks, params, phi) -> distribution the policy is kept close to."""

  policy: Callable
  """(networks, params, phi, b, key, num_samples) -> weighted Candidates."""

  regulariser_update: Callable
  """(b, samples, weights, nu) -> loss f32[*b] that trains b."""

  policy_update: None
  """Projection of q onto a parametric policy; None where q itself acts."""

  policy_evaluation: Callable
  """(logits_t, weights_t, reward_t, discount_t, atoms) -> target probabilities."""


ALGORITHMS = {
  #           regulariser               policy                   regulariser update
  #           policy update             policy evaluation
  "ap_npql": Algorithm(
    policies.behaviour_prior, policies.non_parametric, objectives.m_step_loss,
    None,                     objectives.value_target,
  ),
}  # fmt: skip


def get_algorithm(name: str) -> Algorithm:
  """The row called ``name``.

  Raises:
    ConfigError: no such row; the message lists the valid names.
  """
  check_name("agent.algorithm", name, tuple(ALGORITHMS))
  return ALGORITHMS[name]
