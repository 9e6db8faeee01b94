"""Playbacks: what their buttons do; and the server that shows them."""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import socket
import threading
import time
import urllib.request

import pytest

from apnpql_jax.viewing.playback import Playback


class Log:
  """A view that keeps what it is shown."""

  def __init__(self):
    self.frames, self.steps, self.playing, self.lines = [], [], True, []

  def show(self, frames):
    self.frames.append(frames[-1])

  def offer(self, steps):
    self.steps = steps

  def state(self, *, playing):
    self.playing = playing

  def report(self, line):
    self.lines.append(line)


def wait_until(condition) -> None:
  for _ in range(3000):
    if condition():
      return
    time.sleep(0.02)
  raise AssertionError("nothing happened within a minute")


@contextlib.contextmanager
def running(playback: Playback, view) -> Generator[None]:
  """Runs a playback in a thread."""
  thread = threading.Thread(target=playback.run, args=(view,), daemon=True)
  thread.start()
  try:
    yield
  finally:
    playback.close()
    thread.join(60)
    assert not thread.is_alive()


def test_buttons_pause_step_and_begin(player):
  playback, log = Playback(player), Log()
  playback.toggle()
  with running(playback, log):
    wait_until(lambda: not log.playing and log.frames)
    shown = len(log.frames)
    time.sleep(0.5)
    assert len(log.frames) == shown
    for _ in range(2):
      playback.step()
    wait_until(lambda: len(log.frames) == shown + 2)
    assert log.frames[-1].time_s - log.frames[-3].time_s == pytest.approx(0.3)
    playback.new_episode()
    wait_until(lambda: len(log.frames) == shown + 3)
    assert log.frames[-1].time_s == 0.0
    assert log.frames[-1].episode == log.frames[-2].episode + 1
    playback.set_speed(100.0)
    playback.toggle()
    wait_until(lambda: log.frames[-1].last and log.playing)
    wait_until(lambda: log.frames[-1].time_s == 0.0)  # The next one begins by itself.


def test_checkpoints_are_offered_chosen_and_followed(player):
  playback, log = Playback(player), Log()
  playback.toggle()
  with running(playback, log):
    wait_until(lambda: log.steps)
    assert log.steps == player.actor.steps()
    playback.choose(log.steps[-1])
    wait_until(lambda: log.frames[-1].checkpoint == log.steps[-1])
    playback.new_episode()
    playback.choose(12345)
    wait_until(lambda: log.lines)
    assert "no checkpoint 12345" in log.lines[0]
    assert log.frames[-1].checkpoint == log.steps[-1]
    playback.choose(None)
    wait_until(lambda: log.frames[-1].checkpoint == log.steps[0])


def free_port() -> int:
  with socket.create_server(("127.0.0.1", 0)) as server:
    return server.getsockname()[1]


def test_the_server_shows_frames_to_this_machine_only(player):
  pytest.importorskip("viser")
  from apnpql_jax.viewing import live_view

  playback = Playback(player)
  playback.toggle()
  view = live_view.LiveView(playback, host="127.0.0.1", port=free_port())
  try:
    with running(playback, view):
      with urllib.request.urlopen(view.url) as answer:
        assert answer.status == 200 and b"<html" in answer.read().lower()
      own = socket.gethostbyname(socket.gethostname())
      if not own.startswith("127."):
        address = own, int(view.url.rsplit(":", 1)[1])
        with pytest.raises(OSError):
          socket.create_connection(address, timeout=5)
      wait_until(lambda: not playback.playing and playback.frames)
      click(view.buttons, live_view.STEP)
      wait_until(lambda: len(playback.frames) == 2)
      later = f"episode {playback.frames[0].episode}, {0.15:.1f} s"
      wait_until(lambda: later in view.headline.content)
      click(view.buttons, live_view.EPISODE)
      wait_until(lambda: len(playback.frames) == 1)
      wait_until(lambda: len(view.checkpoint.options) > 1)
      view.checkpoint.value = view.checkpoint.options[-1]
      wait_until(lambda: str(player.actor.step) == view.checkpoint.options[-1])
      # The run removes it: it stays, and so does the episode.
      chosen = view.checkpoint.value
      view.offer(player.actor.steps()[:-1])
      assert view.checkpoint.value == chosen == view.checkpoint.options[-1]
      view.checkpoint.value = live_view.NEWEST
      wait_until(lambda: str(player.actor.step) == view.checkpoint.options[1])
  finally:
    view.close()


def click(group, option: str) -> None:
  """Does what the server does when a browser reports a click."""
  import viser

  group.value = option
  for handler in group._impl.update_cb:
    handler(viser.GuiEvent(client=None, client_id=None, target=group))


def test_an_address_that_is_not_of_this_machine_is_an_error():
  pytest.importorskip("viser")
  from apnpql_jax.errors import ConfigError
  from apnpql_jax.viewing.live_view import check_server

  with pytest.raises(ConfigError, match="--host 192.0.2.1 cannot be served"):
    check_server("192.0.2.1")
