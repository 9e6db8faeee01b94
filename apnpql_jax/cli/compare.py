"""The command ``apnpql compare``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, ClassVar

import tyro

from apnpql_jax.cli.options import Command, File
from apnpql_jax.cli.outputs import check_output
from apnpql_jax.cli.plot import Band
from apnpql_jax.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Compare(Command):
  """Compares runs in Markdown or as a page: apnpql compare RUN... [--html FILE].

  Runs that differ only in their seeds are one group. Prints the tables unless a file is
  named.

  apnpql compare runs/push_plate-1 runs/push_plate-2

  apnpql compare runs/push_plate-sweep-1 --out table.md --html report.html
  """

  uses_jax: ClassVar[bool] = False

  runs: tyro.conf.Positional[tuple[str, ...]] = ()
  """Run folders, or folders of sweeps."""

  out: File = None
  """Write the tables to this Markdown file. An existing one is replaced."""

  html: File = None
  """Write a page with curves, tables, settings and videos to this .html file. An
  existing one is replaced."""

  band: Band = "interval"
  """Band of the curves, see apnpql plot."""


def compare(args: Compare) -> dict[str, Any]:
  """Writes the files asked for; returns them and the groups."""
  from apnpql_jax.reports import groups, page, reading, tables
  from apnpql_jax.runs.text import write_text

  if not args.runs:
    raise ConfigError("compare needs runs: apnpql compare RUN...")
  if args.html is not None and args.html.suffix not in (".html", ".htm"):
    raise ConfigError(f"--html {args.html} must end in .html")
  outputs = {"markdown": args.out, "html": args.html}
  files = {name: path for name, path in outputs.items() if path is not None}
  for path in files.values():
    check_output(path)
  found = groups.group(reading.find(map(Path, args.runs)))
  text = tables.compare(found)
  if args.out is not None:
    write_text(args.out, text)
  if args.html is not None:
    page.write(found, args.html, band=args.band)
  written = {name: str(path) for name, path in files.items()}
  if args.json:
    return {**written, "groups": tables.records(found)}
  return written or {"text": text}
