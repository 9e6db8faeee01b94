"""Optional metric sinks: TensorBoard and Weights & Biases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import importlib.util
from pathlib import Path
from typing import Any
import uuid

from apnpql_jax.console import reporting
from apnpql_jax.errors import ConfigError, check_name
from apnpql_jax.runs.metrics import Sink
from apnpql_jax.runs.text import read_text, write_text


class _TensorboardSink:
  """Sink to event files in ``tensorboard/`` of the run folder."""

  def __init__(self, run_dir: Path, config: Mapping[str, Any], resume_step: int | None):
    del config
    from tensorboardX import SummaryWriter

    # TensorBoard discards what a killed process wrote from ``purge_step`` on.
    purge_step = None if resume_step is None else resume_step + 1
    self._writer = SummaryWriter(
      logdir=str(run_dir / "tensorboard"), purge_step=purge_step, flush_secs=1
    )

  def write(self, step: int, row: Mapping[str, float]) -> None:
    """See ``Sink.write``."""
    for name, value in row.items():
      self._writer.add_scalar(name, value, step)

  def close(self) -> None:
    """See ``Sink.close``."""
    self._writer.close()


class _WandbSink:
  """Sink to a Weights & Biases run named after the run folder, also after a resume.

  Unless ``wandb_id`` sets the id, one is drawn and kept in the run folder.
  """

  def __init__(self, run_dir: Path, config: Mapping[str, Any], resume_step: int | None):
    del resume_step
    import wandb

    path = run_dir / "wandb_id"
    identity = config["wandb_id"]
    if not identity:
      identity = read_text(path, 100) if path.exists() else uuid.uuid4().hex[:8]
    write_text(path, identity)
    self._run = wandb.init(
      project=config["wandb_project"],
      entity=config["wandb_entity"] or None,
      id=identity,
      resume="allow",
      name=run_dir.name,
      dir=str(run_dir),
      config=dict(config),
      allow_val_change=True,  # Such as ``total_steps``.
    )
    self._next_step = self._run.step

  def write(self, step: int, row: Mapping[str, float]) -> None:
    """See ``Sink.write``; leaves out steps that the run already has."""
    if step >= self._next_step:
      self._run.log(dict(row), step=step)

  def close(self) -> None:
    """See ``Sink.close``."""
    self._run.finish()


_SINKS = {
  "tensorboard": (_TensorboardSink, "tensorboardX", "tb"),
  "wandb": (_WandbSink, "wandb", "wandb"),
}
"""Name -> class, the package it needs, the extra that installs it."""


def check_sinks(names: Sequence[str]) -> None:
  """Rejects sinks that cannot be opened.

  Raises:
    ConfigError: A name is unknown, or its package is not installed.
  """
  for name in names:
    check_name("metric sink", name, list(_SINKS))
    _, package, extra = _SINKS[name]
    if importlib.util.find_spec(package) is None:
      raise ConfigError(
        f"metric sink {name!r} needs {package}, which is not installed: "
        f"pip install 'apnpql-jax[{extra}]'"
      )


def make_sinks(
  names: Sequence[str],
  run_dir: Path,
  config: Mapping[str, Any],
  *,
  resume_step: int | None = None,
) -> list[Sink]:
  """Opens the named sinks; prints a line for each that cannot be opened.

  Args:
    names: Names of sinks.
    run_dir: The run folder.
    config: Settings of the run as plain data, shown with the curves.
    resume_step: Step from which the run resumes; None for a new run.
  """
  sinks: list[Sink] = []
  for name in names:
    with reporting(f"open the metric sink {name}"):
      sinks.append(_SINKS[name][0](run_dir, config, resume_step))
  return sinks
