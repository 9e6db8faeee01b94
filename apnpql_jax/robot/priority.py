"""Real-time priority of the control process, if the system grants it.

Linux gives a new thread the priority of the one that starts it. So the control process
asks before it connects the devices, whose drivers start threads.
"""

from __future__ import annotations

import os
import threading

REALTIME = 20
"""Priority of the control process of a real arm; rtprio in limits.conf allows it."""


def ask() -> bool:
  """Gives real-time priority to this thread, and returns whether it is granted."""
  try:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REALTIME))
  except (OSError, AttributeError):  # Not allowed, or not on Linux.
    return False
  return True


def is_granted() -> bool:
  """Returns whether it would be granted; this thread keeps its priority."""
  answers: list[bool] = []
  thread = threading.Thread(target=lambda: answers.append(ask()))
  thread.start()
  thread.join()
  return answers[0]
