"""Groups of runs that differ only in their seeds, labeled by what differs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
import re
from typing import Any, NamedTuple

from apnpql_jax.config import codec
from apnpql_jax.config.changes import REPORTS
from apnpql_jax.config.files import config_diff
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.reports.reading import Run

_RESULTS = "total_steps", "eval_episodes", "eval_acting"  # that change what is compared
IGNORED = ("seed", *(name for name in REPORTS if name not in _RESULTS))
"""Settings that do not put runs into different groups."""

TASK = "env.task"

_MOST = 3
"""Settings in a label; runs that differ in more are labeled by their folders."""

Settings = dict[str, Any]


class Group(NamedTuple):
  """Runs with equal settings apart from the seed."""

  task: str
  label: str  # the settings that differ from other groups of the task; "" if none
  runs: list[Run]  # by seed

  @property
  def title(self) -> str:
    """Label, or the task if nothing differs."""
    return self.label or self.task


def group(runs: Sequence[Run]) -> list[Group]:
  """Returns the groups, by task and then in the order in which they are given.

  Runs that repeat another run's seed add no evidence, so they form groups of their own.
  """
  tasks: dict[str, dict[tuple[Any, ...], list[Run]]] = {}
  seen: Counter[tuple[Any, ...]] = Counter()
  for run in runs:
    values = tuple(settings(run.config).values())
    repeats = seen[run.config.seed, values]
    seen[run.config.seed, values] += 1
    key = repeats, values
    tasks.setdefault(run.config.env.task, {}).setdefault(key, []).append(run)
  found = []
  for task, groups in tasks.items():
    members = [
      sorted(each, key=lambda run: run.config.seed) for each in groups.values()
    ]
    labels = _labels(members)
    found += [Group(task, *pair) for pair in zip(labels, members, strict=True)]
  return found


def differences(old: TrainConfig, new: TrainConfig) -> dict[str, tuple[Any, Any]]:
  """Returns dotted name -> (old, new) of the settings that make another group."""
  diff = config_diff(old, new)
  return {name: pair for name, pair in diff.items() if name not in IGNORED}


def settings(config: TrainConfig) -> Settings:
  """Returns dotted name -> value of the settings that make a group."""
  return {k: value for k, value in codec.flatten(config) if k not in IGNORED}


def differing(groups: Sequence[Settings]) -> list[str]:
  """Returns the names of the settings that are not equal in all groups."""
  if not groups:
    return []
  first = groups[0]
  return [name for name in first if any(x[name] != first[name] for x in groups)]


def tasks_of(groups: Sequence[Group]) -> list[str]:
  """Returns the tasks of the groups, each once, in their order."""
  return list(dict.fromkeys(group.task for group in groups))


def text(value: Any) -> str:
  """Returns a setting as it is written on the command line."""
  if isinstance(value, tuple | list):
    return " ".join(map(text, value)) or "none"
  if isinstance(value, float):
    return f"{value:g}"
  return str(value) if value != "" else "none"


def _labels(groups: Sequence[Sequence[Run]]) -> list[str]:
  """Returns a label of each group of a task; all are different."""
  values = [settings(runs[0].config) for runs in groups]
  names = differing(values)
  learning = [name for name in names if name not in REPORTS]
  for chosen in (learning, names):
    labels = [_label({name: each[name] for name in chosen}) for each in values]
    if len(chosen) <= _MOST and len(set(labels)) == len(labels):
      return labels
  labels = [_folder_name(runs) for runs in groups]
  if len(set(labels)) < len(labels):
    labels = [f"{label} ({index + 1})" for index, label in enumerate(labels)]
  return labels


def _label(values: Mapping[str, Any]) -> str:
  """Returns such as ``ap_sac, epsilon 0.5``."""
  parts = []
  for name, value in values.items():
    short = name.rpartition(".")[2].replace("_", " ")
    named = name in ("agent.algorithm", "env.obs")
    parts.append(text(value) if named else f"{short} {text(value)}")
  return ", ".join(parts)


def _folder_name(runs: Sequence[Run]) -> str:
  """Returns the name of the first folder of a group without its seed."""
  name = runs[0].name
  return re.sub(rf"[-_.](seed[-_]?)?{runs[0].config.seed}$", "", name) or name
