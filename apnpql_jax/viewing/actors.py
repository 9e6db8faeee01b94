"""Actors in a watched world: a trained agent, the scripted expert, or chance."""

from __future__ import annotations

import abc
import dataclasses
from pathlib import Path
from typing import Any

from flax import struct
import jax
import jax.numpy as jnp
from jaxtyping import Float, PRNGKeyArray

from apnpql_jax.agents.explanation import Explanation
from apnpql_jax.config.checks import ACTING
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.errors import FileError, check_name
from apnpql_jax.runs import checkpoint_reader
from apnpql_jax.training import evaluate
from apnpql_jax.types import ARM_DOF, Array


class Decision(struct.PyTreeNode):
  """Actions of an actor at an instant, with what led to them."""

  action: Float[Array, "worlds 7"]
  """The actions."""

  primitives: Float[Array, "worlds 3 7"]
  """Primitives that the actor sees: joint velocities in rad/s, share of closing."""

  explanation: Explanation | None = None
  """What led to the actions; only of a trained agent."""


class Actor(abc.ABC):
  """Base of the actors; those that do not learn have no checkpoints."""

  title: str
  epsilon: float | None = None
  """Limit of the KL divergence, nats."""

  params: Any = None
  """Parameters that ``decide`` takes; the target network's of an agent."""

  step: int | None = None
  """Step of the checkpoint that acts."""

  def __init__(self, env: Env):
    """Keeps the worlds."""
    self.env = env

  @abc.abstractmethod
  def decide(self, params: Any, state: EnvState, key: PRNGKeyArray) -> Decision:
    """Chooses an action per world; a pure function."""

  def steps(self) -> list[int]:
    """Returns the steps of the checkpoints that can be loaded now, newest first."""
    return []

  def load(self, step: int | None) -> None:
    """Lets the checkpoint of this step act, or the newest if None.

    Raises:
      FileError: It cannot be read; the one before stays.
    """
    raise FileError(f"{self.title} has no checkpoints")


class Expert(Actor):
  """The task's scripted expert."""

  title = "scripted expert"

  def decide(self, params: Any, state: EnvState, key: PRNGKeyArray) -> Decision:
    """Follows one of the true primitives."""
    return Decision(self.env.expert_action(state), state.timestep.primitives)


class Random(Actor):
  """Uniformly random actions."""

  title = "random actions"

  def decide(self, params: Any, state: EnvState, key: PRNGKeyArray) -> Decision:
    """Draws joint velocities and gripper commands."""
    arm_key, hand_key = jax.random.split(key)
    worlds = state.elapsed.shape[0]
    arm = jax.random.uniform(arm_key, (worlds, ARM_DOF), minval=-1.0, maxval=1.0)
    close = jax.random.bernoulli(hand_key, 0.5, (worlds, 1)).astype(arm.dtype)
    return Decision(jnp.concatenate([arm, close], -1), state.timestep.primitives)


class Trained(Actor):
  """The agent of a run, which may still be training."""

  def __init__(
    self,
    run_dir: Path,
    *,
    backend: str | None = None,
    step: int | None = None,
    acting: str | None = None,
  ):
    """Loads a run; arguments and errors are those of ``evaluate``."""
    if acting is not None:
      check_name("acting", acting, ACTING)
    found = evaluate.load_trained(run_dir, backend=backend, step=step)
    super().__init__(found.env)
    self._run_dir, self._config, self._agent = run_dir, found.config, found.agent
    self._acting = acting or found.config.eval_acting
    self.params, self.step = found.params, found.step
    self._shapes = jax.eval_shape(lambda: found.params)
    self.epsilon = found.config.agent.epsilon
    self.title = f"{run_dir.name}, {found.config.agent.algorithm} by {self._acting}"

  def decide(self, params: Any, state: EnvState, key: PRNGKeyArray) -> Decision:
    """Explains the action of the agent."""
    observation, acting = state.observation, self._acting
    found = self._agent.explain(params, observation, key, acting=acting)
    close = jax.nn.sigmoid(found.primitives[..., ARM_DOF:])
    primitives = jnp.concatenate([found.primitives[..., :ARM_DOF], close], -1)
    return Decision(found.action, primitives, found)

  def steps(self) -> list[int]:
    """See ``Actor.steps``."""
    return sorted(checkpoint_reader.all_steps(self._run_dir), reverse=True)

  def load(self, step: int | None) -> None:
    """See ``Actor.load``."""
    self.params, self.step = evaluate.load_params(
      self._run_dir, self._config, self._shapes, step
    )


def scripted(what: str, env: EnvConfig) -> Actor:
  """Returns the actor ``expert`` or ``random`` in the worlds of ``env``.

  Its worlds have no images in the observations; the player draws them.
  """
  kinds = {"expert": Expert, "random": Random}
  check_name("actor", what, list(kinds))
  return kinds[what](make_env(dataclasses.replace(env, obs="state")))
