"""One state with two equally good actions: which of them each policy keeps.

  python experiments/results/bimodal_bandit.py

Writes bimodal_bandit.png next to this file. The reward is 1 where the first two joints
move together at 0.6 rad/s in either direction, and falls off around these two peaks.
Three algorithms learn from the same uniformly random actions, with the same KL limit
and networks. The prior is not trained, so that they differ only in the policy, as in
Table I of the paper.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
import numpy as np

from apnpql_jax import AgentConfig, configure, make_agent
from apnpql_jax.types import Array, Observation, Transition

PEAKS = ((0.6, 0.6), (-0.6, -0.6))
"""Velocities of the first two joints, rad/s; the reward ignores the other joints."""

WIDTH = 0.2
"""Distance in rad/s at which the reward has fallen to exp(-1/2)."""

PRIMITIVES = ((0.4, 0.4), (-0.4, -0.4), (0.0, 0.0))
"""Labels of the action primitives: the right directions at too low a speed."""

ALGORITHMS = ("ap_npql", "ap_mpo", "ap_sac")
BATCH = 64
CONFIG = AgentConfig(
  hidden=(32, 32),
  feature_dim=16,
  num_atoms=21,
  learning_rate_e=3e-3,
  learning_rate_m=0.0,
  learning_rate_alpha=3e-3,
  epsilon=1.5,
  target_samples=8,
  policy_samples=48,
  initial_std=0.25,
)


def reward(actions: Array | np.ndarray) -> Array:
  """Returns the rewards f32[*b] in [0, 1] of actions f32[*b, 7]."""
  distance = jnp.square(actions[..., None, :2] - jnp.array(PEAKS)).sum(-1)
  return jnp.exp(-0.5 * distance / WIDTH**2).max(-1)


def nearest(actions: np.ndarray) -> np.ndarray:
  """Returns the index of the peak within two widths of each action, or -1."""
  distance = np.linalg.norm(actions[:, None, :2] - np.array(PEAKS), axis=-1)
  return np.where(distance.min(1) < 2.0 * WIDTH, distance.argmin(1), -1)


def observation(batch: int) -> Observation:
  """Returns a batch of the only state."""
  return Observation(robot=jnp.zeros((batch, 21)))


def transitions(key: PRNGKeyArray) -> Transition:
  """Draws uniformly random actions with their rewards; every episode ends at once."""
  arm, gripper = jax.random.split(key)
  actions = jnp.concatenate(
    [
      jax.random.uniform(arm, (BATCH, 6), minval=-1.0),
      jax.random.bernoulli(gripper, shape=(BATCH, 1)).astype(jnp.float32),
    ],
    axis=-1,
  )
  labels = jnp.zeros((BATCH, 3, 7)).at[..., :2].set(jnp.array(PRIMITIVES)[None])
  return Transition(
    observation_tm1=observation(BATCH),
    action_tm1=actions,
    reward_t=reward(actions),
    discount_t=jnp.zeros(BATCH),
    observation_t=observation(BATCH),
    primitives_tm1=labels,
    weight=jnp.ones(BATCH),
  )


def play(config: AgentConfig, *, updates: int, draws: int, seed: int = 0) -> np.ndarray:
  """Trains on ``updates`` batches, then draws actions f32[draws, 7]."""
  agent = make_agent(config)
  key_init, key_train, key_act = jax.random.split(jax.random.key(seed), 3)

  def update(state, key):
    key_batch, key_update = jax.random.split(key)
    return agent.update(state, transitions(key_batch), key_update)

  @jax.jit
  def run(state):
    state, _ = jax.lax.scan(update, state, jax.random.split(key_train, updates))
    return agent.act(state.params, observation(draws), key_act)[0]

  return np.asarray(run(agent.init(key_init, observation(1))))


def draw(actions: dict[str, np.ndarray], path: Path) -> None:
  """Plots the actions of each algorithm over the reward."""
  import matplotlib

  matplotlib.use("Agg")
  import matplotlib.pyplot as plt

  axis = np.linspace(-1.0, 1.0, 101)
  grid = np.stack(np.meshgrid(axis, axis), axis=-1)
  figure, axes = plt.subplots(
    1, len(actions), figsize=(4 * len(actions), 4.3), sharey=True, layout="constrained"
  )
  for ax, (name, drawn) in zip(axes, actions.items(), strict=True):
    ax.contourf(axis, axis, reward(grid), levels=12, cmap="Grays")
    ax.plot(*drawn[:, :2].T, "o", ms=2.5, alpha=0.35, color="tab:blue", mew=0)
    peak = nearest(drawn)
    ax.set_title(
      f"{name}: mean reward {np.mean(reward(drawn)):.2f}\nat the peaks "
      f"{np.mean(peak == 0):.0%} and {np.mean(peak == 1):.0%} of the actions"
    )
    ax.set_xlabel("joint 1, rad/s")
    ax.set_aspect("equal")
    ax.set_xticks(np.linspace(-1.0, 1.0, 5))
  axes[0].set_ylabel("joint 2, rad/s")
  figure.savefig(path, dpi=110)


def main() -> None:
  """Trains the three algorithms and plots their actions."""
  configure()
  actions = {
    name: play(dataclasses.replace(CONFIG, algorithm=name), updates=2000, draws=1000)
    for name in ALGORITHMS
  }
  draw(actions, Path(__file__).with_suffix(".png"))


if __name__ == "__main__":
  main()
