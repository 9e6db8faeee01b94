"""The playback of an actor: speed, pauses, steps and checkpoints as buttons ask."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import queue
import time
from typing import Protocol

from apnpql_jax.errors import UserError
from apnpql_jax.viewing.frame import Frame
from apnpql_jax.viewing.player import Player

LOOK_S = 2.0
"""Time between checks for new checkpoints."""

HOLD_S = 1.5
"""Time for which the last instant of an episode stays."""


class View(Protocol):
  """Display of a playback."""

  def show(self, frames: Sequence[Frame]) -> None:
    """Shows the last frame; ``frames`` are those of its episode up to it."""

  def offer(self, steps: list[int]) -> None:
    """Offers the checkpoints with these steps, newest first."""

  def state(self, *, playing: bool) -> None:
    """Shows whether the playback runs or is paused."""

  def report(self, line: str) -> None:
    """Shows the error that a request has caused."""


class Playback:
  """Playback of frames until ``close``; requests may come from other threads."""

  def __init__(self, player: Player, *, follow: bool = True):
    """Keeps the player; with ``follow``, episodes begin with the newest checkpoint."""
    self.player, self.playing, self.speed = player, True, 1.0
    self.frames: list[Frame] = []
    self._follow, self._closed = follow, False
    self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()

  def toggle(self) -> None:
    """Asks to pause, or to continue."""
    self._requests.put(lambda: self._play(not self.playing))

  def step(self) -> None:
    """Asks to pause and show the next instant."""
    self._requests.put(self._step)

  def new_episode(self) -> None:
    """Asks to begin an episode."""
    self._requests.put(self._begin)

  def set_speed(self, factor: float) -> None:
    """Asks for a speed relative to the simulated time."""
    self._requests.put(lambda: setattr(self, "speed", factor))

  def choose(self, step: int | None) -> None:
    """Asks to begin an episode with a checkpoint; None follows the newest."""
    self._requests.put(lambda: self._choose(step))

  def close(self) -> None:
    """Asks to end."""
    self._requests.put(lambda: setattr(self, "_closed", True))

  def run(self, view: View) -> None:
    """Plays, and shows everything in ``view``; returns after ``close``."""
    self._view, self._offered, self._looked = view, [], -LOOK_S
    self._begin()
    while not self._closed:
      now = time.monotonic()
      if now - self._looked >= LOOK_S:
        self._look(now)
      due = self._due if self.playing else now + LOOK_S
      try:
        self._requests.get(timeout=max(0.0, min(due, self._looked + LOOK_S) - now))()
      except queue.Empty:
        if self.playing and time.monotonic() >= self._due:
          self._advance()

  def _look(self, now: float) -> None:
    self._looked, steps = now, self.player.actor.steps()
    if steps != self._offered:
      self._offered = steps
      self._view.offer(steps)

  def _play(self, playing: bool) -> None:
    self.playing, self._due = playing, time.monotonic()
    self._view.state(playing=playing)

  def _step(self) -> None:
    self._play(False)
    self._advance()

  def _choose(self, step: int | None) -> None:
    self._follow = step is None
    if step is not None:
      self._load(step)
    self._begin()

  def _load(self, step: int) -> None:
    try:
      if step != self.player.actor.step:
        self.player.actor.load(step)
    except UserError as error:  # A run that is training has removed it.
      self._view.report(str(error))

  def _begin(self) -> None:
    steps = self.player.actor.steps() if self._follow else []
    if steps:
      self._load(steps[0])
    self.frames = []
    self._add(self.player.begin())

  def _advance(self) -> None:
    if self.frames[-1].last:
      self._begin()
    else:
      self._add(self.player.step())

  def _add(self, frame: Frame) -> None:
    began = time.monotonic()
    self.frames.append(frame)
    self._view.show(self.frames)
    wait_s = HOLD_S if frame.last else frame.period_s / self.speed
    self._due = began + wait_s
