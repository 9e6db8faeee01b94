"""What the networks say of a batch of states (paper Fig. 2 and Sec. IV-B).

The features phi are computed once per observation and reused for every candidate
action. Parameters live in groups, so that each can have its own optimiser: encoder,
ap (predicted primitives), z (value), alpha; where the algorithm has them also bp (the
rest of the prior) and policy.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from flax import linen as nn
import jax
import jax.numpy as jnp

from apnpql_jax.agents.encoder import Encoder
from apnpql_jax.agents.evaluation import Evaluation
from apnpql_jax.agents.mixture import mixture_from_outputs, mixture_size
from apnpql_jax.agents.modules import Constant, Head
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.dists.gmm import GripperGMM
from apnpql_jax.types import (
  ACTION_DIM,
  NUM_PRIMITIVES,
  Array,
  Observation,
)

Params = dict[str, Any]

GROUPS = ("encoder", "ap", "bp", "z", "alpha", "policy")
"""Top level of the parameter tree; the groups an algorithm lacks are left out."""


@dataclasses.dataclass(frozen=True)
class Networks:
  """The modules, one per group."""

  modules: dict[str, nn.Module]
  evaluation: Evaluation
  config: AgentConfig

  def init(self, key: Array, observation: Observation) -> Params:
    """Fresh parameters, one entry per module, from an example batch."""
    keys = dict(zip(GROUPS, jax.random.split(key, len(GROUPS)), strict=True))
    batch = observation.robot.shape[:-1]
    phi = jnp.zeros((*batch, self.config.feature_dim))
    inputs: dict[str, tuple[Any, ...]] = dict.fromkeys(GROUPS, (phi,))
    inputs["encoder"] = (observation,)
    inputs["z"] = (phi, jnp.zeros((1, *batch, ACTION_DIM)))
    return {k: m.init(keys[k], *inputs[k])["params"] for k, m in self.modules.items()}

  def at(self, params: Params, observation: Observation) -> Heads:
    """The heads at a batch of states; the encoder runs here, and only here."""
    phi = self.apply("encoder", params, observation)
    return Heads(self, params, phi)

  def apply(self, group: str, params: Params, *inputs: Any) -> Any:
    """What the module of ``group`` makes of ``inputs``."""
    return self.modules[group].apply({"params": params[group]}, *inputs)


@dataclasses.dataclass(frozen=True)
class Heads:
  """Networks, parameters and features bound together: all predictions at ``*b`` states.

  Which prediction trains what is settled here: prior, policy and alpha read phi
  without training it, for the loss of the E-step names neither (paper Eq. 10).
  """

  networks: Networks
  params: Params
  phi: Array  # f32[*b, feature_dim]

  @property
  def config(self) -> AgentConfig:
    """The settings of the networks."""
    return self.networks.config

  def frozen(self) -> Heads:
    """The same predictions; no gradient reaches the parameters."""
    params, phi = jax.lax.stop_gradient((self.params, self.phi))
    return dataclasses.replace(self, params=params, phi=phi)

  def primitives(self) -> Array:
    """Predicted action primitives theta^ap, f32[*b, 3, 7]: joint velocities in rad/s,
    unbounded, and the logit of closing the gripper.

    The labels lie within [-1, 1], often on the border, where a squashed output
    would lose its gradient.
    """
    flat = self._apply("ap", self.phi)
    return flat.reshape(*self.phi.shape[:-1], NUM_PRIMITIVES, ACTION_DIM)

  def prior(self) -> GripperGMM:
    """Behaviour prior b_theta; its gradient reaches the bp group alone.

    Means are the predicted primitives within the action box (paper Sec. IV-A). The
    M-step trains what is left of theta and must move neither them nor phi.
    """
    learned_mean = self.config.prior_mean == "learned"
    return mixture_from_outputs(
      self._apply("bp", jax.lax.stop_gradient(self.phi)),
      None if learned_mean else self.frozen().primitives(),
      num=NUM_PRIMITIVES,
      min_std=self.config.min_std,
      initial_std=self.config.initial_std,
      max_std=self.config.max_std,
      min_prob=self.config.min_prob,
      diagonal=self.config.diagonal_covariance,
    )

  def policy(self) -> GripperGMM:
    """Parametric policy pi_psi, of one component; trains the policy group alone.

    Like the prior it is not squashed: draws are clipped where Q and the arm see them.
    """
    return mixture_from_outputs(
      self._apply("policy", jax.lax.stop_gradient(self.phi)),
      None,
      num=1,
      min_std=self.config.policy_min_std,
      initial_std=self.config.policy_initial_std,
      max_std=self.config.policy_max_std,
      min_prob=self.config.policy_min_prob,
      diagonal=self.config.diagonal_covariance,
    )

  def alpha(self) -> Array:
    """Temperature of each state, f32[*b] > 0; trains its own head only."""
    offset = math.log(math.expm1(self.config.initial_alpha))  # Inverse of softplus.
    if self.config.temperature == "fixed":
      raw = jnp.zeros(self.phi.shape[:-1])
    else:
      raw = self._apply("alpha", jax.lax.stop_gradient(self.phi))[..., 0]
    return jax.nn.softplus(raw + offset) + self.config.min_alpha

  def z(self, actions: Array) -> Array:
    """Outputs of the value head: f32[S, *b, 7] -> f32[S, *b, n]."""
    return self._apply("z", self.phi, actions)

  def q(self, actions: Array) -> Array:
    """Expected return: f32[S, *b, 7] -> f32[S, *b]."""
    return self.networks.evaluation.value(self.z(actions))

  def _apply(self, group: str, *inputs: Array) -> Any:
    return self.networks.apply(group, self.params, *inputs)


def make_networks(
  config: AgentConfig, groups: tuple[str, ...], evaluation: Evaluation
) -> Networks:
  """The modules of the paper's Fig. 2, those of ``groups``, sized by ``config``."""
  hidden = config.hidden
  learned_mean = config.prior_mean == "learned"
  modules = {
    "encoder": Encoder(
      config.feature_dim,
      (config.patch_channels, config.conv_channels),
      config.conv_overlap,
      config.residual_blocks,
      config.global_features,
      config.wrist_features,
      config.lstm_instants,
    ),
    "ap": Head(hidden, NUM_PRIMITIVES * ACTION_DIM),
    "bp": Head(hidden, NUM_PRIMITIVES * mixture_size(own_mean=learned_mean)),
    "z": evaluation.head(hidden),
    "alpha": Constant() if config.temperature == "shared" else Head(hidden, 1),
    "policy": Head(hidden, mixture_size(own_mean=True)),
  }
  return Networks({k: modules[k] for k in groups}, evaluation, config)
