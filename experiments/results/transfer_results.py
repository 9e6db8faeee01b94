"""Stored results of `apnpql transfer` as tables; see ``transfer_table``."""

from __future__ import annotations

import collections
import json
from pathlib import Path
from typing import Any

from apnpql_jax.errors import FileError, one_line
from apnpql_jax.reports.tables import listed, markdown
from apnpql_jax.runs.success import wilson_interval

HEAD = "run,task,trained,physics,renderer,looks,latency,admittance,solved,95%,failed in"
"""Columns of the table; trained: in plain or randomized worlds."""

NAMES = {"native": "MuJoCo", "mjx": "MJX", "bullet": "Bullet"}
NAMES |= {"opengl": "OpenGL", "tiny": "TinyRenderer", "trained": "randomized"}
"""Options of the command in words, where they differ."""

MALFORMED = (OSError, ValueError, LookupError, TypeError, AttributeError)
"""Exceptions that a damaged result causes."""


def read(path: Path) -> dict[str, Any]:
  """Returns a stored result.

  Raises:
    FileError: It is damaged.
  """
  try:
    found = json.loads(path.read_text())
    order(found), row_of(found)
    return found
  except MALFORMED as error:
    raise FileError(
      f"{path} is not a result of this script: {one_line(error)}; remove it"
    ) from None


def table(results: list[dict[str, Any]]) -> str:
  """Returns the results in Markdown, a row per cell."""
  rows = [list[str](HEAD.split(","))]
  rows += [row_of(found) for found in sorted(results, key=order)]
  return markdown(rows) + "\n"


def by_training(results: list[dict[str, Any]]) -> str:
  """Returns the results of policies in Markdown: a row per cell, a column per training.

  The runs of a training have names that differ after the last hyphen, by their seed.
  The Wilson interval is that of their episodes together.
  """
  of_policies = [found for found in sorted(results, key=order) if "trained" in found]
  groups = collections.defaultdict[tuple[str, str], list[dict[str, Any]]](list)
  for found in of_policies:
    groups[cell_label(found), found["run"].rpartition("-")[0]].append(found)
  trainings = dict.fromkeys(training for _, training in groups)
  rows = [["tested in", *trainings]]
  for cell in dict.fromkeys(map(cell_label, sorted(of_policies, key=cell_order))):
    rows.append([cell, *(together(groups[cell, training]) for training in trainings)])
  return markdown(rows) + "\n"


def together(found: list[dict[str, Any]]) -> str:
  """Returns the successes of some results, with the Wilson interval of all episodes."""
  if not found:
    return "-"
  solved, played = (sum(x[name] for x in found) for name in ("successes", "episodes"))
  low, high = (100 * x for x in wilson_interval(solved, played))
  each = " + ".join(str(x["successes"]) for x in found)
  return f"{each} of {played}, {low:.0f} to {high:.0f} %"


def cell_label(found: dict[str, Any]) -> str:
  """Returns the name of a result's cell in words."""
  parts = [NAMES.get(found[key], found[key]) for key in ("physics", "renderer")]
  looks, missing = found["looks"], " and ".join(found.get("without", ()))
  parts.append(NAMES.get(looks, looks) + (f" without {missing}" if missing else ""))
  if "latency_ms" in found:
    parts.append(f"{found['latency_ms']} ms")
  return listed([*parts, *["admittance"] * found.get("admittance", False)])


def looks_of(found: dict[str, Any]) -> str:
  """Returns the looks of a result, as in the name of its cell."""
  return "-".join([found["looks"], *found.get("without", ())])


def row_of(found: dict[str, Any]) -> list[str]:
  """Returns the row of a result."""
  low, high = (100 * x for x in found["ci95"])
  latency = f"{found['latency_ms']} ms" if "latency_ms" in found else "-"
  admittance = {True: "on", False: "off"}.get(found.get("admittance"), "-")
  failures = sorted(found["failures"].items(), key=lambda item: -item[1])
  return [
    *(found[name] for name in ("run", "task")),
    found.get("trained", "-"),
    *(found[name] for name in ("physics", "renderer")),
    looks_of(found),
    latency,
    admittance,
    f"{found['successes']} of {found['episodes']}",
    f"{low:.1f} to {high:.1f} %",
    listed(f"{stage}: {count}" for stage, count in failures) or "-",
  ]


def order(found: dict[str, Any]) -> tuple[Any, ...]:
  """Returns what rows are sorted by."""
  return str(found["task"]), str(found["run"]), *cell_order(found)


def cell_order(found: dict[str, Any]) -> tuple[Any, ...]:
  """Returns what cells are sorted by."""
  return (
    ("mjx", "native", "bullet").index(found["physics"]),
    ("rays", "opengl", "tiny").index(found["renderer"]),
    ("plain", "trained", "unseen").index(found["looks"]),
    looks_of(found),
    found.get("admittance", False),
    found.get("latency_ms", 0),
  )
