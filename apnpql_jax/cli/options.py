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

from apnpql_jax.errors import ConfigError

T = TypeVar("T")


def default_hint(text: str) -> object:
  """Returns the annotation of an option whose help describes its default."""
  return tyro.conf.arg(help_behavior_hint=text)


Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]
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
class Play(Command):
  """Options of commands that play episodes and can film them."""

  episodes: int = 200
  """Number of episodes."""

  seed: int = 0
  """Random seed of the episodes and of the policy or noise."""

  video: File = None
  """Also write a video of the first four episodes to this .mp4 or .gif file."""

  overwrite: Flag = False
  """Replace files that exist."""


@dataclasses.dataclass(frozen=True)
class OfCheckpoint(OfRun):
  """Options of commands that act with a checkpoint of a run."""

  run: tyro.conf.Positional[str] = ""
  """Run folder."""

  checkpoint: str = "newest"
  """Checkpoint: newest, best (highest success rate in training) or its step."""

  acting: Acting = None
  """How to choose an action, see `apnpql evaluate --help`."""


@dataclasses.dataclass(frozen=True)
class HeldOut(OfCheckpoint):
  """Options of commands that play held-out episodes of a run."""

  acting: Acting = None
  """How to choose an action: policy draws from the policy; mean takes the component
  mean, with either gripper command, where the density of the policy is highest; prior
  draws from b without Q; greedy takes the highest Q."""

  bank_seed: int = 0
  """Seed of the states that episodes start from. Seeds other than 0 draw states on
  which nothing was trained or selected."""

  backend: AsTrained = None
  """Physics engine: auto, mjx or native."""


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
