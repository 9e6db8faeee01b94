"""The live view: a page in the browser, served by viser."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
import html
import io
import socket
from typing import Any

import numpy as np

from apnpql_jax.errors import ConfigError
from apnpql_jax.viewing.dashboard import Dashboard
from apnpql_jax.viewing.frame import COLORS, Frame
from apnpql_jax.viewing.live_scene import LiveScene
from apnpql_jax.viewing.playback import Playback

NEWEST = "newest"
SPEEDS = {"¼×": 0.25, "½×": 0.5, "1×": 1.0, "2×": 2.0, "4×": 4.0}
"""Label -> factor on the speed of the simulated time, as far as the machine can."""

_LINES = '<div style="padding:8px 12px 2px;font-size:14px;line-height:1.7">{}</div>'

PLAY, PAUSE, STEP, EPISODE = "Play", "Pause", "Step", "New episode"


class LiveView:
  """Web server that shows a playback in a browser; a ``playback.View``."""

  def __init__(self, playback: Playback, *, host: str, port: int):
    """Starts the server; if ``port`` is taken, uses the next free one.

    Raises:
      ConfigError: viser is not installed, or the address cannot be served.
    """
    check_server(host)

    import viser

    actor = playback.player.actor
    with contextlib.redirect_stdout(io.StringIO()):  # It prints the address in a box.
      server: Any = viser.ViserServer(host=host, port=port, verbose=False)
    self._server, self._playback = server, playback
    self.url = f"http://{host}:{server.get_port()}"
    server.gui.configure_theme(
      control_width="large",
      show_logo=False,
      show_share_button=False,
      brand_color=(28, 126, 214),
    )
    server.gui.main_panel.dock_right()
    self._scene = LiveScene(server, actor.env.task.scene)
    self._dashboard: Dashboard | None = None
    self._add_controls()

  def close(self) -> None:
    """Stops the server."""
    self._server.stop()

  def show(self, frames: Sequence[Frame]) -> None:
    """See ``View.show``."""
    frame, actor = frames[-1], self._playback.player.actor
    if self._dashboard is None:
      explained = frame.explanation is not None
      self._dashboard = Dashboard(epsilon=actor.epsilon, explained=explained)
    image = self._dashboard.draw(frames)
    with self._server.atomic():
      self._scene.show(frame)
      self._plots.image = image
      self.headline.content = _headline(actor.title, frame)

  def offer(self, steps: list[int]) -> None:
    """See ``View.offer``."""
    self.checkpoint.visible = bool(steps)
    chosen, offered = self.checkpoint.value, (NEWEST, *map(str, steps))
    # The dropdown would choose another if the run has removed the chosen one.
    self.checkpoint.options = offered if chosen in offered else (*offered, chosen)

  def state(self, *, playing: bool) -> None:
    """See ``View.state``."""
    self.buttons.options = (PAUSE if playing else PLAY, STEP, EPISODE)

  def report(self, line: str) -> None:
    """See ``View.report``."""
    for client in self._server.get_clients().values():
      client.add_notification("Not possible", line, color="red")

  def _add_controls(self) -> None:
    gui, playback = self._server.gui, self._playback
    self.headline = gui.add_html(_LINES.format("preparing the first episode …"))
    self.buttons = gui.add_button_group("", (PAUSE, STEP, EPISODE))
    self.speed = gui.add_button_group("speed", [*SPEEDS])
    self.checkpoint = gui.add_dropdown("checkpoint", (NEWEST,), visible=False)
    self._plots = gui.add_image(np.full((8, 8, 3), 255, np.uint8), format="png")
    requests: dict[str, Callable[[], None]] = {
      PLAY: playback.toggle,
      PAUSE: playback.toggle,
      STEP: playback.step,
      EPISODE: playback.new_episode,
    }
    # Handlers run in threads of the server, and only leave requests.
    self.buttons.on_click(lambda event: requests[event.target.value]())
    self.speed.on_click(lambda event: playback.set_speed(SPEEDS[event.target.value]))
    self.checkpoint.on_update(lambda event: playback.choose(_step(event.target.value)))


def _step(chosen: str) -> int | None:
  return None if chosen == NEWEST else int(chosen)


def _headline(title: str, frame: Frame) -> str:
  """Returns the lines above the buttons, in HTML."""
  parts = [html.escape(title)]
  if frame.checkpoint is not None:
    parts.append(f"step {frame.checkpoint:,}")
  state = f"episode {frame.episode}, {frame.time_s:.1f} s"
  if frame.last:
    color, word = ("#2b8a3e", "solved") if frame.solved else ("#c92a2a", "not solved")
    state += f' <b style="color:{color}">{word}</b>'
  color = COLORS[int(np.argmax(frame.shares))]
  badge = (
    f'<span style="background:{color};color:white;border-radius:4px;padding:2px 8px;'
    f'font-weight:bold">{frame.headline}</span>'
  )
  return _LINES.format(f"{' · '.join(parts)}<br>{badge} &nbsp; {state}")


def check_server(host: str) -> None:
  """Raises ``ConfigError`` if viser is missing or the address cannot be served."""
  try:
    import viser  # noqa: F401
  except ImportError:
    raise ConfigError(
      "watch needs viser: pip install 'apnpql-jax[view]', or write a video with "
      "--video FILE.mp4"
    ) from None
  try:
    socket.create_server((host, 0)).close()
  except OSError as error:
    raise ConfigError(f"--host {host} cannot be served: {error}") from None
