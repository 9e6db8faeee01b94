"""The command ``watch``."""

from __future__ import annotations

import socket

import pytest

from apnpql_jax.cli import watch


def test_the_server_ends_with_the_command(player, monkeypatch):
  pytest.importorskip("viser")
  with socket.create_server(("127.0.0.1", 0)) as server:
    address = server.getsockname()

  def interrupt() -> None:
    socket.create_connection(address, timeout=5).close()
    raise KeyboardInterrupt

  monkeypatch.setattr(watch, "_actor", lambda args: player.actor)
  monkeypatch.setattr(player.actor, "steps", interrupt)
  with pytest.raises(KeyboardInterrupt):
    watch.watch(watch.Watch(what="expert", task="push_plate", port=address[1]))
  with pytest.raises(OSError):
    socket.create_connection(address, timeout=5)
