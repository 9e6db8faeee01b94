"""The settings that environment and training are timed in: flags, and presets."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import dataclasses
import itertools
from typing import Any

from apnpql_jax import testing
from apnpql_jax.config.checks import BACKENDS, OBSERVATIONS
from apnpql_jax.config.files import load_preset
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.tasks import task_names

ENGINES = ("native", "mjx")


def add_flags(parser: argparse.ArgumentParser) -> None:
  """Flags of what is timed."""
  tasks = sorted(task_names(), key=lambda name: name != "push_plate")
  parser.add_argument("--tasks", nargs="+", choices=tasks, default=tasks)
  parser.add_argument("--backends", nargs="+", choices=BACKENDS, default=ENGINES)
  parser.add_argument("--obs", nargs="+", choices=OBSERVATIONS, default=["pixels"])
  parser.add_argument(
    "--worlds",
    type=int,
    nargs="+",
    default=[32, 8, 128],
    help="the first with every task, the others with the first task",
  )


def chosen(args: argparse.Namespace) -> Iterator[tuple[dict[str, Any], TrainConfig]]:
  """Every combination of the flags, but for ``--worlds``: what it is called, and its
  preset."""
  lists = (args.tasks, args.backends, args.obs, args.worlds)
  if args.quick:
    lists = (["push_plate"], ["native"], args.obs, [4])
  for values in itertools.product(*lists):
    names = ("task", "backend", "obs", "worlds")
    setting: dict[str, Any] = dict(zip(names, values, strict=True))
    if setting["task"] != lists[0][0] and setting["worlds"] != lists[3][0]:
      continue
    base = tiny_pixels() if args.quick else load_preset(setting["task"])
    env = dataclasses.replace(base.env, **setting)
    yield setting, dataclasses.replace(base, env=env)


def tiny_pixels() -> TrainConfig:
  """A run so small that its figures mean nothing, with images."""
  sizes = {"global_size": (12, 16), "wrist_size": (8, 12)}
  env = dataclasses.replace(testing.TINY.env, obs="pixels", **sizes)
  return dataclasses.replace(testing.TINY, env=env)
