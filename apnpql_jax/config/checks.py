"""Checks of a configuration before anything is built.

The valid tasks and algorithms are passed in, so that reading a configuration imports
neither the simulator nor the learner.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import math
from typing import Any

from apnpql_jax.config import codec, user_files
from apnpql_jax.config.ranges import validate_ranges
from apnpql_jax.config.schema import AgentConfig, EnvConfig, TrainConfig
from apnpql_jax.errors import ConfigError, check_name

BACKENDS = ("auto", "mjx", "native")
OBSERVATIONS = ("pixels", "state")
ACTING = ("policy", "mean", "prior", "greedy")
POLICY_EVALUATIONS = ("row", "categorical", "td0", "retrace", "clipped_double_q")
IMAGE_FEATURES = ("map", "keypoints", "both")

_CHOICES = {
  "env.backend": BACKENDS,
  "env.obs": OBSERVATIONS,
  "eval_acting": ACTING,
  "agent.candidate_precision": ("float32", "bfloat16"),
  "agent.temperature": ("state", "shared", "fixed"),
  "agent.alpha_floor": ("softplus", "clip"),
  "agent.regularizer": ("row", "uniform"),
  "agent.policy_evaluation": POLICY_EVALUATIONS,
  "agent.prior_mean": ("primitives", "learned"),
  "agent.global_features": IMAGE_FEATURES,
  "agent.wrist_features": IMAGE_FEATURES,
}

_POSITIVE = (
  "env.worlds env.time_limit_s env.control_period_s "
  "agent.n_step agent.learning_rate_e agent.epsilon "
  "agent.feature_dim agent.max_grad_norm agent.patch_channels agent.conv_channels "
  "agent.ap_delta agent.min_std agent.policy_min_std agent.policy_components "
  "agent.initial_alpha agent.min_alpha "
  "replay.capacity replay.batch_size total_steps rollout_length "
  "updates_per_iteration eval_every eval_episodes checkpoint_every keep_checkpoints "
  "max_skipped_updates"
).split()
_NOT_NEGATIVE = (
  "agent.learning_rate_m agent.learning_rate_alpha agent.learning_rate_nu "
  "agent.lambda_ap agent.m_step_delay agent.decay_updates agent.residual_blocks "
  "replay.expert_steps replay.expert_noise seed save_replay_every"
).split()
MIN_BANK_ROWS = 16
_BOUNDS = {
  # A quarter of the bank is held out for evaluation. Bank and atoms are computed on the
  # host before memory is checked.
  "env.bank_rows": (MIN_BANK_ROWS, 1 << 20),
  "agent.num_atoms": (2, 10_000),
  "agent.target_samples": (2, math.inf),
  "agent.policy_samples": (2, math.inf),
  "agent.image_shift": (0, 16),
  # A third of an episode of 14 s; a batch holds this many times the images.
  "agent.lstm_instants": (0, 32),
  "agent.color_jitter": (0, 1),
  "replay.expert_share": (0, 1),
}
_MAX_SIDE = 1024  # pixels
_PARTS = "env.", "agent."  # checked on their own

PROCESS_BYTES = 9 << 28
"""Memory that a training takes besides its state, with the presets' networks on a CPU:
2 GiB for the libraries and for a first compilation, which frees 1.3 of them, and 256
MiB for a checkpoint. `benchmarks.reliability.memory` measures it."""

_PRIMITIVE_BYTES = 4 * 3 * 7
_OTHER_BYTES = 4 * (21 + 3 + 7 + 7 + 2) + _PRIMITIVE_BYTES + 2
"""Bytes of a slot without images: robot state, tool, action, the expert's action (only
where it is imitated), primitive labels, reward and log density of the action (f32), and
the two end flags."""


def validate(
  config: TrainConfig,
  *,
  tasks: Sequence[str] | None = None,
  algorithms: Mapping[str, Sequence[str]] | None = None,
  memory_bytes: int | None = None,
  devices: int = 1,
) -> None:
  """Checks that a configuration can work.

  Args:
    config: Configuration to check.
    tasks: Valid task names. Like the next two, not checked if None.
    algorithms: Valid algorithm names, each with the agent settings (numbers of
      candidates) whose logarithm bounds epsilon.
    memory_bytes: Memory of one device, for the replays.
    devices: Number of devices that share the worlds and batches.

  Raises:
    ConfigError: A setting is invalid. The one-line message names it and the valid
      choices or the fix.
  """
  check_env(config.env, tasks=tasks)
  check_agent(config.agent, algorithms=algorithms)
  values = dict(codec.flatten(config))
  _check_values((k, v) for k, v in values.items() if not k.startswith(_PARTS))
  _check_expert(config)
  _check_replay(config, None if memory_bytes is None else memory_bytes * devices)
  for name in ("env.worlds", "replay.batch_size"):
    if (n := values[name]) % devices:
      raise ConfigError(f"{name}={n} must be a multiple of the {devices} devices")


def check_env(env: EnvConfig, *, tasks: Sequence[str] | None = None) -> None:
  """Checks the environment's settings; raises ``ConfigError`` as ``validate`` does."""
  _check_values(codec.flatten(env, "env."))
  if tasks is not None:
    if env.task_file and env.task not in tasks:
      user_files.check_loaded(env.task_file, env.task)
    check_name("env.task", env.task, tasks)
  if env.episode_steps < 1:
    raise ConfigError(
      f"env.time_limit_s={env.time_limit_s} is shorter than one control period; use at "
      f"least {env.control_period_s}"
    )
  for name in ("global_size", "wrist_size"):
    size = getattr(env, name)
    if len(size) != 2 or min(size) < 1 or max(size) > _MAX_SIDE:
      raise ConfigError(
        f"env.{name}={size} must be height and width, each from 1 to {_MAX_SIDE} pixels"
      )
  validate_ranges(env.randomization, "env.randomization.")
  delay = env.randomization.delay_s
  if env.randomize and delay >= env.control_period_s:
    raise ConfigError(
      f"env.randomization.delay_s={delay} must be below env.control_period_s="
      f"{env.control_period_s}: a command must take effect before the next one"
    )


def check_agent(
  agent: AgentConfig, *, algorithms: Mapping[str, Sequence[str]] | None = None
) -> None:
  """Checks the learner's settings; raises ``ConfigError`` as ``validate`` does."""
  _check_values(codec.flatten(agent, "agent."))
  if algorithms is not None:
    check_name("agent.algorithm", agent.algorithm, tuple(algorithms))
  for name in ("gamma", "target_rate"):
    if not 0.0 < getattr(agent, name) <= 1.0:
      raise ConfigError(f"agent.{name}={getattr(agent, name)} must be within (0, 1]")
  if not agent.hidden or min(agent.hidden) < 1 or max(agent.hidden) >= 2**31:
    raise ConfigError(f"agent.hidden={agent.hidden} must be positive layer widths")
  learns = agent.gripper_offset or agent.prior_mean == "learned"
  if not agent.primitive_gripper and not learns:
    raise ConfigError(
      "without agent.primitive_gripper, only the M-step can learn when to close; set "
      "agent.gripper_offset"
    )
  own = agent.policy_components
  for name in ("policy_samples", "target_samples"):
    if getattr(agent, name) < 2 * own:
      raise ConfigError(
        f"agent.{name}={getattr(agent, name)} holds no draw of each of "
        f"agent.policy_components={own} with both gripper commands; use at least "
        f"{2 * own}"
      )
  for name, components in (("min_prob", 3), ("policy_min_prob", max(own, 2))):
    if not 0.0 < (prob := getattr(agent, name)) < 1.0 / components:
      raise ConfigError(f"agent.{name}={prob} must be within (0, 1/{components})")
  if agent.v_min >= agent.v_max:
    raise ConfigError(
      f"agent.v_min={agent.v_min} must be below agent.v_max={agent.v_max}"
    )
  for low, start, high in (
    ("min_std", "initial_std", "max_std"),
    ("policy_min_std", "policy_initial_std", "policy_max_std"),
    ("v_min", "initial_value", "v_max"),
  ):
    if not getattr(agent, low) < getattr(agent, start) < getattr(agent, high):
      raise ConfigError(
        f"agent.{start}={getattr(agent, start)} must lie between agent.{low}="
        f"{getattr(agent, low)} and agent.{high}={getattr(agent, high)}"
      )
  if algorithms is not None and agent.temperature != "fixed":
    _check_epsilon(agent, algorithms[agent.algorithm])


def replay_bytes(config: TrainConfig) -> int:
  """Returns an upper bound on the bytes of both replays, without object points."""
  images = math.prod(config.env.global_size) + math.prod(config.env.wrist_size)
  slot = _OTHER_BYTES + (3 * images if config.env.obs == "pixels" else 0)
  slot += _PRIMITIVE_BYTES * config.env.true_primitives
  return slot * (config.replay.capacity + config.replay.expert_steps)


def _check_values(values: Iterable[tuple[str, Any]]) -> None:
  """Checks each setting on its own, given as dotted name and value."""
  for name, value in values:
    if isinstance(value, float) and not math.isfinite(value):
      raise ConfigError(f"{name}={value} is not a finite number")
    if isinstance(value, int) and value >= 2**31:
      raise ConfigError(f"{name}={value} must be below 2**31")
    if name in _POSITIVE and value <= 0:
      raise ConfigError(f"{name}={value} must be positive")
    if name in _NOT_NEGATIVE and value < 0:
      raise ConfigError(f"{name}={value} must not be negative")
    if name in _BOUNDS:
      low, high = _BOUNDS[name]
      if value < low:
        raise ConfigError(f"{name}={value} must be at least {low}")
      if value > high:
        raise ConfigError(f"{name}={value} must be at most {high}")
    if name in _CHOICES:
      check_name(name, value, _CHOICES[name])


def _check_epsilon(agent: AgentConfig, bounds: Sequence[str]) -> None:
  # The KL of a distribution over S samples from their uniform weights is at most
  # log S. A larger limit never binds, and the temperature would run to zero.
  for name in bounds:
    samples = getattr(agent, name)
    if agent.epsilon >= math.log(samples):
      raise ConfigError(
        f"agent.epsilon={agent.epsilon} can never bind: it must be below log({samples})"
        f" = {math.log(samples):.3f}; lower it, or raise agent.{name}"
      )


def _check_expert(config: TrainConfig) -> None:
  replay = config.replay
  expert = replay.batch_size * replay.expert_share
  if abs(expert - round(expert)) > 1e-6:
    raise ConfigError(
      f"replay.batch_size={replay.batch_size} times replay.expert_share="
      f"{replay.expert_share} is not an integer; use expert_share="
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
  if replay.demonstrations and config.env.static_targets:
    raise ConfigError(
      "env.static_targets are ends of the scripted expert's episodes, which "
      f"replay.demonstrations={replay.demonstrations} does not have; use one of them"
    )


def _check_replay(config: TrainConfig, memory_bytes: int | None) -> None:
  capacity = config.replay.capacity
  per_iteration = config.env.worlds * config.rollout_length
  if capacity % per_iteration:
    raise ConfigError(
      f"replay.capacity={capacity} must be a multiple of env.worlds * rollout_length = "
      f"{per_iteration}; use {max(1, round(capacity / per_iteration)) * per_iteration}"
    )
  expert_rows = config.replay.batch_size * config.replay.expert_share
  fewest = config.agent.n_step + 2 + max(config.agent.lstm_instants - 1, 0)
  for name, slots, rows in (
    ("capacity", capacity, config.replay.batch_size),
    ("expert_steps", config.replay.expert_steps, expert_rows),
  ):
    if rows and slots // config.env.worlds < fewest:
      raise ConfigError(
        f"replay.{name}={slots} holds no {config.agent.n_step}-step transition; use at "
        f"least {fewest * config.env.worlds}"
      )
  need = replay_bytes(config) + PROCESS_BYTES
  if memory_bytes is not None and need > memory_bytes:
    raise ConfigError(
      f"training with these replays needs {need / 2**30:.1f} GiB but the devices have "
      f"{memory_bytes / 2**30:.1f} GiB; lower replay.capacity or replay.expert_steps"
    )
