"""Settings in which environment and training are timed."""

import argparse
from collections.abc import Callable, Iterator
import dataclasses
import itertools
import sys
from typing import Any

from apnpql_jax import testing
from apnpql_jax.config.checks import BACKENDS, OBSERVATIONS
from apnpql_jax.config.files import load_preset
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import ConfigError
from apnpql_jax.tasks import task_names

ENGINES = ("native", "mjx")


def add_flags(parser: argparse.ArgumentParser) -> None:
  """Adds the flags that choose the settings."""
  tasks = sorted(task_names(), key=lambda name: name != "push_plate")
  flag = parser.add_argument
  flag("--tasks", nargs="+", choices=tasks, default=tasks)
  flag("--backends", nargs="+", choices=BACKENDS, default=ENGINES)
  flag("--obs", nargs="+", choices=OBSERVATIONS, default=["pixels"])
  first = "the first for every task, the others for the first task"
  flag("--worlds", type=int, nargs="+", default=[32, 8, 128], help=first)


def measure_each(
  args: argparse.Namespace, measure: Callable[[TrainConfig, int], dict[str, Any]]
) -> Iterator[dict[str, Any]]:
  """Measures the preset of every combination of the flags, see ``--worlds``.

  Settings for which the memory does not suffice are left out.
  """
  lists = (args.tasks, args.backends, args.obs, args.worlds)
  if args.quick:
    lists = (["push_plate"], ["native"], args.obs, [4])
  for task, backend, obs, worlds in itertools.product(*lists):
    setting = {"task": task, "backend": backend, "obs": obs, "worlds": worlds}
    if task != lists[0][0] and worlds != lists[3][0]:
      continue
    try:
      config = changed(preset(task, quick=args.quick), "env", **setting)
      yield setting | measure(config, args.repeats)
    except ConfigError as error:
      print(f"{setting}: {error}", file=sys.stderr)


def preset(name: str, *, quick: bool) -> TrainConfig:
  """Returns a preset; if ``quick``, tiny networks and images instead."""
  if not quick:
    return load_preset(name)
  sizes = {"global_size": (12, 16), "wrist_size": (8, 12)}
  return changed(testing.TINY, "env", obs="pixels", **sizes)


def changed(config: TrainConfig, section: str, **values: Any) -> TrainConfig:
  """Returns a training with other values in its agent, env or replay."""
  part = dataclasses.replace(getattr(config, section), **values)
  return dataclasses.replace(config, **{section: part})


def with_candidates(
  config: TrainConfig, count: int, precision: str = "float32"
) -> TrainConfig:
  """Returns the same training with other candidates: ``count`` in the target.

  The policy has five for six of them, as in the paper, 100 for 120.
  """
  return changed(
    config,
    "agent",
    target_samples=count,
    policy_samples=max(2, count * 5 // 6),
    # Must stay below the log of the candidates; it costs no time.
    epsilon=min(config.agent.epsilon, 1.0),
    candidate_precision=precision,
  )
