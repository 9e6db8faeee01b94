"""One line of the report: what was found and, if something is wrong, the cure."""

from __future__ import annotations

from collections.abc import Callable, Iterable
import dataclasses

from apnpql_jax.errors import one_line


@dataclasses.dataclass(frozen=True)
class Finding:
  """Result of a check."""

  section: str
  """Part of the report."""

  name: str
  """What was checked."""

  text: str
  """What was found."""

  cure: str = ""
  """What to change; empty if nothing."""

  needed: bool = True
  """Whether the cure must be applied; otherwise it is advice."""

  broken: bool = False
  """Whether checks that build on this one are pointless."""


def checked(
  section: str, name: str, check: Callable[[], Iterable[Finding]], cure: str = ""
) -> list[Finding]:
  """Returns the findings of a check; an exception becomes one, with this cure."""
  try:
    return list(check())
  except Exception as error:  # Whatever a broken machine makes a library raise.
    text = ": ".join(dict.fromkeys((type(error).__name__, one_line(error))))
    cure = cure or f"mend what {name!r} reports"
    return [Finding(section, name, text, cure, broken=True)]


def size(count: float) -> str:
  """Returns a number of bytes as text, such as ``1.5 GiB``."""
  for unit in ("B", "KiB", "MiB", "GiB"):
    if count < 1024:
      break
    count, unit = count / 1024, "TiB"
  return f"{count:.3g} {unit}"
