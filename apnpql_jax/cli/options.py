"""Command-line options, and their parsing with one-line errors."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import dataclasses
import io
import os
from pathlib import Path
import re
from typing import Annotated, ClassVar, TypeVar

import tyro

from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import ConfigError

T = TypeVar("T")


def default_hint(text: str) -> object:
  """Returns the annotation of an option whose help describes its default."""
  return tyro.conf.arg(help_behavior_hint=text)


Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]
_OfPreset = Annotated[str | None, default_hint("(default: as in the preset)")]
Count = Annotated[int | None, default_hint("")]
AsTrained = Annotated[str | None, default_hint("(default: as in training)")]
Acting = Annotated[
  str | None, default_hint("(default: as in the evaluations of the run)")
]
File = Annotated[Path | None, default_hint("")]


@dataclasses.dataclass(frozen=True)
class Command:
  """Options of every command."""

  uses_jax: ClassVar[bool] = True
  """Whether the command needs the settings of ``runtime.configure``."""

  json: Flag = False
  """Print only one JSON object on standard output."""


@dataclasses.dataclass(frozen=True)
class OfRun(Command):
  """Options of commands that read a run."""

  task_file: File = None
  """Python file of the run's task, if that is not installed."""


@dataclasses.dataclass(frozen=True)
class _Play(Command):
  episodes: int = 200
  """Number of episodes."""

  seed: int = 0
  """Random seed of the episodes and of the policy or noise."""

  video: File = None
  """Also write a video of the first four episodes to this .mp4 or .gif file."""

  overwrite: Flag = False
  """Replace files that exist."""


@dataclasses.dataclass(frozen=True)
class Train(OfRun):
  """Trains an agent: apnpql train PRESET [options].

  Every setting of the preset can be overridden, e.g. --agent.epsilon 0.5.

  apnpql train push_plate --seed 1 --run runs/mine

  apnpql train --resume runs/mine
  """

  preset: tyro.conf.Positional[str] = ""
  """Preset to start from; `apnpql list` shows all. Or the path of a file with a preset
  and its task, such as ./my_task.py."""

  run: Annotated[Path | None, default_hint("(default: first free runs/PRESET-<n>)")] = (
    None
  )
  """Run folder to create."""

  resume: File = None
  """Run folder to resume from its latest checkpoint."""

  init_from: Annotated[str | None, default_hint("")] = None
  """Run with whose weights the new one starts: RUN (its newest checkpoint), RUN:STEP or
  RUN:best."""

  overwrite: Flag = False
  """Replace the existing run in --run."""

  backend: _OfPreset = None
  """Short for --env.backend: auto, mjx or native."""

  obs: _OfPreset = None
  """Short for --env.obs: pixels or state."""

  algorithm: _OfPreset = None
  """Short for --agent.algorithm; `apnpql list` shows all."""

  devices: int = 1
  """Devices that share the worlds and batches; 0: all (always with --coordinator). Not
  stored in the run: pass it again with --resume."""

  coordinator: str = ""
  """Address and port of the first of several processes, or auto to take it and the next
  two options from the batch system; see docs/scaling.md."""

  processes: Count = None
  """Number of processes that share the run."""

  process: Count = None
  """Index of this process, from 0."""

  config: Annotated[TrainConfig, tyro.conf.arg(name="")] = dataclasses.field(
    default_factory=TrainConfig
  )


@dataclasses.dataclass(frozen=True)
class _HeldOut(OfRun):
  run: tyro.conf.Positional[str] = ""
  """Run folder."""

  checkpoint: str = "newest"
  """Checkpoint: newest, best (highest success rate in training) or its step."""

  acting: Acting = None
  """How to choose an action: policy draws from the policy; mean takes the component
  mean, with either gripper command, where the density of the policy is highest; prior
  draws from b without Q; greedy takes the highest Q."""

  bank_seed: int = 0
  """Seed of the states that episodes start from. Seeds other than 0 draw states on
  which nothing was trained or selected."""

  backend: AsTrained = None
  """Physics engine: auto, mjx or native."""


@dataclasses.dataclass(frozen=True)
class Evaluate(_Play, _HeldOut):
  """Plays held-out episodes with a trained agent: apnpql evaluate RUN [options].

  apnpql evaluate runs/mine --episodes 200 --seed 7

  apnpql evaluate runs/mine --checkpoint best --video best.mp4
  """


@dataclasses.dataclass(frozen=True)
class Diagnose(_HeldOut):
  """Reports where and why an agent fails: apnpql diagnose RUN [options].

  apnpql diagnose runs/mine

  apnpql diagnose runs/mine --checkpoint best --episodes 128 --acting policy
  """

  episodes: int = 64
  """Number of episodes of each acting rule."""

  seed: int = 0
  """Random seed of the episodes and of the policy."""


@dataclasses.dataclass(frozen=True)
class Collect(_Play):
  """Plays episodes with the scripted expert: apnpql collect TASK [options].

  apnpql collect push_plate --video expert.mp4

  apnpql collect push_plate --episodes 200 --noise 0.03 --save mine.npz

  apnpql collect push_plate --save mine --format lerobot
  """

  task: tyro.conf.Positional[str] = ""
  """Task to play, or the path of its file; `apnpql list` shows all."""

  backend: str = "auto"
  """Physics engine: auto, mjx or native."""

  noise: float = 0.0
  """Standard deviation of the noise on the expert's joint velocities (rad/s)."""

  save: File = None
  """Also record the same number of episodes, started from training resets, to this
  demonstrations file or dataset folder."""

  format: str = "npz"
  """Format of --save: npz (demonstrations for training) or lerobot (a dataset with
  videos, for LeRobot)."""

  append: Flag = False
  """Add the episodes to --save if it exists."""

  solved_only: Flag = False
  """Save only solved episodes."""


@dataclasses.dataclass(frozen=True)
class Convert(Command):
  """Converts a recording to demonstrations: apnpql convert REC TASK OUT.npz.

  apnpql convert recording.npz push_plate mine.npz

  apnpql convert other.npz push_plate mine.npz --append --solved-only
  """

  recording: tyro.conf.Positional[str] = ""
  """Joint trajectories and object poses (docs/demonstrations.md), another
  demonstrations file, or the folder of a dataset of LeRobot, such as the log of a
  simulated robot."""

  task: tyro.conf.Positional[str] = ""
  """Task of the recording, or the path of its file; `apnpql list` shows all."""

  out: tyro.conf.Positional[str] = ""
  """File to write, for --replay.demonstrations."""

  append: Flag = False
  """Add the episodes to the file if it exists."""

  solved_only: Flag = False
  """Keep only solved episodes."""

  allow_unsolved: Flag = False
  """Write the file even if no episode in it is solved."""

  overwrite: Flag = False
  """Replace the file if it exists."""


@dataclasses.dataclass(frozen=True)
class Repeat(OfRun):
  """Repeats an update with NaN or infinity: apnpql repeat RUN/faults/step_<n>.npz.

  apnpql repeat runs/mine/faults/step_00001024.npz

  apnpql repeat runs/mine/faults/step_00001024.npz --task-file my_task.py
  """

  file: tyro.conf.Positional[str] = ""
  """File that a run wrote when it stopped, still in its run folder."""


@dataclasses.dataclass(frozen=True)
class List(Command):
  """Lists the tasks, presets, algorithms and backends: apnpql list [FILE...].

  apnpql list --json

  apnpql list my_task.py --contacts
  """

  files: tyro.conf.Positional[tuple[Path, ...]] = ()
  """Python files whose tasks to build and list as well."""

  contacts: Flag = False
  """Report contacts and physics speed of every scene instead; compiles for minutes."""


def parse(kind: type[T], name: str, argv: Sequence[str], default: T | None = None) -> T:
  """Parses the options ``kind`` of command ``name`` on top of ``default``.

  Raises:
    ConfigError: An option is unknown, incomplete or unreadable; the message is tyro's
      error box on one line.
    SystemExit: ``--help`` was given, and the help printed.
  """
  errors = io.StringIO()
  if os.environ.get("NO_COLOR"):
    tyro._experimental_options["ansi_codes"] = False
  try:
    with contextlib.redirect_stderr(errors):
      return tyro.cli(
        kind,
        args=list(argv),
        prog=f"apnpql {name}",
        default=kind() if default is None else default,
        config=(tyro.conf.DisallowNone,),
      )
  except BrokenPipeError:  # The reader of the help has enough, as `head`.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    raise SystemExit(0) from None
  except SystemExit as stop:
    if stop.code in (0, None):  # --help was printed.
      raise
    raise ConfigError(
      f"{_unbox(errors.getvalue())} (see apnpql {name} --help)"
    ) from None


def _unbox(text: str) -> str:
  """Returns the message of tyro's error box: its first section and first suggestion.

  In an ASCII locale, the box has no sides and its title is a section.
  """
  rows = [line.strip("│ ") for line in text.splitlines() if line[:1] not in "╭╰"]
  sections: list[list[str]] = [[]]
  for row in rows:
    if row and not row.strip("─-"):
      sections.append([])
    else:
      sections[-1].append(row)
  if "╭" not in text:
    sections = sections[1:] or [[]]
  message = " ".join(sections[0]) or " ".join(text.split()) or "bad options"
  if re.search(r"\['[^']+,[^']+'\]", message):
    message += "; separate the values by spaces"
  for section in sections[1:]:
    options = [row for row in section if row.startswith("--")]
    if section[0].startswith("Perhaps you meant") and options:
      message += f"; perhaps you meant {options[0]}"
  return message
