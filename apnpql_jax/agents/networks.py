"""The networks and all their predictions (paper Fig. 2 and Sec. IV-B).

The features phi are computed once per observation. The groups of parameters are
encoder, ap (predicted primitives), z (value), alpha and, depending on the algorithm,
bp (the rest of the prior) and policy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import dataclasses
import math
from typing import Any

from flax import linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float, PRNGKeyArray

from apnpql_jax.agents.encoder import Encoder
from apnpql_jax.agents.layers import MLP, PRODUCTS, Constant
from apnpql_jax.agents.mixture_head import (
  mixture_from_outputs,
  mixture_size,
  one_way_clip,
  spread_means,
)
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.dists.gmm import GripperGMM
from apnpql_jax.types import ACTION_DIM, NUM_PRIMITIVES, Array, Observation

Params = dict[str, Any]  # by group; groups that an algorithm lacks are absent
GROUPS = ("encoder", "ap", "bp", "z", "alpha", "policy")
_SURE = 10.0  # logit of a true gripper command


@dataclasses.dataclass(frozen=True)
class Networks:
  """The modules, one per group."""

  modules: dict[str, nn.Module]
  value: Callable[[Float[Array, "*b n"]], Float[Array, "*b"]]  # from z's outputs to Q
  config: AgentConfig

  def init(self, key: PRNGKeyArray, observation: Observation) -> Params:
    """Initializes parameters, one entry per module, from an example batch."""
    keys = dict(zip(GROUPS, jax.random.split(key, len(GROUPS)), strict=True))
    batch = observation.robot.shape[:-1]
    phi = jnp.zeros((*batch, self.config.feature_dim))
    inputs: dict[str, tuple[Any, ...]] = dict.fromkeys(GROUPS, (phi,))
    inputs["encoder"] = (observation,)
    inputs["z"] = (phi, jnp.zeros((1, *batch, ACTION_DIM)))
    return {k: m.init(keys[k], *inputs[k])["params"] for k, m in self.modules.items()}

  def at(self, params: Params, observation: Observation) -> Heads:
    """Returns the heads at a batch of states; only this method runs the encoder."""
    true_primitives = observation.primitives
    if true_primitives is not None and self.config.lstm_instants:
      true_primitives = true_primitives[..., -1, :, :]
    phi = self.apply("encoder", params, observation)
    return Heads(self, params, phi, true_primitives)

  def apply(self, group: str, params: Params, *inputs: Any, **options: Any) -> Any:
    """Applies the module of ``group`` to ``inputs``."""
    return self.modules[group].apply({"params": params[group]}, *inputs, **options)


def make_networks(
  config: AgentConfig,
  groups: tuple[str, ...],
  value_head: nn.Module,
  value: Callable[[Float[Array, "*b n"]], Float[Array, "*b"]],
) -> Networks:
  """Builds the modules of ``groups``, with the sizes of ``config``.

  ``value_head`` and ``value`` are those of the policy evaluation.
  """
  hidden, learned_mean = config.hidden, config.prior_mean == "learned"
  modules = {
    "encoder": Encoder(config),
    "ap": MLP(hidden, NUM_PRIMITIVES * ACTION_DIM),
    "bp": _mixture(hidden, NUM_PRIMITIVES, own_mean=learned_mean),
    "z": value_head,
    "alpha": Constant() if config.temperature == "shared" else MLP(hidden, 1),
    "policy": _mixture(hidden, config.policy_components, own_mean=True),
  }
  return Networks({k: modules[k] for k in groups}, value, config)


def _mixture(hidden: Sequence[int], num: int, *, own_mean: bool) -> MLP:
  """Builds the head of a mixture of ``num`` components."""
  size = num * mixture_size(own_mean=own_mean)
  return MLP(hidden, size, spread_means(num) if own_mean else nn.initializers.zeros)


@dataclasses.dataclass(frozen=True)
class Heads:
  """Networks, parameters and features bound together: all predictions at ``*b`` states.

  Each prediction here determines which parameters it trains. Prior, policy and alpha
  read phi without training it: the E-step's loss has none of them (paper Eq. 10).
  """

  networks: Networks
  params: Params
  phi: Float[Array, "*b feature_dim"]
  true_primitives: Float[Array, "*b 3 7"] | None
  """Those of the observation, which replace the predicted ones in the prior."""

  @property
  def config(self) -> AgentConfig:
    """Settings of the networks."""
    return self.networks.config

  def frozen(self) -> Heads:
    """Returns heads with the same predictions but no gradients to parameters."""
    params, phi = jax.lax.stop_gradient((self.params, self.phi))
    return dataclasses.replace(self, params=params, phi=phi)

  def primitives(self) -> Float[Array, "*b 3 7"]:
    """Predicts the action primitives theta^ap: velocities in rad/s, logit of closing.

    They are unbounded: labels often lie at the bounds of [-1, 1], where a squashed
    output would lose its gradient.
    """
    flat = self._apply("ap", self.phi)
    found = flat.reshape(*self.phi.shape[:-1], NUM_PRIMITIVES, ACTION_DIM)
    return found if self.config.primitive_gripper else found.at[..., -1].set(0.0)

  def prior(self) -> GripperGMM:
    """Returns the behavior prior b_theta; trains only the bp group.

    Means are the predicted primitives, or the true ones if they are given, clipped to
    the action box (paper Sec. IV-A). The M-step trains the rest of theta and must move
    neither the means nor phi.
    """
    learned_mean = self.config.prior_mean == "learned"
    return mixture_from_outputs(
      self._apply("bp", jax.lax.stop_gradient(self.phi)),
      None if learned_mean else self._means(),
      num=NUM_PRIMITIVES,
      min_std=self.config.min_std,
      initial_std=self.config.initial_std,
      max_std=self.config.max_std,
      min_prob=self.config.min_prob,
      diagonal=self.config.diagonal_covariance,
      gripper_offset=learned_mean or self.config.gripper_offset,
    )

  def policy(self) -> GripperGMM:
    """Returns the policy pi_psi, a mixture, not squashed; trains only its group."""
    return mixture_from_outputs(
      self._apply("policy", jax.lax.stop_gradient(self.phi)),
      None,
      num=self.config.policy_components,
      min_std=self.config.policy_min_std,
      initial_std=self.config.policy_initial_std,
      max_std=self.config.policy_max_std,
      min_prob=self.config.policy_min_prob,
      diagonal=self.config.diagonal_covariance,
    )

  def alpha(self) -> Float[Array, "*b"]:
    """Returns the temperature > 0 of each state; trains only its own head."""
    initial, lowest = self.config.initial_alpha, self.config.min_alpha
    raw = jnp.zeros(())
    if self.config.temperature != "fixed":
      raw = self._apply("alpha", jax.lax.stop_gradient(self.phi))[..., 0]
    if self.config.alpha_floor == "clip":
      log_alpha = raw + math.log(initial)
      alpha = jnp.exp(one_way_clip(log_alpha, math.log(lowest), math.inf))
    else:
      # Inverse of softplus, which does not overflow.
      offset = initial + math.log(-math.expm1(-initial))
      alpha = jax.nn.softplus(raw + offset) + lowest
    return jnp.broadcast_to(alpha, self.phi.shape[:-1])

  def z(
    self, actions: Float[Array, " s *b 7"], *, precision: str = "float32"
  ) -> Float[Array, " s *b n"]:
    """Returns the outputs of the value head; ``precision`` is a key of ``PRODUCTS``."""
    product = PRODUCTS[precision]
    return self._apply("z", self.phi, actions, product=product)

  def q(self, actions: Float[Array, " s *b 7"]) -> Float[Array, " s *b"]:
    """Returns the expected return."""
    return self.networks.value(self.z(actions))

  def _means(self) -> Float[Array, "*b 3 7"]:
    if (true := self.true_primitives) is None:
      return self.frozen().primitives()
    sure = _SURE if self.config.primitive_gripper else 0.0
    return true.at[..., -1].set(sure * (2.0 * true[..., -1] - 1.0))

  def _apply(self, group: str, *inputs: Array, **options: Any) -> Any:
    return self.networks.apply(group, self.params, *inputs, **options)
