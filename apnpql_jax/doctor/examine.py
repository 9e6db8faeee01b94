"""All checks in their order."""

from __future__ import annotations

from collections.abc import Callable

from apnpql_jax.doctor import machine, software, worker
from apnpql_jax.doctor.findings import Finding, checked


def examine(self_test: bool, tell: Callable[[str], None]) -> list[Finding]:
  """Returns the findings of all checks.

  Args:
    self_test: Whether to play episodes, draw and learn as well.
    tell: Is called with the name of each check that has ended.
  """
  found = checked("software", "versions", software.versions)
  found += checked("extras", "extras", software.extras)
  found += checked("machine", "cores", machine.cores)
  found += checked("disk", "cache", machine.caches)
  found += checked("disk", "runs", machine.run_folders)
  free: int | None = None

  def work() -> list[Finding]:
    nonlocal free
    more, free = worker.examine(self_test, tell)
    return more

  late = checked("devices", "check", work)
  found += checked("machine", "memory", lambda: machine.memory(free))
  return sorted(found + late, key=lambda x: _ORDER.index(x.section))


_ORDER = ("software", "extras", "machine", "disk", "devices", "self-test")
