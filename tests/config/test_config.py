"""Configurations: invalid ones are rejected, and JSON round trips are exact."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import json
import math

from hypothesis import given, settings, strategies as st
import pytest

from apnpql_jax.config import checks, codec, files, ranges, schema as config_module
from apnpql_jax.config.checks import PROCESS_BYTES, replay_bytes, validate
from apnpql_jax.config.files import (
  config_diff,
  config_from_json,
  config_to_json,
  format_diff,
)
from apnpql_jax.config.ranges import RandomizationConfig
from apnpql_jax.config.schema import AgentConfig, EnvConfig, ReplayConfig, TrainConfig
from apnpql_jax.errors import ConfigError

POSITIVE = st.floats(1e-6, 1e6, allow_nan=False)

ADDED = {
  "env.task_file": "",
  "env.global_size": (72, 96),
  "env.wrist_size": (36, 64),
  "env.shadows": False,
  "env.static_targets": False,
  "env.true_primitives": False,
  "env.randomize": False,
  "env.randomization": RandomizationConfig(),
  "env.randomization.shape": 0.0,
  "env.randomization.surroundings": 0.0,
  "agent.candidate_precision": "float32",
  "agent.alpha_floor": "softplus",
  "agent.primitive_gripper": True,
  "agent.gripper_offset": True,
  "agent.decay_updates": 0,
  "agent.policy_components": 1,
  "agent.residual_blocks": 0,
  "agent.lstm_instants": 0,
  "agent.global_features": "map",
  "agent.wrist_features": "map",
  "agent.standardize_images": False,
  "agent.image_shift": 0,
  "agent.color_jitter": 0.0,
  "eval_acting": "policy",
  "wandb_project": "apnpql_jax",
  "wandb_entity": "",
  "wandb_id": "",
  "replay.demonstrations": "",
  "replay.allow_unsolved": True,
}
"""Behavior of runs from before these settings existed. No value here may ever
change. If a default does, pass the old one to ``codec.added``."""


def changed(path: str, value: object) -> TrainConfig:
  """Returns the default configuration with one dotted field replaced."""
  return replaced(TrainConfig(), path.split("."), value)


def replaced(config, names, value):
  if len(names) > 1:
    value = replaced(getattr(config, names[0]), names[1:], value)
  return dataclasses.replace(config, **{names[0]: value})


def edited(path: str, value: object) -> str:
  """Returns the default configuration as JSON with one key set; ``...`` removes it."""
  data = json.loads(config_to_json(TrainConfig()))
  *parents, last = path.split(".")
  node = data
  for name in parents:
    node = node[name]
  if value is ...:
    del node[last]
  else:
    node[last] = value
  return json.dumps(data)


def test_defaults_and_presets_are_valid():
  validate(TrainConfig())
  for name in files.preset_names():
    validate(files.load_preset(name))


def test_every_name_in_the_checks_is_that_of_a_setting():
  tables = checks._POSITIVE, checks._NOT_NEGATIVE, checks._BOUNDS, checks._CHOICES
  assert {name for table in tables for name in table} <= {
    name for name, _ in codec.flatten(TrainConfig())
  }


def test_every_field_has_a_docstring():
  sources = [inspect.getsource(module) for module in (ranges, config_module)]
  nodes = [node for source in sources for node in ast.parse(source).body]
  classes = [node for node in nodes if isinstance(node, ast.ClassDef)]
  fields = 0
  for cls in classes:
    for node, after in zip(cls.body, [*cls.body[1:], None], strict=True):
      if isinstance(node, ast.AnnAssign):
        fields += 1
        assert isinstance(after, ast.Expr), f"{cls.name}.{ast.unparse(node.target)}"
        assert isinstance(after.value, ast.Constant)
  expected = (RandomizationConfig, EnvConfig, AgentConfig, ReplayConfig, TrainConfig)
  assert fields == sum(len(dataclasses.fields(cls)) for cls in expected)


@pytest.mark.parametrize(
  ("path", "value", "words"),
  [
    ("env.global_size", (72, 0), ["env.global_size=(72, 0)", "1 to 1024"]),
    ("env.wrist_size", (36,), ["env.wrist_size", "height and width"]),
    ("env.randomization.size", 0.3, ["env.randomization.size=0.3", "[0, 0.1]"]),
    ("env.randomization.mass", -0.1, ["env.randomization.mass=-0.1", "[0, 0.5]"]),
    ("env.backend", "bullet", ["auto", "mjx", "native"]),
    ("env.obs", "depth", ["pixels", "state"]),
    ("env.task", "juggle", ["push_plate", "stack_box"]),
    ("agent.algorithm", "ppo", ["ap_npql", "sac"]),
    ("agent.epsilon", math.log(100), ["4.605", "policy_samples"]),
    ("agent.epsilon", float("nan"), ["finite"]),
    ("agent.epsilon", 0.0, ["positive"]),
    ("agent.temperature", "none", ["state", "shared", "fixed"]),
    ("agent.candidate_precision", "half", ["float32", "bfloat16"]),
    ("agent.regularizer", "b", ["row", "uniform"]),
    ("agent.policy_evaluation", "mc", ["row", "retrace"]),
    ("agent.prior_mean", "zero", ["primitives", "learned"]),
    ("agent.policy_initial_std", 2.0, ["agent.policy_max_std"]),
    ("agent.policy_min_prob", 0.5, ["(0, 1/2)"]),
    ("agent.policy_components", 0, ["positive"]),
    ("agent.policy_components", 51, ["agent.policy_samples=100", "at least 102"]),
    ("agent.gamma", 1.5, ["(0, 1]"]),
    ("agent.v_min", 1.0, ["agent.v_max"]),
    ("agent.hidden", (), ["agent.hidden"]),
    ("agent.lstm_instants", 33, ["at most 32"]),
    ("agent.target_samples", 1, ["at least 2"]),
    ("agent.learning_rate_e", float("inf"), ["finite"]),
    ("replay.expert_share", 0.3, ["replay.batch_size", "0.296875"]),
    ("replay.expert_share", 1.5, ["at most 1"]),
    ("replay.expert_steps", 0, ["expert_share=0"]),
    ("replay.expert_noise", -0.1, ["negative"]),
    ("replay.capacity", 51_201, ["256", "use 51200"]),
    ("replay.capacity", 2**31, ["2**31"]),
    ("rollout_length", 7, ["224", "replay.capacity"]),
    ("total_steps", 0, ["positive"]),
    ("seed", -1, ["negative"]),
    ("seed", 2**31, ["2**31"]),
    ("env.time_limit_s", 0.1, ["0.15"]),
  ],
)
def test_errors_name_the_setting_and_the_fix(path, value, words):
  with pytest.raises(ConfigError) as error:
    validate(
      changed(path, value),
      tasks=["push_plate", "stack_box"],
      algorithms={"ap_npql": ("target_samples", "policy_samples"), "sac": ()},
    )
  message = str(error.value)
  assert "\n" not in message
  for word in [path, *words]:
    assert word in message


@pytest.mark.parametrize(
  ("epsilon", "bounds"),
  [
    (math.log(100) - 1e-6, ("target_samples", "policy_samples")),
    (math.log(120) - 1e-6, ("target_samples",)),
    (9.0, ()),
  ],
)
def test_epsilon_is_bounded_only_where_candidates_are_weighted(epsilon, bounds):
  validate(changed("agent.epsilon", epsilon), algorithms={"ap_npql": bounds})


def test_the_least_weight_leaves_room_for_all_components():
  config = changed("agent.policy_components", 3)
  validate(replaced(config, ["agent", "policy_min_prob"], 0.33))
  with pytest.raises(ConfigError, match=r"policy_min_prob=0.34 must be .*1/3\)"):
    validate(replaced(config, ["agent", "policy_min_prob"], 0.34))


def test_a_fixed_temperature_enforces_no_limit():
  agent = dataclasses.replace(AgentConfig(), epsilon=9.0, temperature="fixed")
  validate(TrainConfig(agent=agent), algorithms={"ap_npql": ("policy_samples",)})


def test_defaults_of_the_learner_are_the_constants_of_the_paper():
  """Section V-B, and the 51 bins of Sec. III-C."""
  agent = AgentConfig()
  assert (agent.gamma, agent.target_rate) == (0.99, 0.05)
  assert (agent.learning_rate_e, agent.learning_rate_m) == (3e-4, 3e-4)
  assert (agent.learning_rate_alpha, agent.learning_rate_nu) == (1e-4, 1e-4)
  assert (agent.target_samples, agent.policy_samples) == (120, 100)
  assert (agent.hidden, agent.num_atoms) == ((256, 256), 51)


def test_replay_without_room_for_a_transition_is_rejected():
  config = TrainConfig(replay=ReplayConfig(capacity=128), rollout_length=1)
  with pytest.raises(ConfigError, match="capacity=128 .* use at least 160"):
    validate(config)
  validate(changed("replay.capacity", 256))
  # The same for the expert's share of each batch, if there is any.
  config = changed("replay.expert_steps", 128)
  with pytest.raises(ConfigError, match="expert_steps=128 .* use at least 160"):
    validate(config)
  validate(replaced(config, ["replay", "expert_share"], 0.0))
  validate(changed("replay.expert_steps", 160))


def test_replay_larger_than_memory_is_rejected():
  need = replay_bytes(TrainConfig())
  whole = need + PROCESS_BYTES
  validate(TrainConfig(), memory_bytes=whole)
  with pytest.raises(ConfigError, match="GiB.*replay.capacity"):
    validate(TrainConfig(), memory_bytes=whole - 1)
  # Two images of three bytes per pixel in every slot of both replays.
  slots = 51_200 + 6_400
  assert need > slots * 3 * (72 * 96 + 36 * 64)
  assert replay_bytes(changed("env.obs", "state")) < need / 100
  large = replay_bytes(changed("env.global_size", (120, 160)))
  slots = ReplayConfig().capacity + ReplayConfig().expert_steps
  assert large - need == 3 * (120 * 160 - 72 * 96) * slots


def test_a_replay_must_hold_the_window_of_an_lstm():
  config = changed("replay.capacity", 256)  # Eight instants per world.
  validate(replaced(config, ["agent", "lstm_instants"], 4))
  with pytest.raises(ConfigError, match="replay.capacity=256 .* at least 288"):
    validate(replaced(config, ["agent", "lstm_instants"], 5))


def test_a_command_must_take_effect_before_the_next_one():
  env = EnvConfig(randomize=True, randomization=RandomizationConfig(delay_s=0.15))
  with pytest.raises(ConfigError, match="delay_s=0.15 must be below.*=0.15"):
    validate(TrainConfig(env=env))


def test_demonstrations_have_no_static_targets():
  config = changed("replay.demonstrations", "demonstrations.npz")
  validate(config)
  with pytest.raises(ConfigError, match="env.static_targets .* use one of them"):
    validate(replaced(config, ["env", "static_targets"], True))


def test_episode_steps_of_the_paper():
  assert EnvConfig().episode_steps == 93
  assert EnvConfig(time_limit_s=1.5, control_period_s=0.15).episode_steps == 10


@settings(max_examples=50, deadline=None)
@given(
  epsilon=st.floats(1e-3, 4.6),
  rate=POSITIVE,
  hidden=st.lists(st.integers(1, 2048), min_size=1, max_size=4),
  seed=st.integers(0, 2**31 - 1),
  video=st.booleans(),
)
def test_json_round_trip_is_exact(epsilon, rate, hidden, seed, video):
  agent = AgentConfig(epsilon=epsilon, learning_rate_e=rate, hidden=tuple(hidden))
  config = TrainConfig(agent=agent, seed=seed, video=video)
  assert config_from_json(config_to_json(config)) == config


def test_whole_numbers_are_read_as_floats():
  config = config_from_json(edited("agent.epsilon", 1))
  assert type(config.agent.epsilon) is float


@pytest.mark.parametrize(
  ("text", "words"),
  [
    ("", ["JSON"]),
    ("[]", ["object"]),
    ("__import__('os')", ["JSON"]),
    ("[" * 100_000, ["JSON"]),
    (edited("seed", ...), ["'seed'", "missing"]),
    (edited("agent.gamma", ...), ["'agent.gamma'", "missing"]),
    (edited("agent.gama", 0.9), ["'agent.gama'", "gamma"]),
    (edited("agent", 3), ["agent", "object"]),
    (edited("seed", "0"), ["'seed'", "int", "str"]),
    (edited("seed", 1.0), ["'seed'", "int", "float"]),
    (edited("seed", True), ["'seed'", "int", "bool"]),
    (edited("video", 1), ["'video'", "bool"]),
    (edited("agent.gamma", None), ["'agent.gamma'", "float"]),
    (edited("agent.gamma", 10**400), ["'agent.gamma'"]),
    (edited("agent.hidden", 256), ["'agent.hidden'", "list"]),
    (edited("agent.hidden", [256, "256"]), ["'agent.hidden'", "int"]),
    (edited("agent.gamma", float("nan")), ["NaN"]),
    (edited("agent.gamma", 2.0), ["agent.gamma", "(0, 1]"]),
  ],
)
def test_json_is_read_strictly(text, words):
  with pytest.raises(ConfigError) as error:
    config_from_json(text)
  for word in words:
    assert word in str(error.value)


def test_a_missing_setting_that_was_added_later_keeps_the_old_behavior():
  for path, before in ADDED.items():
    warnings: list[str] = []
    config = config_from_json(edited(path, ...), warnings.append)
    assert config == replaced(TrainConfig(), path.split("."), before)
    (line,) = warnings
    assert line.count(path) == 1 and "\n" not in line
  data = json.loads(config_to_json(TrainConfig()))
  old = {k: v for k, v in data["agent"].items() if f"agent.{k}" not in ADDED}
  warnings = []
  assert config_from_json(json.dumps(data | {"agent": old}), warnings.append)
  assert warnings[0].endswith("agent.policy_components 1, agent.alpha_floor softplus")
  assert config_from_json(config_to_json(TrainConfig()), pytest.fail)


def test_a_renamed_setting_is_read_by_its_former_name():
  config = replaced(TrainConfig(), ["agent", "regularizer"], "uniform")
  text = config_to_json(config)
  assert '"regularizer": "uniform"' in text
  assert config_from_json(text.replace("regularizer", "regulariser")) == config


def test_any_other_missing_setting_is_rejected_by_name():
  paths = [name for name, _ in codec.flatten(TrainConfig())] + ["env", "agent"]
  for path in paths:
    if path not in ADDED:
      with pytest.raises(ConfigError, match=f"'{path}' is missing"):
        config_from_json(edited(path, ...), pytest.fail)


def test_diff_lists_exactly_what_differs():
  a = TrainConfig()
  b = replaced(changed("agent.gamma", 0.9), ["seed"], 5)
  assert config_diff(a, b) == {"agent.gamma": (0.99, 0.9), "seed": (0, 5)}
  assert config_diff(b, a) == {"agent.gamma": (0.9, 0.99), "seed": (5, 0)}
  assert config_diff(a, TrainConfig()) == {}
  assert format_diff(config_diff(a, b)) == "agent.gamma 0.99 -> 0.9, seed 0 -> 5"
