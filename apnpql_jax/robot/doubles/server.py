"""The process of the doubles: sockets, serial port and plant in one loop of 2 ms.

One thread serves all. It handles what arrives until the next cycle is due, so that
nothing waits for the interpreter's lock, and no lock is needed.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import functools
import json
from multiprocessing.connection import Connection
import selectors
import socket
import time
from typing import Any

from apnpql_jax.errors import DeviceError
from apnpql_jax.robot.doubles import modbus
from apnpql_jax.robot.doubles.controller import VERSION, Controller
from apnpql_jax.robot.doubles.dynamixel import Gripper, open_terminal
from apnpql_jax.robot.doubles.plant import World
from apnpql_jax.robot.doubles.rtde import RtdeSession
from apnpql_jax.robot.drivers.rh_p12_rn import TABLES
from apnpql_jax.robot.limits import TIMESTEP

DASHBOARD, SCRIPT, RTDE = 29999, 30003, 30004  # ports of every UR controller
REMOTE = 30099  # of ``ask``
GREETING = b"Connected: Universal Robots Dashboard Server\n"
_PATIENCE = 10.0  # s
_CATCH_UP = 10  # cycles; a machine that is later than this loses time instead


class Server:
  """Server of the clients on one loopback address, which also drives the plant."""

  def __init__(self, host: str, controller: Controller):
    """Opens the ports.

    Raises:
      OSError: The address is taken.
    """
    self._controller = controller
    self._selector = selectors.DefaultSelector()
    self._sessions: dict[socket.socket, RtdeSession] = {}
    self._scripts: dict[socket.socket, bytes] = {}
    self._mute = False
    self._host = host
    self.listen(DASHBOARD, GREETING, controller.ask)
    self._open(SCRIPT, self._script)
    self._open(RTDE, self._rtde)

  def watch(self, source: Any, act: Callable[[], None]) -> None:
    """Calls ``act`` whenever something can be read from ``source``."""
    self._selector.register(source, selectors.EVENT_READ, act)

  def listen(self, port: int, greeting: bytes, ask: Callable[[str], str]) -> None:
    """Serves lines of text at a port."""

    def accept(client: socket.socket) -> None:
      client.send(greeting)

      def read() -> None:
        text = (self._receive(client) or b"").decode("ascii", "replace")
        for line in text.splitlines():
          client.send(ask(line).encode() + b"\n")

      self.watch(client, read)

    self._open(port, accept)

  def forget(self, source: Any) -> None:
    """Stops watching and closes a source, if that has not happened yet."""
    with contextlib.suppress(KeyError, ValueError):
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
      due = max(due + TIMESTEP, time.monotonic() - _CATCH_UP * TIMESTEP)

  def _open(self, port: int, act: Callable[[socket.socket], None]) -> None:
    listener = socket.create_server((self._host, port))
    listener.setblocking(False)

    def accept() -> None:
      client, _ = listener.accept()
      if self._mute and port == RTDE:
        client.close()
        return
      client.setblocking(False)
      client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
      act(client)

    self.watch(listener, accept)

  def _script(self, client: socket.socket) -> None:
    self._scripts[client] = b""

    def read() -> None:
      text = self._receive(client)
      if text is None:
        self._scripts.pop(client, None)
        return
      self._scripts[client] += text
      if self._scripts[client].rstrip().endswith(b"\nend"):
        self._controller.upload(self._scripts[client])
        self._scripts[client] = b""

    self.watch(client, read)

  def _rtde(self, client: socket.socket) -> None:
    session = RtdeSession(VERSION, self._controller.write)
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


class Remote:
  """Methods that other processes may call by name; see ``ask``."""

  def __init__(
    self, plant: World, controller: Controller, gripper: Gripper, server: Server
  ):
    """Keeps what it acts on."""
    self._plant, self._gripper, self._controller = plant, gripper, controller
    self.protective_stop = controller.protective_stop
    self.emergency_stop = controller.emergency_stop
    self.stop_program = controller.stop_program
    self.drop_rtde = server.drop
    self._cameras = True

  def drift_force(self) -> None:
    """Moves the zero of the force-torque sensor."""
    self._plant.drift()

  def silence_gripper(self) -> None:
    """Makes the gripper ignore its bus."""
    self._gripper.silent = True

  def fail_gripper(self) -> None:
    """Makes the gripper report an overload."""
    self._gripper.fail(1 << 5)

  def unplug_cameras(self) -> None:
    """Ends the frames of the cameras."""
    self._cameras = False

  def state(self) -> dict[str, Any]:
    """Returns the true state of the plant."""
    plant, data = self._plant, self._plant.data
    return {
      "time": data.time,
      "position": plant.position.tolist(),
      "target": plant.target.tolist(),
      "finger": plant.finger,
      "programs": self._controller.programs,
      "program_runs": self._controller.running,
      "qpos": data.qpos.tolist(),
      "mocap_pos": data.mocap_pos.tolist(),
      "mocap_quat": data.mocap_quat.tolist(),
      "cameras": self._cameras,
    }

  def answer(self, line: str) -> str:
    """Returns the answer to a name as JSON."""
    return json.dumps(getattr(self, line.strip())())


def ask(host: str, name: str) -> Any:
  """Calls a method of ``Remote`` in the doubles at an address, from any process.

  Raises:
    DeviceError: They have ended.
  """
  try:
    with socket.create_connection((host, REMOTE), _PATIENCE) as connection:
      connection.sendall(name.encode() + b"\n")
      with connection.makefile(encoding="ascii") as answer:
        return json.loads(answer.readline())
  except (OSError, ValueError):
    raise DeviceError(f"the doubles at {host} have ended") from None


def main(pipe: Connection) -> None:
  """Runs arm and gripper with the settings of the parent, until the parent ends."""
  settings = pipe.recv()
  plant = World(settings["scene"], noise=settings["noise"])
  controller = Controller(plant, **settings["controller"])
  server = Server(settings["host"], controller)
  gripper = Gripper(
    TABLES[settings["gripper"]], plant, model_number=settings["model_number"]
  )
  speak = functools.partial(modbus.answer, gripper)
  terminal, descriptor, read = open_terminal(
    speak if settings["modbus"] else gripper.receive
  )
  server.watch(descriptor, read)
  server.listen(REMOTE, b"", Remote(plant, controller, gripper, server).answer)
  server.watch(pipe, pipe.recv)  # Raises EOFError when the parent ends.
  pipe.send((settings["host"], terminal))
  server.run(gripper.cycle)
