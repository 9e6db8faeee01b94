"""Pytrees passed between simulation, agent and replay.

Shapes in annotations are jaxtyping's and are not checked at run time. ``*b`` stands for
any leading batch axes (worlds, or time and worlds); floats are float32. Time suffixes
follow rlax: ``_tm1`` is the state acted upon, ``_t`` the state it led to.

An instant is a point in time at which a world is observed and an action is chosen. The
physics between two instants takes one control period, the time of one action. An
episode of T control periods has the instants 0 to T. An environment step is one control
period of one world.
"""

from __future__ import annotations

from typing import Any

from flax import struct
import jax
from jaxtyping import Bool, Float, UInt8

Array = jax.Array
Metrics = dict[str, jax.Array]

ARM_DOF = 6  # joints of the UR5e
# Joint velocities in [-1, 1] rad/s, then the gripper: 0 opens, 1 closes, both at full
# speed. The motors clip all of them.
ACTION_DIM = ARM_DOF + 1
PRIMITIVES = ("object", "goal", "neutral")  # paper Sec. V-A
NUM_PRIMITIVES = len(PRIMITIVES)


class Observation(struct.PyTreeNode):
  """An observation of the agent (paper Sec. V-A). Absent modalities are ``None``.

  For an agent with an LSTM the last axis of ``*b`` is L instants, oldest first.
  """

  robot: Float[Array, "*b 21"]
  """Last 3 robot states (6 joints, gripper), newest last, rad."""

  tool: Float[Array, "*b 3"] | None = None
  """Position of the tool by forward kinematics, m."""

  global_image: UInt8[Array, "*b H W 3"] | None = None
  """Image of the global camera, of size ``EnvConfig.global_size``."""

  wrist_image: UInt8[Array, "*b H W 3"] | None = None
  """Image of the wrist camera, of size ``EnvConfig.wrist_size``."""

  objects: Float[Array, "*b 3*k"] | None = None
  """The k points of ``Task.objects``, m; only with ``--obs state``."""

  primitives: Float[Array, "*b 3 7"] | None = None
  """The labels of ``TimeStep``; only with ``env.true_primitives``."""

  def present(self) -> dict[str, Any]:
    """Returns the modalities that are not absent, by name."""
    return {name: x for name, x in vars(self).items() if x is not None}


class TimeStep(struct.PyTreeNode):
  """One instant of one world. Terminal instants are kept; the next one is a reset."""

  observation: Observation
  """Input of the agent."""

  reward: Float[Array, "*b"]
  """Reward received on arrival at this instant."""

  terminated: Bool[Array, "*b"]
  """Whether success ended the episode here; do not bootstrap."""

  truncated: Bool[Array, "*b"]
  """Whether a time-out ended the episode here; bootstrap."""

  primitives: Float[Array, "*b 3 7"]
  """Privileged labels: an action per primitive."""

  expert: Float[Array, "*b 7"] | None = None
  """Privileged label: the scripted expert's action; only for rows that imitate it."""

  @property
  def last(self) -> Bool[Array, "*b"]:
    """Whether the episode ended here; an action taken here is ignored."""
    return self.terminated | self.truncated


class Slot(struct.PyTreeNode):
  """One instant of one world and the action taken there."""

  timestep: TimeStep
  """The instant."""

  action: Float[Array, "*b 7"]
  """The action as executed; ignored at the last instant of an episode."""

  log_prob: Float[Array, "*b"]
  """Log density of the action under the policy that acted, nats."""


class Transition(struct.PyTreeNode):
  """An N-step transition as the learner consumes it."""

  observation_tm1: Observation
  """Observation of the state acted upon."""

  action_tm1: Float[Array, "B 7"]
  """Action taken there."""

  reward_t: Float[Array, " B"]
  """Discounted sum of up to N rewards."""

  discount_t: Float[Array, " B"]
  """gamma^m for m rewards, zero where the episode terminated."""

  observation_t: Observation
  """Observation of the state to bootstrap from."""

  primitives_tm1: Float[Array, "B 3 7"]
  """Labels of the action primitives at the state acted upon."""

  weight: Float[Array, " B"]
  """One for real transitions, zero for others."""

  window: Slot | None = None
  """[B, N, ...]: the instants 1 to N after the state acted upon."""

  expert_tm1: Float[Array, "B 7"] | None = None
  """The scripted expert's action at the state acted upon."""
