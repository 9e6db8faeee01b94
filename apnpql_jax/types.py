"""Pytrees that cross the borders between simulation, agent and replay.

Shapes are written in the comment of each field; ``*b`` stands for any leading
batch axes (worlds, or time and worlds). Time suffixes follow rlax: ``_tm1`` is
the state acted upon, ``_t`` the state it led to.
"""

from __future__ import annotations

from flax import struct
import jax

Array = jax.Array
Metrics = dict[str, jax.Array]

ARM_DOF = 6
"""Joints of the UR5e."""

ACTION_DIM = ARM_DOF + 1
"""Six desired joint velocities in rad/s within [-1, 1], then the gripper command
in {0 = open, 1 = close}."""

NUM_PRIMITIVES = 3
"""Target object, desired goal, neutral configuration (paper Sec. V-A)."""


class Observation(struct.PyTreeNode):
  """What the agent sees (paper Sec. V-A). Absent modalities are ``None``.

  To an agent with an LSTM the last of ``*b`` is that of L instants, oldest first.
  """

  robot: Array  # f32[*b, 21]: last three (6 joint, gripper angle), newest last, rad
  tool: Array | None = None  # f32[*b, 3]: tool position by forward kinematics, m
  global_image: Array | None = None  # u8[*b, H, W, 3], EnvConfig.global_size
  wrist_image: Array | None = None  # u8[*b, H, W, 3], EnvConfig.wrist_size
  objects: Array | None = None  # f32[*b, 3 k]: k points, m, only under --obs state


class TimeStep(struct.PyTreeNode):
  """One instant of one world. Terminal instants are kept; the next one is a reset."""

  observation: Observation  # [*b, ...]
  reward: Array  # f32[*b]: received on arriving here
  terminated: Array  # bool[*b]: arrived by success; do not bootstrap
  truncated: Array  # bool[*b]: arrived by time-out; bootstrap
  primitives: Array  # f32[*b, 3, 7]: privileged labels of the primitives, actions

  @property
  def last(self) -> Array:
    """bool[*b]: the episode ended here; an action taken here is ignored."""
    return self.terminated | self.truncated


class Slot(struct.PyTreeNode):
  """One instant of one world and what was done there."""

  timestep: TimeStep  # [*b, ...]
  action: Array  # f32[*b, 7]: action_t, as executed; ignored where the step is last
  log_prob: Array  # f32[*b]: of action_t under the policy that acted


class Transition(struct.PyTreeNode):
  """An N-step transition as the learner consumes it."""

  observation_tm1: Observation  # [B, ...]
  action_tm1: Array  # f32[B, 7]
  reward_t: Array  # f32[B]: discounted sum of up to N rewards
  discount_t: Array  # f32[B]: gamma^m, zero where the episode terminated
  observation_t: Observation  # [B, ...]: state to bootstrap from
  primitives_tm1: Array  # f32[B, 3, 7]: labels of the action primitives
  weight: Array  # f32[B]: one where the transition is real, zero where it is not
  window: Slot | None = None  # [B, N, ...]: the instants 1 to N after _tm1
