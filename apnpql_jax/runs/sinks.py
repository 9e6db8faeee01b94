"""Optional metric sinks: TensorBoard and Weights & Biases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import importlib.util
from pathlib import Path
from typing import Any

from apnpql_jax.errors import ConfigError, check_name
from apnpql_jax.runs.metrics import Sink


class _TensorboardSink:
  """Sink to event files in ``tensorboard/`` of the run folder."""

  def __init__(self, run_dir: Path, config: Mapping[str, Any]):
    del config
    from tensorboardX import SummaryWriter

    self._writer = SummaryWriter(logdir=str(run_dir / "tensorboard"))

  def write(self, step: int, row: Mapping[str, float]) -> None:
    """See ``Sink.write``."""
    for name, value in row.items():
      self._writer.add_scalar(name, value, step)

  def close(self) -> None:
    """See ``Sink.close``."""
    self._writer.close()


class _WandbSink:
  """Sink to a Weights & Biases run named after the run folder."""

  def __init__(self, run_dir: Path, config: Mapping[str, Any]):
    import wandb

    self._run = wandb.init(
      project="apnpql_jax", name=run_dir.name, dir=str(run_dir), config=dict(config)
    )

  def write(self, step: int, row: Mapping[str, float]) -> None:
    """See ``Sink.write``."""
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
  names: Sequence[str], run_dir: Path, config: Mapping[str, Any]
) -> list[Sink]:
  """Opens the named sinks; ``config`` is plain data shown with the curves."""
  return [_SINKS[name][0](run_dir, config) for name in names]
