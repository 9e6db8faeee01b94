"""The networks, built from the settings (paper Fig. 2 and Sec. IV-B).

The features phi are computed once per observation. The groups of parameters are
encoder, ap (predicted primitives), z (value), alpha and, depending on the algorithm,
bp (the rest of the prior) and policy.
"""

from __future__ import annotations

from apnpql_jax.agents.columns.policy_evaluation import Evaluation
from apnpql_jax.agents.encoder import Encoder
from apnpql_jax.agents.heads import Networks
from apnpql_jax.agents.mixture_head import mixture_size
from apnpql_jax.agents.modules import Constant, Head
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.types import ACTION_DIM, NUM_PRIMITIVES


def make_networks(
  config: AgentConfig, groups: tuple[str, ...], evaluation: Evaluation
) -> Networks:
  """Builds the modules of ``groups``, with the sizes of ``config``."""
  hidden, learned_mean = config.hidden, config.prior_mean == "learned"
  modules = {
    "encoder": Encoder(config),
    "ap": Head(hidden, NUM_PRIMITIVES * ACTION_DIM),
    "bp": Head(hidden, NUM_PRIMITIVES * mixture_size(own_mean=learned_mean)),
    "z": evaluation.head(hidden),
    "alpha": Constant() if config.temperature == "shared" else Head(hidden, 1),
    "policy": Head(hidden, mixture_size(own_mean=True)),
  }
  return Networks({k: modules[k] for k in groups}, evaluation.value, config)
