"""The rows of the paper's Table I, each one choice per column."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses

from apnpql_jax.agents.columns.candidates import Candidates
from apnpql_jax.agents.columns.policy import (
  cem,
  non_parametric,
  parametric,
  prior_alone,
)
from apnpql_jax.agents.columns.policy_evaluation import (
  TD0,
  Categorical,
  ClippedDoubleQ,
  PolicyEvaluation,
  Retrace,
)
from apnpql_jax.agents.columns.policy_update import (
  Improvement,
  forward_kl,
  keep_q,
  reverse_kl,
)
from apnpql_jax.agents.columns.regularizer import (
  Losses,
  behavior_prior,
  fit_advantageous,
  fit_candidates,
  fit_expert,
  no_update,
  previous_policy,
  uniform,
)
from apnpql_jax.agents.networks import GROUPS
from apnpql_jax.config.schema import AgentConfig, TrainConfig
from apnpql_jax.dists.action import ActionDistribution
from apnpql_jax.errors import ConfigError, check_name


@dataclasses.dataclass(frozen=True)
class Algorithm:
  """One row of Table I; the columns are functions."""

  regularizer: Callable[..., ActionDistribution]  # (heads, target_heads) -> b
  policy: Callable[..., Candidates]  # (heads, b, key, num_samples)
  regularizer_update: Callable[..., Losses]  # (heads, b, candidates, batch, key, nu)
  policy_update: Callable[..., Improvement]  # (heads, b, key)
  policy_evaluation: Callable[[AgentConfig], PolicyEvaluation]

  def groups(self, config: AgentConfig) -> tuple[str, ...]:
    """Returns the parameter groups that the columns read, in order of ``GROUPS``."""
    absent = {
      "bp": self.regularizer is not behavior_prior,
      "policy": self.policy is not parametric,
      "alpha": config.temperature == "fixed",
    }
    return tuple(group for group in GROUPS if not absent.get(group))


ALGORITHMS = {
  # regularizer      policy          regularizer       policy      policy
  #                                  update            update      evaluation
  "ap_npql": Algorithm(
    behavior_prior,  non_parametric, fit_candidates,   keep_q,     Categorical),
  "ap_mpo": Algorithm(
    behavior_prior,  parametric,     fit_candidates,   forward_kl, Categorical),
  "ap_sac": Algorithm(
    behavior_prior,  parametric,     fit_candidates,   reverse_kl, Categorical),
  "abm_mpo": Algorithm(
    behavior_prior,  parametric,     fit_advantageous, forward_kl, TD0),
  "svg_prior": Algorithm(
    behavior_prior,  parametric,     fit_candidates,   reverse_kl, Retrace),
  "mpo": Algorithm(
    previous_policy, parametric,     no_update,        forward_kl, Retrace),
  "sac": Algorithm(
    uniform,         parametric,     no_update,        reverse_kl, ClippedDoubleQ),
  "ap_cem": Algorithm(  # not in the paper: QT-Opt's policy with b around primitives
    behavior_prior,  cem,            fit_candidates,   keep_q,     ClippedDoubleQ),
  "ap_dagger": Algorithm(  # not in the paper: b imitates the expert, Q is not used
    behavior_prior,  prior_alone,    fit_expert,       keep_q,     Categorical),
}  # fmt: skip

POLICY_EVALUATIONS = {  # values of ``agent.policy_evaluation`` other than "row"
  "categorical": Categorical,
  "td0": TD0,
  "retrace": Retrace,
  "clipped_double_q": ClippedDoubleQ,
}


def algorithm_of(config: AgentConfig) -> Algorithm:
  """Returns the row that ``config`` names, with the columns that it replaces.

  Raises:
    ConfigError: The row is unknown, or is combined with a column that it cannot have.
  """
  check_name("agent.algorithm", config.algorithm, tuple(ALGORITHMS))
  row = ALGORITHMS[config.algorithm]
  if config.regularizer == "uniform" and row.regularizer_update is fit_expert:
    raise ConfigError(
      "ap_dagger learns nothing but its regularizer; leave agent.regularizer at row"
    )
  if config.regularizer == "uniform":
    row = dataclasses.replace(row, regularizer=uniform, regularizer_update=no_update)
  if config.policy_evaluation != "row":
    evaluation = POLICY_EVALUATIONS[config.policy_evaluation]
    row = dataclasses.replace(row, policy_evaluation=evaluation)
  if row.policy is cem and row.policy_evaluation is Retrace:
    raise ConfigError(
      "agent.policy_evaluation retrace needs the density of the policy, which ap_cem "
      "lacks; choose another policy evaluation"
    )
  return row


def check_effects(config: TrainConfig) -> None:
  """Checks that the row has the columns that these settings change.

  This is for new runs. Older ones, in which such a setting has no effect, still load.

  Raises:
    ConfigError: A setting has no effect.
  """
  agent, row = config.agent, algorithm_of(config.agent)
  prior, predicted = row.regularizer is behavior_prior, agent.prior_mean == "primitives"
  mixture, true = agent.policy_components > 1, config.env.true_primitives
  for name, idle, lacking in (
    ("agent.policy_components", mixture and row.policy is not parametric, "policy pi"),
    ("agent.prior_mean", not predicted and not prior, "prior b_theta"),
    ("env.true_primitives", true and not (prior and predicted), "prior around them"),
  ):
    if idle:
      raise ConfigError(
        f"{name} has no effect: with these settings, {agent.algorithm} has no {lacking}"
      )


def imitates(config: AgentConfig) -> bool:
  """Returns whether the row learns from ``Transition.expert_tm1``."""
  return algorithm_of(config).regularizer_update is fit_expert


def epsilon_bounds() -> dict[str, tuple[str, ...]]:
  """Returns per row the settings, q's sample counts, whose log must exceed epsilon."""
  return {
    name: ("target_samples",) * (row.policy is non_parametric)
    + ("policy_samples",) * (row.policy_update is not reverse_kl)
    for name, row in ALGORITHMS.items()
  }
