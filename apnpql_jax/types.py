"""Pytrees that cross the borders between simulation, agent and replay.

Shapes in annotations are jaxtyping's and are not checked at run time. ``*b`` stands for
any leading batch axes (worlds, or time and worlds); floats are float32. Time suffixes
follow rlax: ``_tm1`` is the state acted upon, ``_t`` the state it led to.
"""

from __future__ import annotations

from flax import struct
import jax
from jaxtyping import Bool, Float, UInt8

Array = jax.Array
Metrics = dict[str, jax.Array]

ARM_DOF = 6  # joints of the UR5e
ACTION_DIM = ARM_DOF + 1  # joint velocities in [-1, 1] rad/s, gripper (1 closes)
NUM_PRIMITIVES = 3  # object, goal, neutral configuration (paper Sec. V-A)


class Observation(struct.PyTreeNode):
  """An observation of the agent (paper Sec. V-A). Absent modalities are ``None``.

  For an agent with an LSTM the last axis of ``*b`` is L instants, oldest first.
  """

  robot: Float[Array, "*b 21"]  # last 3 states (6 joints, gripper), newest last, rad
  tool: Float[Array, "*b 3"] | None = None  # position by forward kinematics, m
  global_image: UInt8[Array, "*b H W 3"] | None = None  # of EnvConfig.global_size
  wrist_image: UInt8[Array, "*b H W 3"] | None = None  # of EnvConfig.wrist_size
  objects: Float[Array, "*b 3*k"] | None = None  # k points, m; only with --obs state


class TimeStep(struct.PyTreeNode):
  """One instant of one world. Terminal instants are kept; the next one is a reset."""

  observation: Observation
  reward: Float[Array, "*b"]  # received on arrival at this instant
  terminated: Bool[Array, "*b"]  # ended by success; do not bootstrap
  truncated: Bool[Array, "*b"]  # ended by time-out; bootstrap
  primitives: Float[Array, "*b 3 7"]  # privileged labels: an action per primitive

  @property
  def last(self) -> Bool[Array, "*b"]:
    """Whether the episode ended here; an action taken here is ignored."""
    return self.terminated | self.truncated


class Slot(struct.PyTreeNode):
  """One instant of one world and the action taken there."""

  timestep: TimeStep
  action: Float[Array, "*b 7"]  # action_t, as executed; ignored at the last instant
  log_prob: Float[Array, "*b"]  # of action_t under the policy that acted


class Transition(struct.PyTreeNode):
  """An N-step transition as the learner consumes it."""

  observation_tm1: Observation
  action_tm1: Float[Array, "B 7"]
  reward_t: Float[Array, " B"]  # discounted sum of up to N rewards
  discount_t: Float[Array, " B"]  # gamma^m, zero where the episode terminated
  observation_t: Observation  # of the state to bootstrap from
  primitives_tm1: Float[Array, "B 3 7"]  # labels of the action primitives
  weight: Float[Array, " B"]  # one for real transitions, zero for others
  window: Slot | None = None  # [B, N, ...]: the instants 1 to N after _tm1
