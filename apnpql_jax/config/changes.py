"""Settings that may change at a resume, or in a new run with the weights of another."""

from __future__ import annotations

from typing import Any

from apnpql_jax.config.files import config_diff, format_diff
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import ConfigError

REPORTS = (
  "total_steps eval_every eval_episodes eval_acting checkpoint_every "
  "keep_checkpoints save_replay_every max_skipped_updates video sinks "
  "wandb_project wandb_entity wandb_id"
).split()
"""Settings that do not affect learning."""

LEARNING = (
  "agent.learning_rate_e agent.learning_rate_m agent.learning_rate_alpha "
  "agent.learning_rate_nu agent.decay_updates agent.target_rate agent.target_samples "
  "agent.policy_samples agent.candidate_precision agent.epsilon agent.image_shift "
  "agent.color_jitter replay.batch_size replay.expert_share rollout_length "
  "updates_per_iteration"
).split()
"""Settings that affect learning, but neither the shape nor the meaning of the state."""

MAY_CHANGE = (*REPORTS, *LEARNING)
"""Settings that a resumed run may change."""

OF_WEIGHTS = (
  "agent.algorithm agent.policy_evaluation agent.regularizer agent.prior_mean "
  "agent.temperature agent.alpha_floor agent.diagonal_covariance "
  "agent.policy_components agent.hidden agent.num_atoms agent.feature_dim "
  "agent.patch_channels agent.conv_channels agent.conv_overlap agent.residual_blocks "
  "agent.lstm_instants agent.standardize_images agent.global_features "
  "agent.wrist_features env.obs env.global_size env.wrist_size"
).split()
"""Settings that decide which arrays the weights are, or what they read."""


def check_resumed(saved: TrainConfig, wanted: TrainConfig, run: str) -> None:
  """Checks that a run may resume with these settings.

  Raises:
    ConfigError: Settings outside of ``MAY_CHANGE`` differ; the message lists each, and
      the cure.
  """
  if fixed := _fixed(saved, wanted):
    cure = "start a new run"
    if not fixed.keys() & set(OF_WEIGHTS):
      cure += f" with its weights: --init-from {run}"
    raise ConfigError(
      f"{run!r} was made with other settings: {format_diff(fixed)}; resume it without "
      f"them (docs/run_folder.md lists those that may change), or {cure}"
    )


def fixed_diff(saved: TrainConfig, wanted: TrainConfig) -> str:
  """Returns the differences outside of ``MAY_CHANGE`` as one line, "" if none."""
  return format_diff(_fixed(saved, wanted))


def _fixed(saved: TrainConfig, wanted: TrainConfig) -> dict[str, tuple[Any, Any]]:
  diff = config_diff(saved, wanted)
  return {name: x for name, x in diff.items() if name not in MAY_CHANGE}


def weights_diff(saved: TrainConfig, wanted: TrainConfig) -> dict[str, Any]:
  """Returns the differences that may prevent the weights from fitting.

  The observed object points, and so the first layer, are those of the task.
  """
  diff = config_diff(saved, wanted)
  names = [*OF_WEIGHTS, *(["env.task"] if saved.env.obs == "state" else [])]
  return {name: diff[name] for name in names if name in diff}
