"""Child processes that answer one message at a time.

They are programs of their own, not forks: the parent may have started threads or JAX,
and may itself be a daemonic process.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import importlib
from multiprocessing.connection import Connection, Pipe
import os
import subprocess
import sys
import threading
from typing import Any

from apnpql_jax.errors import ConfigError, DeviceError, UserError, one_line

_PROGRAM = f"import sys; from {__name__} import run; run(sys.argv[1], int(sys.argv[2]))"
_PATIENCE = 60.0  # s to start, or to answer, on a machine that is busy
_END = 5.0  # s to end


class Child:
  """A process that runs ``main`` of a module."""

  def __init__(self, module: str, settings: Any):
    """Starts the process, and waits until it is ready.

    Raises:
      UserError: It cannot start; the message is its own.
    """
    self._pipe, theirs = Pipe()
    self._lock = threading.Lock()
    path = os.pathsep.join(filter(None, sys.path))
    self._process = subprocess.Popen(
      [sys.executable, "-c", _PROGRAM, module, str(theirs.fileno())],
      pass_fds=[theirs.fileno()],
      env={**os.environ, "PYTHONPATH": path},
      stdin=subprocess.DEVNULL,
      start_new_session=True,  # Ctrl-C is for the program that has to stop the arm.
    )
    theirs.close()
    try:
      self.greeting = self.ask(settings)
    except BaseException:
      self.close()
      raise

  def ask(self, message: Any) -> Any:
    """Returns the answer to a message.

    Raises:
      UserError: The process fails or has ended.
    """
    with self._lock:
      try:
        self._pipe.send(message)
        answer = self._pipe.recv() if self._pipe.poll(_PATIENCE) else TimeoutError()
      except (EOFError, OSError):
        answer = DeviceError("the process of a double has ended")
    if isinstance(answer, UserError):
      raise answer
    if isinstance(answer, BaseException):
      raise DeviceError(f"a double does not work: {one_line(answer)}")
    return answer

  def close(self) -> None:
    """Ends the process."""
    self._pipe.close()
    try:
      self._process.wait(_END)
    except subprocess.TimeoutExpired:
      self._process.kill()
      self._process.wait()


def run(module: str, descriptor: int) -> None:
  """Runs ``main`` in the child until the parent closes the pipe; sends its error."""
  main: Callable[[Connection], None] = importlib.import_module(module).main
  with Connection(descriptor) as pipe, contextlib.suppress(EOFError, OSError):
    try:
      main(pipe)
    except (EOFError, BrokenPipeError, KeyboardInterrupt):
      pass
    except UserError as error:
      pipe.send(error)
    except Exception as error:
      pipe.send(ConfigError(f"a double does not start: {one_line(error)}"))
      raise
