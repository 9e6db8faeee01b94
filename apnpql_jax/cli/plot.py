"""The command ``apnpql plot``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, ClassVar, Literal

import tyro

from apnpql_jax.cli.options import Command
from apnpql_jax.cli.outputs import check_output
from apnpql_jax.errors import ConfigError, FileError

Band = Literal["interval", "range"]


@dataclasses.dataclass(frozen=True)
class Plot(Command):
  """Draws the success of runs over steps and time: apnpql plot RUN... [--out FILE].

  Runs that differ only in their seeds are one curve; there is one panel per task.

  apnpql plot runs/push_plate-*

  apnpql plot runs/push_plate-sweep-1 --out sweep.svg --x steps
  """

  uses_jax: ClassVar[bool] = False

  runs: tyro.conf.Positional[tuple[str, ...]] = ()
  """Run folders, or folders of sweeps."""

  out: Path = Path("curves.png")
  """File to write: .png, .svg or .pdf. An existing one is replaced."""

  x: Literal["both", "steps", "minutes"] = "both"
  """Abscissa: environment steps, minutes of wall clock, or a panel for each."""

  band: Band = "interval"
  """Band around the mean: interval (95 %: the wider of t over seeds and Wilson over all
  episodes) or range (lowest to highest seed)."""


def plot(args: Plot) -> dict[str, Any]:
  """Draws the figure and returns its file."""
  from apnpql_jax.reports import figure, groups, reading, statistics

  if not args.runs:
    raise ConfigError("plot needs runs: apnpql plot RUN...")
  if args.out.suffix not in figure.SUFFIXES:
    raise ConfigError(f"--out {args.out} must end in {', '.join(figure.SUFFIXES)}")
  check_output(args.out)
  runs = reading.find(map(Path, args.runs))
  if not any(run.evaluations for run in runs):
    raise FileError(
      "no run has an evaluation yet; there is one every --eval-every steps"
    )
  axes = statistics.AXES if args.x == "both" else (args.x,)
  figure.save(groups.group(runs), args.out, axes=axes, band=args.band)
  return {"figure": str(args.out), "runs": len(runs)}
