"""Feature extractor and output modules (paper Fig. 2 and Sec. IV-B).

The features phi are computed once per observation and reused for every candidate
action. Parameters live in five groups, so that each can have its own optimiser:
encoder, ap (predicted primitives), bp (rest of the prior), z (value), alpha.
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import functools
import math
from typing import Any

from flax import linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.agents.encoder import Encoder
from apnpql_jax.agents.prior import prior_from_outputs, prior_size
from apnpql_jax.config import AgentConfig
from apnpql_jax.dists import categorical, gmm
from apnpql_jax.types import (
  ACTION_DIM,
  ARM_DOF,
  NUM_PRIMITIVES,
  Array,
  Observation,
)

Params = dict[str, Any]

GROUPS = ("encoder", "ap", "bp", "z", "alpha")
"""Top level of the parameter tree."""


class Head(nn.Module):
  """Hidden relu layers and a linear layer that starts near zero."""

  hidden: Sequence[int]
  out: int

  @nn.compact
  def __call__(self, x: Array) -> Array:
    """f32[*b, n] -> f32[*b, out]."""
    for width in self.hidden:
      x = nn.relu(nn.Dense(width)(x))
    return nn.Dense(self.out, kernel_init=_small, name="out")(x)


class ValueHead(nn.Module):
  """Z_eta: return distribution of many candidate actions of one state.

  The first layer is W_phi phi + W_a a; the large half is computed once per state.
  All further layers see one flat batch, which is one matrix product per layer.
  """

  hidden: Sequence[int]
  initial_logits: Sequence[float]

  @nn.compact
  def __call__(self, phi: Array, actions: Array) -> Array:
    """phi f32[*b, n], actions f32[S, *b, 7] -> logits f32[S, *b, n_atoms]."""
    width, *rest = self.hidden
    from_phi = nn.Dense(width, name="phi")(phi)
    centred = actions.at[..., -1].set(2.0 * actions[..., -1] - 1.0)
    x = nn.Dense(width, use_bias=False, name="action")(centred) + from_phi[None]
    x = nn.relu(x).reshape(-1, width)
    for width in rest:
      x = nn.relu(nn.Dense(width)(x))
    initial = jnp.asarray(self.initial_logits)
    logits = nn.Dense(
      initial.size, kernel_init=_small, bias_init=lambda *_: initial, name="out"
    )(x)
    return logits.reshape(*actions.shape[:-1], initial.size)


@dataclasses.dataclass(frozen=True)
class Networks:
  """The modules and, as pure functions of the parameters, what they predict."""

  modules: dict[str, nn.Module]
  config: AgentConfig

  @property
  def atoms(self) -> Array:
    """Returns the value distribution is over, f32[num_atoms]."""
    config = self.config
    return categorical.support(
      v_min=config.v_min, v_max=config.v_max, num_atoms=config.num_atoms
    )

  def init(self, key: Array, observation: Observation) -> Params:
    """Fresh parameters, one entry per name in ``GROUPS``, from an example batch."""
    keys = dict(zip(GROUPS, jax.random.split(key, len(GROUPS)), strict=True))
    batch = observation.robot.shape[:-1]
    phi = jnp.zeros((*batch, self.config.feature_dim))
    inputs: dict[str, tuple[Any, ...]] = dict.fromkeys(GROUPS, (phi,))
    inputs["encoder"] = (observation,)
    inputs["z"] = (phi, jnp.zeros((1, *batch, ACTION_DIM)))
    return {k: self.modules[k].init(keys[k], *inputs[k])["params"] for k in GROUPS}

  def features(self, params: Params, observation: Observation) -> Array:
    """phi, f32[*b, feature_dim]."""
    return self._apply("encoder", params, observation)

  def primitives(self, params: Params, phi: Array) -> Array:
    """Predicted action primitives theta^ap, f32[*b, 3, 7]: joint velocities in rad/s,
    unbounded, and the logit of closing the gripper.

    The labels lie within [-1, 1], often on the border, where a squashed output
    would lose its gradient.
    """
    flat = self._apply("ap", params, phi)
    return flat.reshape(*phi.shape[:-1], NUM_PRIMITIVES, ACTION_DIM)

  def prior(self, params: Params, phi: Array) -> gmm.GripperGMM:
    """Behaviour prior b_theta; its gradient reaches the bp group alone.

    Means are the predicted primitives within the action box (paper Sec. IV-A). The
    M-step trains what is left of theta and must move neither them nor phi.
    """
    phi = jax.lax.stop_gradient(phi)
    primitives = jax.lax.stop_gradient(self.primitives(params, phi))
    return prior_from_outputs(
      self._apply("bp", params, phi),
      jnp.clip(primitives[..., :ARM_DOF], -1.0, 1.0),
      primitives[..., ARM_DOF],
      min_std=self.config.min_std,
      initial_std=self.config.initial_std,
      max_std=self.config.max_std,
      min_prob=self.config.min_prob,
    )

  def q_logits(self, params: Params, phi: Array, actions: Array) -> Array:
    """Logits of Z(phi, a): f32[*b, n], f32[S, *b, 7] -> f32[S, *b, num_atoms]."""
    return self._apply("z", params, phi, actions)

  def alpha(self, params: Params, phi: Array) -> Array:
    """Temperature of each state, f32[*b] > 0; trains its own head only."""
    raw = self._apply("alpha", params, jax.lax.stop_gradient(phi))[..., 0]
    offset = _inverse_softplus(self.config.initial_alpha)
    return jax.nn.softplus(raw + offset) + self.config.min_alpha

  def _apply(self, group: str, params: Params, *inputs: Any) -> Any:
    return self.modules[group].apply({"params": params[group]}, *inputs)


def make_networks(config: AgentConfig) -> Networks:
  """The modules of the paper's Fig. 2 with the sizes of ``config``."""
  head = functools.partial(Head, config.hidden)
  per_component = prior_size(ARM_DOF)
  atoms = np.linspace(config.v_min, config.v_max, config.num_atoms)
  initial_logits = tuple(categorical.broadest_logits(config.initial_value, atoms))
  modules = {
    "encoder": Encoder(
      config.feature_dim,
      (config.patch_channels, config.conv_channels),
      config.conv_overlap,
    ),
    "ap": head(NUM_PRIMITIVES * ACTION_DIM),
    "bp": head(NUM_PRIMITIVES * per_component),
    "z": ValueHead(config.hidden, initial_logits),
    "alpha": head(1),
  }
  return Networks(modules, config)


def _inverse_softplus(x: float) -> float:
  return math.log(math.expm1(x))


_small = nn.initializers.variance_scaling(1e-4, "fan_in", "truncated_normal")
