"""What a configuration must satisfy, checked before anything is built.

Knows no task and no algorithm: what is valid is handed in, so that reading a
configuration never imports the simulator or the learner.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math

from apnpql_jax.config import codec
from apnpql_jax.config.ranges import validate_ranges
from apnpql_jax.config.schema import AgentConfig, EnvConfig, TrainConfig
from apnpql_jax.errors import ConfigError, check_name

BACKENDS = ("auto", "mjx", "native")
OBSERVATIONS = ("pixels", "state")
TEMPERATURES = ("state", "shared", "fixed")
REGULARIZERS = ("row", "uniform")
EVALUATIONS = ("row", "categorical", "td0", "retrace", "clipped_double_q")
PRIOR_MEANS = ("primitives", "learned")
IMAGE_FEATURES = ("map", "keypoints", "both")

MIN_BANK_ROWS = 16
MAX_SHIFT = 16
"""Pixels."""
MAX_SIDE = 1024
"""Pixels."""
MAX_INSTANTS = 32
"""A third of an episode of 14 s; a batch has so many times the images."""

_OTHER_BYTES = 4 * (21 + 3 + 7 + 21 + 2) + 2
"""Robot state, tool, action, primitive labels, reward, log density of the action (f32)
and the two end flags."""

_POSITIVE = (
  "env.worlds env.time_limit_s env.control_period_s env.bank_rows "
  "agent.n_step agent.learning_rate_e agent.epsilon "
  "agent.feature_dim agent.max_grad_norm agent.patch_channels agent.conv_channels "
  "agent.ap_delta agent.min_std agent.policy_min_std "
  "agent.initial_alpha agent.min_alpha "
  "replay.capacity replay.batch_size total_steps rollout_length "
  "updates_per_iteration eval_every eval_episodes checkpoint_every keep_checkpoints "
  "max_skipped_updates"
).split()
_NOT_NEGATIVE = (
  "agent.learning_rate_m agent.learning_rate_alpha agent.learning_rate_nu "
  "agent.lambda_ap agent.m_step_delay agent.residual_blocks replay.expert_steps "
  "replay.expert_noise seed save_replay_every"
).split()

_AT_MOST = {"env.bank_rows": 1 << 20, "agent.num_atoms": 10_000}
"""What is computed on the host before memory can be checked."""


def validate(
  config: TrainConfig,
  *,
  tasks: Sequence[str] | None = None,
  algorithms: Mapping[str, Sequence[str]] | None = None,
  memory_bytes: int | None = None,
  devices: int = 1,
) -> None:
  """Refuses a configuration that cannot work, before anything is built.

  Args:
    config: what to check.
    tasks: valid task names; not checked if None.
    algorithms: valid algorithm names -> settings of the agent, numbers of candidates,
      below the log of which epsilon must lie; not checked if None.
    memory_bytes: memory of a device the replays must fit into; not checked if None.
    devices: between how many worlds and batches are split.

  Raises:
    ConfigError: one line that names the setting and the valid choices or the fix.
  """
  _validate_ranges(config)
  check_name("env.backend", config.env.backend, BACKENDS)
  check_name("env.obs", config.env.obs, OBSERVATIONS)
  if tasks is not None:
    check_name("env.task", config.env.task, tasks)
  if algorithms is not None:
    check_name("agent.algorithm", config.agent.algorithm, tuple(algorithms))
  _validate_env(config.env)
  _validate_agent(config.agent)
  _validate_returns(config.agent)
  if algorithms is not None and config.agent.temperature != "fixed":
    _validate_epsilon(config.agent, algorithms[config.agent.algorithm])
  _validate_expert(config)
  _validate_replay(config, None if memory_bytes is None else memory_bytes * devices)
  for name, number in (
    ("env.worlds", config.env.worlds),
    ("replay.batch_size", config.replay.batch_size),
  ):
    if number % devices:
      raise ConfigError(f"{name}={number} must be a multiple of the {devices} devices")


def replay_bytes(config: TrainConfig) -> int:
  """Bytes the agent and expert replays take at most (points of objects not counted)."""
  images = math.prod(config.env.global_size) + math.prod(config.env.wrist_size)
  slot = _OTHER_BYTES + (3 * images if config.env.obs == "pixels" else 0)
  return slot * (config.replay.capacity + config.replay.expert_steps)


def _validate_ranges(config: TrainConfig) -> None:
  values = dict(codec.flatten(config))
  for name, value in values.items():
    if isinstance(value, float) and not math.isfinite(value):
      raise ConfigError(f"{name}={value} is not a finite number")
    if isinstance(value, int) and value >= 2**31:
      raise ConfigError(f"{name}={value} must be below 2**31")
  for name in _POSITIVE:
    if values[name] <= 0:
      raise ConfigError(f"{name}={values[name]} must be positive")
  for name in _NOT_NEGATIVE:
    if values[name] < 0:
      raise ConfigError(f"{name}={values[name]} must not be negative")
  for name, most in _AT_MOST.items():
    if values[name] > most:
      raise ConfigError(f"{name}={values[name]} must be at most {most}")
  if config.env.bank_rows < MIN_BANK_ROWS:
    raise ConfigError(
      f"env.bank_rows={config.env.bank_rows} must be at least {MIN_BANK_ROWS}: a "
      "quarter of them is held out for evaluation"
    )
  if config.env.episode_steps < 1:
    raise ConfigError(
      f"env.time_limit_s={config.env.time_limit_s} is shorter than one control "
      f"period; use at least {config.env.control_period_s}"
    )


def _validate_env(env: EnvConfig) -> None:
  for name in ("global_size", "wrist_size"):
    size = getattr(env, name)
    if len(size) != 2 or min(size) < 1 or max(size) > MAX_SIDE:
      raise ConfigError(
        f"env.{name}={size} must be height and width, each from 1 to {MAX_SIDE} pixels"
      )
  validate_ranges(env.randomization, "env.randomization.")
  delay = env.randomization.delay_s
  if env.randomize and delay >= env.control_period_s:
    raise ConfigError(
      f"env.randomization.delay_s={delay} must be below env.control_period_s="
      f"{env.control_period_s}: a command is late by less than the next one"
    )


def _validate_agent(agent: AgentConfig) -> None:
  check_name("agent.temperature", agent.temperature, TEMPERATURES)
  check_name("agent.regularizer", agent.regularizer, REGULARIZERS)
  check_name("agent.policy_evaluation", agent.policy_evaluation, EVALUATIONS)
  check_name("agent.prior_mean", agent.prior_mean, PRIOR_MEANS)
  check_name("agent.global_features", agent.global_features, IMAGE_FEATURES)
  check_name("agent.wrist_features", agent.wrist_features, IMAGE_FEATURES)
  for name in ("gamma", "target_rate"):
    if not 0.0 < getattr(agent, name) <= 1.0:
      raise ConfigError(f"agent.{name}={getattr(agent, name)} must be within (0, 1]")
  for name in ("target_samples", "policy_samples", "num_atoms"):
    if getattr(agent, name) < 2:
      raise ConfigError(f"agent.{name}={getattr(agent, name)} must be at least 2")
  if not 0 <= agent.image_shift <= MAX_SHIFT:
    raise ConfigError(
      f"agent.image_shift={agent.image_shift} must be within [0, {MAX_SHIFT}] pixels"
    )
  if not 0 <= agent.lstm_instants <= MAX_INSTANTS:
    raise ConfigError(
      f"agent.lstm_instants={agent.lstm_instants} must be within [0, {MAX_INSTANTS}]"
    )
  if not 0.0 <= agent.color_jitter <= 1.0:
    raise ConfigError(f"agent.color_jitter={agent.color_jitter} must be within [0, 1]")
  if not agent.hidden or min(agent.hidden) < 1 or max(agent.hidden) >= 2**31:
    raise ConfigError(f"agent.hidden={agent.hidden} must be positive layer widths")
  for kind in ("", "policy_"):
    low, start, high = (
      getattr(agent, f"{kind}{name}") for name in ("min_std", "initial_std", "max_std")
    )
    if not low < start < high:
      raise ConfigError(
        f"agent.{kind}initial_std={start} must lie between agent.{kind}min_std={low} "
        f"and agent.{kind}max_std={high}"
      )
  if not 0.0 < agent.min_prob < 1.0 / 3.0:
    raise ConfigError(f"agent.min_prob={agent.min_prob} must be within (0, 1/3)")
  if not 0.0 < agent.policy_min_prob < 0.5:
    raise ConfigError(
      f"agent.policy_min_prob={agent.policy_min_prob} must be within (0, 1/2)"
    )


def _validate_returns(agent: AgentConfig) -> None:
  if agent.v_min >= agent.v_max:
    raise ConfigError(
      f"agent.v_min={agent.v_min} must be below agent.v_max={agent.v_max}"
    )
  if not agent.v_min < agent.initial_value < agent.v_max:
    raise ConfigError(
      f"agent.initial_value={agent.initial_value} must lie between agent.v_min="
      f"{agent.v_min} and agent.v_max={agent.v_max}"
    )


def _validate_epsilon(agent: AgentConfig, bounds: Sequence[str]) -> None:
  # The KL of a distribution over S samples from their uniform weights is at most
  # log S: a larger limit never binds, and the temperature would run to zero.
  for name in bounds:
    samples = getattr(agent, name)
    if agent.epsilon >= math.log(samples):
      raise ConfigError(
        f"agent.epsilon={agent.epsilon} can never bind: it must be below log({samples})"
        f" = {math.log(samples):.3f}; lower it, or raise agent.{name}"
      )


def _validate_expert(config: TrainConfig) -> None:
  replay = config.replay
  if not 0.0 <= replay.expert_share <= 1.0:
    raise ConfigError(
      f"replay.expert_share={replay.expert_share} must be within [0, 1]"
    )
  expert = replay.batch_size * replay.expert_share
  if abs(expert - round(expert)) > 1e-6:
    raise ConfigError(
      f"replay.batch_size={replay.batch_size} times replay.expert_share="
      f"{replay.expert_share} is not whole; use expert_share="
      f"{round(expert) / replay.batch_size:.6g}"
    )
  if replay.expert_steps % config.env.worlds:
    raise ConfigError(
      f"replay.expert_steps={replay.expert_steps} must be a multiple of env.worlds="
      f"{config.env.worlds}"
    )
  if expert and not replay.expert_steps:
    raise ConfigError(
      "replay.expert_steps=0 leaves nothing to draw; use replay.expert_share=0"
    )
  if replay.demonstrations and not replay.expert_steps:
    raise ConfigError(
      "replay.expert_steps=0 leaves no room for replay.demonstrations="
      f"{replay.demonstrations}"
    )
  if replay.demonstrations and config.env.randomize:
    raise ConfigError(
      f"replay.demonstrations={replay.demonstrations} cannot be used with "
      "env.randomize: they show the world of the scene file"
    )


def _validate_replay(config: TrainConfig, memory_bytes: int | None) -> None:
  replay, per_iteration = config.replay, config.env.worlds * config.rollout_length
  if replay.capacity % per_iteration:
    raise ConfigError(
      f"replay.capacity={replay.capacity} must be a multiple of env.worlds * "
      f"rollout_length = {per_iteration}; use "
      f"{max(1, round(replay.capacity / per_iteration)) * per_iteration}"
    )
  fewest = config.agent.n_step + 2 + max(config.agent.lstm_instants - 1, 0)
  if replay.capacity // config.env.worlds < fewest:
    raise ConfigError(
      f"replay.capacity={replay.capacity} holds no {config.agent.n_step}-step "
      f"transition; use at least {fewest * config.env.worlds}"
    )
  need = replay_bytes(config)
  if memory_bytes is not None and need > memory_bytes:
    raise ConfigError(
      f"the replays need {need / 2**30:.1f} GiB but the devices have "
      f"{memory_bytes / 2**30:.1f} GiB; lower replay.capacity or "
      "replay.expert_steps"
    )
