"""Options of the command line, and their parsing with one-line errors."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import dataclasses
import io
from pathlib import Path
from typing import Annotated, TypeVar

import tyro

from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import ConfigError

T = TypeVar("T")
_Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]
_PRESET_HINT = tyro.conf.arg(help_behavior_hint="(default: as the preset says)")


@dataclasses.dataclass(frozen=True)
class Train:
  """Trains an agent: apnpql train PRESET [options].

  Every setting of the preset can be overridden, e.g. --agent.epsilon 0.5.
  """

  preset: tyro.conf.Positional[str] = ""
  """Settings to start from; `apnpql list` names them."""

  run: Annotated[
    Path | None,
    tyro.conf.arg(help_behavior_hint="(default: first free runs/PRESET-<n>)"),
  ] = None
  """Folder for everything the run writes."""

  resume: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="")] = None
  """Run folder to go on with, from its newest checkpoint."""

  overwrite: _Flag = False
  """Replace the run that --run holds."""

  backend: Annotated[str | None, _PRESET_HINT] = None
  """Short for --env.backend: auto, mjx or native."""

  obs: Annotated[str | None, _PRESET_HINT] = None
  """Short for --env.obs: pixels or state."""

  algorithm: Annotated[str | None, _PRESET_HINT] = None
  """Short for --agent.algorithm; `apnpql list` names them."""

  devices: int = 1
  """Devices between which worlds and batches are split; 0: all, as several processes
  always do."""

  coordinator: str = ""
  """Address and port of the first process, where several share the run: see
  docs/scaling.md; auto: ask the batch system, which then knows the rest too."""

  processes: Annotated[int | None, tyro.conf.arg(help_behavior_hint="")] = None
  """How many processes share the run."""

  process: Annotated[int | None, tyro.conf.arg(help_behavior_hint="")] = None
  """Which of them this is, from 0."""

  json: _Flag = False
  """Print one JSON object on standard output and nothing else there."""

  config: Annotated[TrainConfig, tyro.conf.arg(name="")] = dataclasses.field(
    default_factory=TrainConfig
  )


@dataclasses.dataclass(frozen=True)
class Evaluate:
  """Plays held-out episodes with a trained agent: apnpql evaluate RUN [options]."""

  run: tyro.conf.Positional[str] = ""
  """Run folder."""

  checkpoint: str = "newest"
  """Which one to play: newest, best (of highest success rate while training), or its
  number of steps."""

  episodes: int = 200
  """Episodes to play."""

  seed: int = 0
  """Seed of the episodes and of the policy."""

  greedy: _Flag = False
  """Instead of drawing an action as in training take the candidate of highest value,
  or, of a parametric policy, the mean."""

  backend: Annotated[
    str | None, tyro.conf.arg(help_behavior_hint="(default: as in training)")
  ] = None
  """Physics engine: auto, mjx or native."""

  video: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="")] = None
  """Also write a video of the first four episodes to this .mp4 or .gif."""

  json: _Flag = False
  """Print one JSON object on standard output and nothing else there."""


@dataclasses.dataclass(frozen=True)
class Collect:
  """Plays episodes with the scripted expert: apnpql collect TASK [options]."""

  task: tyro.conf.Positional[str] = ""
  """Task to play; `apnpql list` names them."""

  episodes: int = 200
  """Episodes to play."""

  seed: int = 0
  """Seed of the episodes and of the noise."""

  backend: str = "auto"
  """Physics engine: auto, mjx or native."""

  noise: float = 0.0
  """Standard deviation of the noise on the expert's joint velocities, rad/s."""

  save: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="")] = None
  """Also write that many episodes, from reset states of training, to this file of
  demonstrations."""

  video: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="")] = None
  """Also write a video of the first four episodes to this .mp4 or .gif."""

  json: _Flag = False
  """Print one JSON object on standard output and nothing else there."""


@dataclasses.dataclass(frozen=True)
class Convert:
  """Makes demonstrations of a recording: apnpql convert RECORDING.npz TASK OUT.npz."""

  recording: tyro.conf.Positional[str] = ""
  """Joint trajectories with the poses of the objects; docs/demonstrations.md has the
  format."""

  task: tyro.conf.Positional[str] = ""
  """Task they show; `apnpql list` names them."""

  out: tyro.conf.Positional[str] = ""
  """File to write, for --replay.demonstrations."""

  json: _Flag = False
  """Print one JSON object on standard output and nothing else there."""


@dataclasses.dataclass(frozen=True)
class Repeat:
  """Repeats an update that was not finite: apnpql repeat RUN/faults/step_<n>.npz."""

  file: tyro.conf.Positional[str] = ""
  """What a run wrote when it stopped for such updates; it must lie where it was."""

  json: _Flag = False
  """Print one JSON object on standard output and nothing else there."""


@dataclasses.dataclass(frozen=True)
class List:
  """Names the tasks, presets, algorithms and backends."""

  contacts: _Flag = False
  """Report pairs, contact slots, constraint rows and physics steps per second of every
  scene instead. Takes minutes, as MJX has to compile each."""

  json: _Flag = False
  """Print one JSON object on standard output and nothing else there."""


def parse(kind: type[T], name: str, argv: Sequence[str], default: T | None = None) -> T:
  """Parses the options of one command, on top of ``default``.

  Args:
    kind: one of the dataclasses above.
    name: the command, for help and errors.
    argv: what follows it on the command line.
    default: an instance of ``kind``; its own defaults if None.

  Raises:
    ConfigError: an unknown, incomplete or unreadable option (tyro's boxed message
      as one line).
    SystemExit: ``--help`` was asked for and printed.
  """
  errors = io.StringIO()
  try:
    with contextlib.redirect_stderr(errors):
      return tyro.cli(
        kind,
        args=list(argv),
        prog=f"apnpql {name}",
        default=kind() if default is None else default,
        config=(tyro.conf.DisallowNone,),
      )
  except SystemExit as stop:
    if stop.code in (0, None):  # --help was printed
      raise
    raise ConfigError(
      f"{_unbox(errors.getvalue())} (see apnpql {name} --help)"
    ) from None


def _unbox(text: str) -> str:
  """The message of an error box: its first section, and the first suggestion."""
  rows = [line.strip("│ ") for line in text.splitlines() if line.startswith("│")]
  sections: list[list[str]] = [[]]
  for row in rows:
    if row and not row.strip("─"):
      sections.append([])
    else:
      sections[-1].append(row)
  message = " ".join(sections[0]) or " ".join(text.split()) or "bad options"
  for section in sections[1:]:
    options = [row for row in section if row.startswith("--")]
    if section[0].startswith("Perhaps you meant") and options:
      message += f"; perhaps you meant {options[0]}"
  return message
