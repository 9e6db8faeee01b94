"""The control and the policy process of a session, as the main process sees them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
from multiprocessing import get_context
import os
from typing import Any

from apnpql_jax.robot import control_process, policy_process
from apnpql_jax.robot.description import Robot


class Processes:
  """Both processes, each of which ends with the other."""

  def __init__(
    self, robot: Robot, board: str, *, control: dict[str, Any], policy: dict[str, Any]
  ):
    """Starts them.

    Args:
      robot: What they open.
      board: Name of the board.
      control: Options of ``control_process.main``.
      policy: Options of ``policy_process.main``.
    """
    self._context = get_context("spawn")
    self._events, sender = self._context.Pipe(duplex=False)
    one, other = self._context.Pipe()
    self._running: dict[str, Any] = {}
    try:
      args = robot, board, control, sender, one
      self._start("control", control_process.main, *args)
      self._start("policy", policy_process.main, robot, board, policy, other)
    except BaseException:
      self.end(0.0, 0.0)
      raise
    finally:
      for end in (sender, one, other):  # Each must be open in one process only.
        end.close()

  def is_alive(self, name: str) -> bool:
    """Returns whether a process runs."""
    return self._running[name].is_alive()

  def send_signal(self, name: str, number: int) -> None:
    """Sends a signal to a process."""
    os.kill(self._running[name].pid, number)

  def join(self, name: str, seconds: float) -> None:
    """Waits for the end of a process."""
    self._running[name].join(seconds)

  @property
  def ended(self) -> list[str]:
    """Names of the processes that do not run any more."""
    return [name for name in self._running if not self.is_alive(name)]

  def events(self) -> Iterator[Any]:
    """Yields what the control process has reported since: see its ``main``."""
    with contextlib.suppress(EOFError, OSError):
      while self._events.poll(0):
        yield self._events.recv()

  def end(self, *seconds: float) -> None:
    """Waits for the end of each process, and then kills it."""
    for process, patience in zip(self._running.values(), seconds, strict=False):
      process.join(patience)
      if process.is_alive():
        process.kill()
        process.join()

  def _start(self, name: str, target: Callable[..., None], *args: Any) -> None:
    process = self._context.Process(target=target, args=args, name=name, daemon=True)
    process.start()
    self._running[name] = process
