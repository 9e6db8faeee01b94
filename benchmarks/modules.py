"""How the time of a program is spent on the modules of its networks."""

from __future__ import annotations

import collections
from collections.abc import Callable, Iterator
from pathlib import Path
import re
import tempfile
from typing import Any

import jax
from jax.profiler import ProfileData

OP = re.compile(r'^\s*(?:ROOT )?%?([\w.-]+) = .*?op_name="([^"]*)"', re.MULTILINE)
"""Name of an operation in HLO, and from where in the program it comes."""

MODULE = re.compile(r"(?:^|[/(])([A-Z]\w*)")
"""The outermost one: Flax names a scope after each; functions have small letters."""

AROUND = re.compile(r"(?:while|call|conditional)\b")
"""Operations that last as long as those inside."""


def shares(program: Any, run: Callable[[], Any]) -> dict[str, float]:
  """What share of the time of all threads each module has, there and back.

  Args:
    program: compiled for CPUs, see ``timing.compiled``.
    run: calls it; returns all arrays that it computes.

  Returns:
    name of a Flax module, the largest first, and "other" -> share.
  """
  origins = dict(OP.findall(program.as_text()))
  spent: collections.defaultdict[str, float] = collections.defaultdict(float)
  for name, seconds in _operations(run):
    if name in origins and not AROUND.match(name):
      found = MODULE.search(origins[name])
      spent[found[1] if found else "other"] += seconds
  total, other = sum(spent.values()), spent.pop("other", 0.0)
  found = {
    name: spent[name] / total for name in sorted(spent, key=lambda name: -spent[name])
  }
  return found | {"other": other / total}


def _operations(run: Callable[[], Any]) -> Iterator[tuple[str, float]]:
  """Name and seconds of all that JAX's profiler sees in a call."""
  with tempfile.TemporaryDirectory() as folder:
    with jax.profiler.trace(folder):
      jax.block_until_ready(run())
    for path in Path(folder).rglob("*.xplane.pb"):
      for plane in ProfileData.from_file(str(path)).planes:
        for line in plane.lines:
          for event in line.events:
            yield event.name, 1e-9 * event.duration_ns
