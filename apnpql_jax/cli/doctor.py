"""The command ``apnpql doctor``."""

from __future__ import annotations

from collections.abc import Callable, Generator
import contextlib
import dataclasses
import itertools
import sys
from typing import Any, ClassVar

from apnpql_jax.cli import text
from apnpql_jax.cli.options import Command, Flag
from apnpql_jax.errors import UNWELL


@dataclasses.dataclass(frozen=True)
class Doctor(Command):
  """Checks the installation and the machine: apnpql doctor.

  Ends with what to change; the exit code is 1 if something must be changed.

  apnpql doctor --fast

  apnpql doctor --json > doctor.json
  """

  uses_jax: ClassVar[bool] = False

  fast: Flag = False
  """Leave out the self-test: episodes of each expert, images and one update."""


def doctor(args: Doctor) -> dict[str, Any]:
  """Checks everything; returns the findings, what to change, and the exit code."""
  from apnpql_jax.doctor.examine import examine

  with _status() as tell:
    found = examine(not args.fast, tell)
  must = [x.cure for x in found if x.cure and x.needed]
  advice = [x.cure for x in found if x.cure and not x.needed]
  code = UNWELL if must else 0
  if args.json:
    sections: dict[str, dict[str, str]] = {}
    for x in found:
      sections.setdefault(x.section, {})[x.name] = x.text
    return {**sections, "must_change": must, "advice": advice, "exit_code": code}
  lines = []
  for section, group in itertools.groupby(found, lambda x: x.section):
    marked = [(f"{'!' if x.cure else ' '} {x.name}", x.text) for x in group]
    lines += [section, *text.rows(marked), ""]
  for title, cures in (("To change:", must), ("Could be better:", advice)):
    if cures:
      lines += [title, *(line for x in cures for line in text.wrapped(x, "- ")), ""]
  if not must:
    lines.append("All is well." if not advice else "Nothing must be changed.")
  return {"text": "\n".join(lines), "exit_code": code}


@contextlib.contextmanager
def _status() -> Generator[Callable[[str], None], None, None]:
  """Yields a function that shows which check has ended, on a terminal only."""
  if not sys.stderr or not sys.stderr.isatty():
    yield lambda _: None
    return
  from rich.console import Console

  with Console(stderr=True).status("checking; half a minute or more") as status:
    yield lambda name: status.update(f"checking; done: {name}")
