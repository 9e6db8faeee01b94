"""Policy evaluation (Table I, last column): the value head and its target.

Every target estimates the N-step return under pi, without entropy (paper Sec. V-B).
TD(0) proper is therefore ``n_step`` = 1.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
import dataclasses
from typing import ClassVar

from flax import linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float
import numpy as np

from apnpql_jax.agents import losses
from apnpql_jax.agents.columns.candidates import Candidates, score
from apnpql_jax.agents.layers import TwinValueHeads, ValueHead
from apnpql_jax.agents.networks import Heads
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.dists import categorical
from apnpql_jax.types import Array, Observation, Transition

# (states) -> the target network's heads and policy there.
TargetPolicy = Callable[[Observation], tuple[Heads, Candidates]]


@dataclasses.dataclass(frozen=True)
class PolicyEvaluation(abc.ABC):
  """A representation of values and the way in which they are learned."""

  config: AgentConfig
  windows: ClassVar[bool] = False  # whether the target needs ``Transition.window``

  @abc.abstractmethod
  def head(self, hidden: Sequence[int]) -> nn.Module:
    """Builds the value head; see ``layers.ValueHead`` for its inputs and outputs."""

  @abc.abstractmethod
  def value(self, outputs: Float[Array, "*b n"]) -> Float[Array, "*b"]:
    """Converts outputs of the value head to Q."""

  @abc.abstractmethod
  def target(self, policy_at: TargetPolicy, batch: Transition) -> Float[Array, " B *n"]:
    """Computes the target of the outputs, without gradient."""

  @abc.abstractmethod
  def loss(
    self, outputs: Float[Array, "B n"], target: Float[Array, " B *n"]
  ) -> Float[Array, " B"]:
    """Computes L^Q."""

  def expected(self, target: Float[Array, " B *n"]) -> Float[Array, " B"]:
    """Returns the mean return of a target: by default the target itself."""
    return target


class Categorical(PolicyEvaluation):
  """Return distributions on fixed atoms (paper Eq. 8)."""

  @property
  def atoms(self) -> Float[Array, " n"]:
    """Support of the distributions."""
    config = self.config
    return categorical.support(
      v_min=config.v_min, v_max=config.v_max, num_atoms=config.num_atoms
    )

  def head(self, hidden: Sequence[int]) -> nn.Module:
    """Builds a head whose distribution starts broad with mean ``initial_value``."""
    config = self.config
    atoms = np.linspace(config.v_min, config.v_max, config.num_atoms)
    initial = categorical.broadest_logits(config.initial_value, atoms)
    return ValueHead(hidden, tuple(initial))

  def value(self, outputs: Array) -> Array:
    """Returns the mean of the distribution."""
    return categorical.mean(jax.nn.softmax(outputs), self.atoms)

  def target(self, policy_at: TargetPolicy, batch: Transition) -> Array:
    """Projects the return distribution under the policy onto the atoms."""
    _, policy = policy_at(batch.observation_t)
    return losses.value_target(
      policy.outputs, policy.weights, batch.reward_t, batch.discount_t, self.atoms
    )

  def loss(self, outputs: Array, target: Array) -> Array:
    """Computes the cross-entropy."""
    return losses.q_loss(outputs, target)

  def expected(self, target: Array) -> Array:
    """Returns the mean of the target distribution."""
    return categorical.mean(target, self.atoms)


class TD0(PolicyEvaluation):
  """A scalar value, regressed on r + gamma E_pi[Q(s', a')]."""

  def head(self, hidden: Sequence[int]) -> nn.Module:
    """Builds a head of one output that starts at ``initial_value``."""
    return ValueHead(hidden, (self.config.initial_value,))

  def value(self, outputs: Array) -> Array:
    """Returns the single output."""
    return outputs[..., 0]

  def target(self, policy_at: TargetPolicy, batch: Transition) -> Array:
    """Bootstraps from the policy's value at s'."""
    _, policy = policy_at(batch.observation_t)
    return jax.lax.stop_gradient(batch.reward_t + batch.discount_t * policy.value)

  def loss(self, outputs: Array, target: Array) -> Array:
    """Computes half the squared error, summed over outputs."""
    return 0.5 * jnp.sum(jnp.square(outputs - target[..., None]), axis=-1)


class ClippedDoubleQ(TD0):
  """Two heads, regressed on one target with the smaller of both (Fujimoto 2018)."""

  def head(self, hidden: Sequence[int]) -> nn.Module:
    """Builds two heads of one output each."""
    return TwinValueHeads(hidden, (self.config.initial_value,) * 2)

  def value(self, outputs: Array) -> Array:
    """Returns the smaller output."""
    return jnp.min(outputs, axis=-1)


class Retrace(TD0):
  """Off-policy corrected N-step returns, lambda = 1 (Munos 2016)."""

  windows = True

  def target(self, policy_at: TargetPolicy, batch: Transition) -> Array:
    """Corrects the return of the window with importance ratios of at most one."""
    window = batch.window
    if window is None:
      raise ValueError("Retrace needs transitions with a window")
    step = window.timestep
    heads, policy = policy_at(step.observation)
    actions = window.action[None]
    q_t = score(heads, actions)[2]
    ratio = jnp.exp(policy.log_prob(actions, q_t)[0] - window.log_prob)
    return losses.retrace_target(
      step.reward,
      self.config.gamma * (1.0 - step.terminated),
      policy.value,
      q_t[0],
      jnp.where(step.last, 0.0, jnp.minimum(ratio, 1.0)),
    )
