"""Tasks that Orbax abandons when it fails to save or restore an array."""

from __future__ import annotations

import asyncio
from collections.abc import Generator
import contextlib
import logging
import sys
from typing import Any


@contextlib.contextmanager
def silenced() -> Generator[None, None, None]:
  """Hides what abandoned tasks print: pages of tracebacks under the line that counts.

  After the first failed array Orbax closes its event loop, to which TensorStore's
  threads still report the other arrays. The failure itself is raised.
  """
  call_soon = asyncio.BaseEventLoop.call_soon_threadsafe
  unraisable = sys.unraisablehook

  def call_soon_if_open(loop: Any, *args: Any, **kwargs: Any) -> Any:
    try:
      return call_soon(loop, *args, **kwargs)
    except RuntimeError:
      if not loop.is_closed():
        raise

  def unraisable_of_others(report: sys.UnraisableHookArgs) -> None:
    if "orbax" not in str(getattr(report.object, "cr_code", "")):
      unraisable(report)

  asyncio.BaseEventLoop.call_soon_threadsafe = call_soon_if_open
  sys.unraisablehook = unraisable_of_others
  loggers = [logging.getLogger(name) for name in ("absl", "asyncio")]
  levels = [logger.level for logger in loggers]
  for logger in loggers:
    logger.setLevel(logging.CRITICAL)
  try:
    yield
  finally:
    asyncio.BaseEventLoop.call_soon_threadsafe = call_soon
    sys.unraisablehook = unraisable
    for logger, level in zip(loggers, levels, strict=True):
      logger.setLevel(level)
