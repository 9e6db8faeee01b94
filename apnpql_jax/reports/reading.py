"""Runs read from their folders, to be plotted and compared."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import dataclasses
import json
from pathlib import Path
import sys
from typing import Any

from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.console import print_line
from apnpql_jax.errors import ConfigError, FileError, UserError
from apnpql_jax.runs import provenance
from apnpql_jax.runs.metrics import EPISODES, STEP, SUCCESS, WALL, Row, read_evaluations
from apnpql_jax.runs.run_folder import CONFIG_FILE, load_run_config
from apnpql_jax.runs.text import read_text

EVALUATION_FILE = "evaluation.json"
"""What ``apnpql evaluate RUN --json`` printed, if it was put into the run folder."""

_MAX_BYTES = 1 << 20


@dataclasses.dataclass(frozen=True)
class Run:
  """Settings and results of a run."""

  name: str
  config: TrainConfig
  evaluations: Sequence[Row]
  """Rows of the held-out evaluations during training, oldest first."""

  final: dict[str, Any] | None = None
  """The evaluation after training, as ``apnpql evaluate --json`` prints it, if any."""

  versions: dict[str, Any] = dataclasses.field(default_factory=dict)
  folder: Path | None = None

  @property
  def steps(self) -> list[float]:
    """Environment steps of the evaluations."""
    return [row[STEP] or 0.0 for row in self.evaluations]

  @property
  def minutes(self) -> list[float]:
    """Wall clock of the evaluations in minutes of training."""
    return [(row.get(WALL) or 0.0) / 60 for row in self.evaluations]

  @property
  def rates(self) -> list[float]:
    """Success rates of the evaluations, in [0, 1]."""
    return [row[SUCCESS] or 0.0 for row in self.evaluations]

  @property
  def episodes(self) -> list[int]:
    """Episodes of each evaluation; 0 if unknown."""
    return [int(row.get(EPISODES) or 0) for row in self.evaluations]

  @property
  def finished(self) -> bool:
    """Whether a checkpoint of the last step exists."""
    return self.folder is not None and is_finished(self.folder, self.config)


def find(paths: Iterable[Path]) -> list[Run]:
  """Returns the runs in the given folders, each once.

  Args:
    paths: Run folders, and folders with run folders inside, such as those of sweeps.
      An unreadable run inside a folder is only reported.

  Raises:
    ConfigError: No folder is named.
    FileError: A folder is no run and holds none, or a named run cannot be read.
  """
  found: dict[Path, Run] = {}
  for path in paths:
    if (path / CONFIG_FILE).is_file():
      found.setdefault(path.resolve(), read(path))
      continue
    inside = sorted(inner.parent for inner in path.glob(f"*/{CONFIG_FILE}"))
    if not inside:
      load_run_config(path)  # Raises an error that lists the runs nearby.
    for folder in inside:
      try:
        found.setdefault(folder.resolve(), read(folder))
      except UserError as error:
        print_line(f"left out: {error}")
  if not found:
    raise ConfigError("name at least one run or sweep folder that can be read")
  return list(found.values())


def read(folder: Path) -> Run:
  """Returns the run in a folder.

  Raises:
    FileError: It is not a run folder, or one of its files cannot be read.
  """
  evaluations = read_evaluations(folder)
  return Run(
    folder.resolve().name,
    load_run_config(folder),
    evaluations,
    _final(folder / EVALUATION_FILE, evaluations),
    _versions(folder / provenance.FILE),
    folder,
  )


def is_finished(folder: Path, config: TrainConfig) -> bool:
  """Returns whether a run folder holds a checkpoint of the last step."""
  names = (path.name for path in (folder / "checkpoints").glob("*"))
  return any(int(x) >= config.total_steps for x in names if x.isdecimal())


def _versions(path: Path) -> dict[str, Any]:
  """Returns the versions that a run was started with; none if it has no file."""
  data = _json(path) or {}
  match data.get("git"):
    case None | {"commit": str()}:
      return data
  raise FileError(f"{path} is not what a run writes")


def _final(path: Path, evaluations: Sequence[Row]) -> dict[str, Any] | None:
  """Returns the evaluation in a file, unless the run was evaluated later."""
  if (data := _json(path)) is None:
    return None
  try:
    float(data["success_rate"]), int(data["episodes"])
    step = int(data.get("checkpoint_step", sys.maxsize))
  except (LookupError, ValueError, TypeError):
    raise FileError(f"{path} is not what `apnpql evaluate --json` prints") from None
  if evaluations and step < (evaluations[-1][STEP] or 0.0):
    print_line(f"left out: {path} is from step {step:,}, before the last evaluation")
    return None
  return data


def _json(path: Path) -> dict[str, Any] | None:
  """Returns the object in a small JSON file; None if there is no file or it is empty.

  ``apnpql evaluate RUN --json > RUN/evaluation.json`` leaves it empty until it ends.
  """
  if not path.is_file():
    return None
  try:
    if not (text := read_text(path, _MAX_BYTES)):
      return None
    data = json.loads(text)
  except (OSError, ValueError, RecursionError) as error:
    raise FileError(f"{path} cannot be read: {error}") from None
  if not isinstance(data, dict):
    raise FileError(f"{path} is not a JSON object")
  return data
