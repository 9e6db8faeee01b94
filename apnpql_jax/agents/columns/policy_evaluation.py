"""Policy evaluation (Table I, last column): what the value head is, and its target.

All estimate E_pi of the return; no entropy enters the value (paper Sec. V-B). Each
reads the N-step transition of the replay, so that TD(0) proper is ``n_step`` = 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import dataclasses
from typing import ClassVar, Protocol

from flax import linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.agents import losses
from apnpql_jax.agents.columns.candidates import Candidates
from apnpql_jax.agents.heads import Heads
from apnpql_jax.agents.modules import TwinValueHeads, ValueHead
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.dists import categorical
from apnpql_jax.types import Array, Observation, Transition

TargetPolicy = Callable[[Observation], tuple[Heads, Candidates]]
"""The target network's heads and its policy at any states."""


class Evaluation(Protocol):
  """How values are represented and learnt."""

  windows: ClassVar[bool]
  """True if the target needs all N instants of a transition (``Transition.window``)."""

  def head(self, hidden: Sequence[int]) -> nn.Module:
    """The value head, (phi f32[*b, m], actions f32[S, *b, 7]) -> f32[S, *b, n]."""
    ...

  def value(self, outputs: Array) -> Array:
    """Q: f32[*b, n] -> f32[*b]."""
    ...

  def target(self, look: TargetPolicy, batch: Transition) -> Array:
    """What ``loss`` compares outputs to: f32[B] or f32[B, n], without gradient."""
    ...

  def loss(self, outputs: Array, target: Array) -> Array:
    """L^Q: f32[B, n] and a target -> f32[B]."""
    ...

  def expected(self, target: Array) -> Array:
    """Mean return of a target, f32[B]."""
    ...


@dataclasses.dataclass(frozen=True)
class Categorical:
  """Distributional, on fixed atoms (paper Eq. 8)."""

  config: AgentConfig
  windows: ClassVar[bool] = False

  @property
  def atoms(self) -> Array:
    """Returns that the outputs are logits of, f32[num_atoms]."""
    config = self.config
    return categorical.support(
      v_min=config.v_min, v_max=config.v_max, num_atoms=config.num_atoms
    )

  def head(self, hidden: Sequence[int]) -> nn.Module:
    """See ``Evaluation``."""
    config = self.config
    atoms = np.linspace(config.v_min, config.v_max, config.num_atoms)
    initial = categorical.broadest_logits(config.initial_value, atoms)
    return ValueHead(hidden, tuple(initial))

  def value(self, outputs: Array) -> Array:
    """See ``Evaluation``."""
    return categorical.mean(jax.nn.softmax(outputs), self.atoms)

  def target(self, look: TargetPolicy, batch: Transition) -> Array:
    """See ``Evaluation``."""
    _, policy = look(batch.observation_t)
    return losses.value_target(
      policy.outputs, policy.weights, batch.reward_t, batch.discount_t, self.atoms
    )

  def loss(self, outputs: Array, target: Array) -> Array:
    """See ``Evaluation``."""
    return losses.q_loss(outputs, target)

  def expected(self, target: Array) -> Array:
    """See ``Evaluation``."""
    return categorical.mean(target, self.atoms)


@dataclasses.dataclass(frozen=True)
class TD0:
  """One number, regressed on r + gamma E_pi[Q(s', a')]."""

  config: AgentConfig
  windows: ClassVar[bool] = False

  def head(self, hidden: Sequence[int]) -> nn.Module:
    """See ``Evaluation``."""
    return ValueHead(hidden, (self.config.initial_value,))

  def value(self, outputs: Array) -> Array:
    """See ``Evaluation``."""
    return outputs[..., 0]

  def target(self, look: TargetPolicy, batch: Transition) -> Array:
    """See ``Evaluation``."""
    _, policy = look(batch.observation_t)
    target = batch.reward_t + batch.discount_t * policy.value
    return jax.lax.stop_gradient(target)

  def loss(self, outputs: Array, target: Array) -> Array:
    """See ``Evaluation``."""
    return 0.5 * jnp.sum(jnp.square(outputs - target[..., None]), axis=-1)

  def expected(self, target: Array) -> Array:
    """See ``Evaluation``."""
    return target


class ClippedDoubleQ(TD0):
  """Two heads, regressed on one target with the smaller of both (Fujimoto 2018)."""

  def head(self, hidden: Sequence[int]) -> nn.Module:
    """See ``Evaluation``."""
    return TwinValueHeads(hidden, (self.config.initial_value,) * 2)

  def value(self, outputs: Array) -> Array:
    """See ``Evaluation``."""
    return jnp.min(outputs, axis=-1)


class Retrace(TD0):
  """Off-policy corrected N-step returns, lambda = 1 (Munos 2016)."""

  windows: ClassVar[bool] = True

  def target(self, look: TargetPolicy, batch: Transition) -> Array:
    """See ``Evaluation``."""
    window = batch.window
    if window is None:
      raise ValueError("Retrace needs transitions with a window")
    step = window.timestep
    heads, policy = look(step.observation)
    actions = window.action[None]
    q_t = heads.q(actions)
    ratio = jnp.exp(policy.log_prob(actions, q_t)[0] - window.log_prob)
    return losses.retrace_target(
      step.reward,
      self.config.gamma * (1.0 - step.terminated),
      policy.value,
      q_t[0],
      jnp.where(step.last, 0.0, jnp.minimum(ratio, 1.0)),
    )
