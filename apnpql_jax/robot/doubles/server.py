"""The process of the doubles: sockets, serial port and plant in one loop of 2 ms.

One thread serves all. It works off what arrives until the next cycle is due, so that
nothing waits for the interpreter's lock, and no lock is needed.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
from multiprocessing.connection import Connection
import selectors
import socket
import time
from typing import Any

from apnpql_jax.robot.doubles import child
from apnpql_jax.robot.doubles.controller import VERSION, Controller
from apnpql_jax.robot.doubles.dynamixel import Gripper, open_terminal
from apnpql_jax.robot.doubles.plant import STEP, Plant
from apnpql_jax.robot.doubles.rtde import Session
from apnpql_jax.robot.drivers.rh_p12_rn import TABLES

DASHBOARD, SCRIPT, RTDE = 29999, 30003, 30004  # ports of every UR controller
GREETING = b"Connected: Universal Robots Dashboard Server\n"
_CATCH_UP = 10  # cycles; a machine that is later than this loses time instead


class Server:
  """Listens for clients on one loopback address, and drives the plant."""

  def __init__(self, host: str, controller: Controller):
    """Opens the ports.

    Raises:
      OSError: The address is taken.
    """
    self._controller = controller
    self._selector = selectors.DefaultSelector()
    self._sessions: dict[socket.socket, Session] = {}
    self._scripts: dict[socket.socket, bytes] = {}
    self._mute = False
    accepts = {DASHBOARD: self._dashboard, SCRIPT: self._script, RTDE: self._rtde}
    for port, accept in accepts.items():
      listener = socket.create_server((host, port))
      listener.setblocking(False)
      self.watch(listener, self._accepting(listener, accept))

  def watch(self, source: Any, act: Callable[[], None]) -> None:
    """Calls ``act`` whenever something can be read from ``source``."""
    self._selector.register(source, selectors.EVENT_READ, act)

  def forget(self, source: Any) -> None:
    """Stops watching and closes a source."""
    self._selector.unregister(source)
    source.close()

  def drop(self) -> None:
    """Cuts all RTDE connections, and refuses new ones."""
    for client in list(self._sessions):
      self._close(client)
    self._mute = True

  def run(self, *each: Callable[[], None]) -> None:
    """Runs control cycles, each followed by ``each``, until one raises SystemExit."""
    due = time.monotonic()
    while True:
      while (left := due - time.monotonic()) > 0:
        for key, _ in self._selector.select(left):
          key.data()
      for key, _ in self._selector.select(0):
        key.data()
      self._controller.cycle()
      for act in each:
        act()
      self._publish()
      due = max(due + STEP, time.monotonic() - _CATCH_UP * STEP)

  def _accepting(self, listener: socket.socket, act: Callable[..., None]) -> Any:
    def accept() -> None:
      client, _ = listener.accept()
      if self._mute:
        client.close()
        return
      client.setblocking(False)
      client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
      act(client)

    return accept

  def _dashboard(self, client: socket.socket) -> None:
    client.send(GREETING)

    def read() -> None:
      for line in (
        (self._receive(client) or b"").decode("ascii", "replace").splitlines()
      ):
        client.send(self._controller.ask(line).encode() + b"\n")

    self.watch(client, read)

  def _script(self, client: socket.socket) -> None:
    self._scripts[client] = b""

    def read() -> None:
      text = self._receive(client)
      if text is None:
        self._scripts.pop(client)
        return
      self._scripts[client] += text
      if self._scripts[client].rstrip().endswith(b"\nend"):
        self._controller.upload(self._scripts[client])
        self._scripts[client] = b""

    self.watch(client, read)

  def _rtde(self, client: socket.socket) -> None:
    session = Session(VERSION, self._controller.write)
    self._sessions[client] = session

    def read() -> None:
      data = self._receive(client)
      if data is None:
        self._sessions.pop(client, None)
        return
      try:
        client.send(session.receive(data))
      except (ValueError, OSError):
        self._close(client)

    self.watch(client, read)

  def _receive(self, client: socket.socket) -> bytes | None:
    """Returns what arrived, or None after the client has left."""
    with contextlib.suppress(OSError):
      if data := client.recv(1 << 16):
        return data
    self.forget(client)
    return None

  def _close(self, client: socket.socket) -> None:
    self._sessions.pop(client, None)
    self.forget(client)

  def _publish(self) -> None:
    listening = [pair for pair in self._sessions.items() if pair[1].started]
    if not listening:
      return
    values = self._controller.variables()
    for client, session in listening:
      try:
        client.send(session.package(values))
      except BlockingIOError:
        pass  # A client that does not read loses packages.
      except OSError:
        self._close(client)


class Faults:
  """What the parent process may ask for, by name."""

  def __init__(
    self, plant: Plant, controller: Controller, gripper: Gripper, server: Server
  ):
    """Keeps what it acts on."""
    self._plant, self._gripper = plant, gripper
    self.protective_stop = controller.protective_stop
    self.emergency_stop = controller.emergency_stop
    self.stop_program = controller.stop_program
    self.drop_rtde = server.drop

  def silence_gripper(self) -> None:
    """Makes the gripper ignore its bus."""
    self._gripper.silent = True

  def fail_gripper(self) -> None:
    """Makes the gripper report an overload."""
    self._gripper.fail(1 << 5)

  def state(self) -> dict[str, Any]:
    """Returns the true state of the plant."""
    plant, data = self._plant, self._plant.data
    return {
      "position": plant.position,
      "target": plant.target,
      "finger": plant.finger,
      "qpos": data.qpos.copy(),
      "mocap_pos": data.mocap_pos.copy(),
      "mocap_quat": data.mocap_quat.copy(),
    }


def main(pipe: Connection) -> None:
  """Runs arm and gripper; takes the settings, then names of methods of ``Faults``."""
  settings = pipe.recv()
  plant = Plant(settings["scene"], noise=settings["noise"])
  controller = Controller(plant, **settings["controller"])
  server = Server(settings["host"], controller)
  gripper = Gripper(
    TABLES[settings["gripper"]], plant, model_number=settings["model_number"]
  )
  terminal, descriptor, read = open_terminal(gripper.receive)
  server.watch(descriptor, read)
  faults = Faults(plant, controller, gripper, server)

  def command() -> None:
    pipe.send(getattr(faults, pipe.recv())())

  server.watch(pipe, command)
  pipe.send((settings["host"], terminal))
  server.run(gripper.cycle)


if __name__ == "__main__":
  child.run(main)
