"""The condition of a transfer test: physics, renderer and looks of the worlds."""

from __future__ import annotations

import dataclasses
from typing import Any

from apnpql_jax.envs.env import Env
from apnpql_jax.errors import ConfigError, check_name
from apnpql_jax.transfer import bullet, looks
from apnpql_jax.transfer.bullet_worlds import BulletWorlds
from apnpql_jax.transfer.opengl_renderer import OpenGLRenderer
from apnpql_jax.transfer.tiny_renderer import TinyRenderer

Renderer = OpenGLRenderer | TinyRenderer
"""A renderer outside of JAX."""

PHYSICS = ("mjx", "native", "bullet")
RENDERERS = ("rays", "opengl", "tiny")
LOOKS = ("trained", "plain", "unseen")

LATENCIES_MS = (0, 30, 60)
LATENCY_MS = 30
"""About that of the real arm's servos."""


@dataclasses.dataclass(frozen=True)
class Condition:
  """What the worlds of a transfer test consist of."""

  physics: str = "native"
  """Engine, one of ``PHYSICS``."""

  renderer: str = "rays"
  """What draws the images, one of ``RENDERERS``."""

  looks: str = "trained"
  """trained: worlds that domain randomization draws, within the ranges of the run,
  physics included; plain: those of the scene file; unseen: see ``looks``."""

  without: tuple[str, ...] = ()
  """Parts of ``looks.PARTS`` that unseen looks lack."""

  latency_ms: int | None = None
  """Time from the virtual arm to the servos, one of ``LATENCIES_MS``; 30 if None.
  Only with Bullet."""

  admittance: bool = False
  """Whether the virtual arm yields to the wrench at the tool. Only with Bullet."""

  def check(self) -> None:
    """Raises ``ConfigError`` if a value is invalid or a package is missing."""
    check_name("--physics", self.physics, PHYSICS)
    check_name("--renderer", self.renderer, RENDERERS)
    check_name("--looks", self.looks, LOOKS)
    if self.looks == "unseen" and self.renderer == "rays":
      raise ConfigError("--looks unseen needs --renderer opengl or tiny")
    for part in self.without:
      check_name("--without", part, looks.PARTS)
    if self.without and self.looks != "unseen":
      raise ConfigError("--without needs --looks unseen")
    if self.physics != "bullet":
      if self.latency_ms is not None or self.admittance:
        option = "--admittance" if self.latency_ms is None else "--latency-ms"
        raise ConfigError(f"{option} needs --physics bullet")
    elif self.latency_ms not in (None, *LATENCIES_MS):
      choices = ", ".join(map(str, LATENCIES_MS))
      raise ConfigError(f"--latency-ms {self.latency_ms} must be one of {choices}")
    for option, value in (("--physics", "bullet"), ("--renderer", "tiny")):
      if value in (self.physics, self.renderer):
        bullet.require(f"{option} {value}")

  def about(self) -> dict[str, Any]:
    """Returns the items of a result that describe the condition."""
    about = {k: getattr(self, k) for k in ("physics", "renderer", "looks")}
    if self.physics == "bullet":
      about |= {"latency_ms": self._latency_ms, "admittance": self.admittance}
      about["bullet_version"] = bullet.VERSION
    if self.looks == "unseen":
      about["looks_version"] = looks.VERSION
    if self.without:
      about["without"] = sorted(set(self.without))
    return about

  @property
  def _latency_ms(self) -> int:
    return LATENCY_MS if self.latency_ms is None else self.latency_ms

  def make_worlds(self, env: Env) -> BulletWorlds | None:
    """Returns Bullet's worlds; None if the environment has the physics itself."""
    if self.physics != "bullet":
      return None
    latency_s = self._latency_ms / 1000
    return BulletWorlds(env, latency_s=latency_s, admittance=self.admittance)

  def make_renderer(self, env: Env) -> Renderer | None:
    """Returns the renderer; None if the environment draws the images itself."""
    draws = {"opengl": OpenGLRenderer, "tiny": TinyRenderer}
    if self.renderer not in draws:
      return None
    unseen = set(looks.PARTS) - set(self.without) if self.looks == "unseen" else ()
    return draws[self.renderer](env.task.scene, env.config, unseen=unseen)
