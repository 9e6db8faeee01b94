"""The command ``apnpql completion``: commands and options completed by the shell."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import contextlib
import dataclasses
import functools
import io
import operator
from typing import Annotated, Any, ClassVar

import tyro

from apnpql_jax.cli.options import Command
from apnpql_jax.errors import check_name

SHELLS = ("bash", "zsh")


@dataclasses.dataclass(frozen=True)
class Completion(Command):
  """Prints a script that completes commands and options: apnpql completion SHELL.

  source <(apnpql completion bash)

  apnpql completion zsh > ~/.zfunc/_apnpql
  """

  uses_jax: ClassVar[bool] = False

  shell: tyro.conf.Positional[str] = ""
  """Shell: bash or zsh."""


def completion(args: Completion, commands: Mapping[str, type[Any]]) -> dict[str, Any]:
  """Returns the script that completes ``commands``, name -> class of the options."""
  return {"text": _script(args.shell, commands.items())}


def _script(shell: str, commands: Iterable[tuple[str, Any]]) -> str:
  """Returns tyro's script for the commands, each with its options."""
  check_name("shell", shell, SHELLS)
  kinds = [
    Annotated[kind, tyro.conf.subcommand(name=name, default=kind())]
    for name, kind in commands
  ]
  printed = io.StringIO()
  with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
    tyro.cli(
      functools.reduce(operator.or_, kinds),
      prog="apnpql",
      args=["--tyro-print-completion", shell],
    )
  text = printed.getvalue()
  if shell == "bash":
    # Where it offers nothing, bash completes names of files.
    text = _one_line(text).replace(
      "complete -F", "complete -o bashdefault -o default -F"
    )
  return text


def _one_line(script: str) -> str:
  """Returns a script whose descriptions are not in lines, which bash splits."""
  return "\n".join(
    line.replace(r"\n", " ") if line.startswith("COMPLETION_SPEC") else line
    for line in script.split("\n")
  )
