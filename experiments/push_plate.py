"""Push a plate to a mark, from pixels, on a 2-core CPU."""

from __future__ import annotations

from apnpql_jax.config import AgentConfig, EnvConfig, ReplayConfig, TrainConfig

CONFIG = TrainConfig(
  env=EnvConfig(task="push_plate", obs="pixels", backend="auto", worlds=32),
  agent=AgentConfig(algorithm="ap_npql"),
  replay=ReplayConfig(
    capacity=51_200, expert_steps=6_400, expert_share=0.25, batch_size=64
  ),
  total_steps=200_000,
  rollout_length=8,
  updates_per_iteration=16,
)
