"""AP-NPQL on JAX and MuJoCo: pixels to policy with one command.

The names below are the public API, imported on first use so that importing the package
is fast. Programs call ``configure`` first.
"""

# ruff: noqa: F401 (the imports are the API)
from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
  from apnpql_jax.agents.learner import Agent, make_agent
  from apnpql_jax.config.files import load_preset, preset_names
  from apnpql_jax.config.ranges import RandomizationConfig
  from apnpql_jax.config.schema import AgentConfig, EnvConfig, ReplayConfig, TrainConfig
  from apnpql_jax.envs.env import Env, make_env
  from apnpql_jax.errors import ConfigError, FileError, RunStopped, UserError
  from apnpql_jax.runtime import configure
  from apnpql_jax.tasks.build import make_task
  from apnpql_jax.tasks.task import Task, register_task, task_names
  from apnpql_jax.training.diagnose import diagnose
  from apnpql_jax.training.evaluate import evaluate, load_trained
  from apnpql_jax.training.train import train

_MODULES = {
  "agents.learner": ("Agent", "make_agent"),
  "config.files": ("load_preset", "preset_names"),
  "config.ranges": ("RandomizationConfig",),
  "config.schema": ("AgentConfig", "EnvConfig", "ReplayConfig", "TrainConfig"),
  "envs.env": ("Env", "make_env"),
  "errors": ("ConfigError", "FileError", "RunStopped", "UserError"),
  "runtime": ("configure",),
  "tasks.build": ("make_task",),
  "tasks.task": ("Task", "register_task", "task_names"),
  "training.diagnose": ("diagnose",),
  "training.evaluate": ("evaluate", "load_trained"),
  "training.train": ("train",),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
  if name not in _HOME:
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
  return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
  return sorted({*globals(), *_HOME})
