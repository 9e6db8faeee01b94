"""All predictions at a batch of states (paper Fig. 2 and Sec. IV-B)."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import math
from typing import Any

from flax import linen as nn
import jax
import jax.numpy as jnp

from apnpql_jax.agents.mixture_head import mixture_from_outputs
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
  value: Callable[[Array], Array]
  """Outputs of the value head f32[*b, n] -> Q f32[*b]."""

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
    """Behavior prior b_theta; its gradient reaches the bp group alone.

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
    return self.networks.value(self.z(actions))

  def _apply(self, group: str, *inputs: Array) -> Any:
    return self.networks.apply(group, self.params, *inputs)
