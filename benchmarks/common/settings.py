"""Settings in which environment and training are timed."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
import dataclasses
import itertools
import sys
from typing import Any

from apnpql_jax.config import BACKENDS, OBSERVATIONS, ConfigError, TrainConfig
from apnpql_jax.presets import load_preset
from apnpql_jax.tasks import task_names
from benchmarks import tiny

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
  """Measures the preset of every setting for which the memory suffices."""
  for setting, config in chosen(args):
    try:
      yield setting | measure(config, args.repeats)
    except ConfigError as error:
      print(f"{setting}: {error}", file=sys.stderr)


def chosen(args: argparse.Namespace) -> Iterator[tuple[dict[str, Any], TrainConfig]]:
  """Yields every combination of the flags, see ``--worlds``, with its preset."""
  lists = (args.tasks, args.backends, args.obs, args.worlds)
  if args.quick:
    lists = (["push_plate"], ["native"], args.obs, [4])
  for values in itertools.product(*lists):
    names = ("task", "backend", "obs", "worlds")
    setting: dict[str, Any] = dict(zip(names, values, strict=True))
    if setting["task"] != lists[0][0] and setting["worlds"] != lists[3][0]:
      continue
    base = preset(setting["task"], quick=args.quick)
    yield (
      setting,
      dataclasses.replace(base, env=dataclasses.replace(base.env, **setting)),
    )


def preset(name: str, *, quick: bool) -> TrainConfig:
  """Returns a preset; if ``quick``, tiny networks and images instead."""
  if not quick:
    return load_preset(name)
  sizes = {"global_size": (12, 16), "wrist_size": (8, 12)}
  env = dataclasses.replace(tiny.CONFIG.env, obs="pixels", **sizes)
  return dataclasses.replace(tiny.CONFIG, env=env)


def with_candidates(config: TrainConfig, count: int) -> TrainConfig:
  """Returns the same training with another number of candidates."""
  # Epsilon must stay below the log of the candidates; it costs no time.
  agent = dataclasses.replace(
    config.agent,
    target_samples=count,
    policy_samples=count,
    epsilon=min(config.agent.epsilon, 1.0),
  )
  return dataclasses.replace(config, agent=agent)


def with_batch(config: TrainConfig, size: int) -> TrainConfig:
  """Returns the same training with another batch size."""
  replay = dataclasses.replace(config.replay, batch_size=size)
  return dataclasses.replace(config, replay=replay)
