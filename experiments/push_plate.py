"""Preset: push a plate to a mark, from pixels, on a 2-core CPU.

Values that differ from the paper were found by experiment; see `experiments/log.md`.
"""

from __future__ import annotations

from apnpql_jax import AgentConfig, EnvConfig, ReplayConfig, TrainConfig

CONFIG = TrainConfig(
  env=EnvConfig(task="push_plate", obs="pixels", backend="auto", worlds=32),
  agent=AgentConfig(
    algorithm="ap_npql",
    n_step=5,
    epsilon=1.0,
    target_samples=30,
    policy_samples=30,
    gripper_offset=True,
    candidate_precision="bfloat16",
    min_alpha=0.01,
    epsilon_nu=-14.0,
    min_std=0.01,
    initial_std=0.03,
    max_std=0.05,
    m_step_delay=500,
    lambda_ap=30.0,
    conv_overlap=False,
    target_rate=0.01,
    global_features="keypoints",
    wrist_features="both",
  ),
  replay=ReplayConfig(
    capacity=25_600, expert_steps=6_400, expert_share=0.5, batch_size=64
  ),
  total_steps=20_480,
  rollout_length=4,
  updates_per_iteration=32,
  eval_every=5_120,
  eval_episodes=64,
  eval_acting="mean",
  checkpoint_every=10_240,
)
