"""A UR controller: what its program, its safety system and its dashboard do.

URScript is not interpreted. The client ur_rtde uploads a program that takes a command
from input registers in each cycle, and answers in output registers. Once any program
has been sent, the double obeys the same commands (``rtde_control.script`` of ur_rtde
1.6).
"""

from __future__ import annotations

from collections.abc import Mapping
import math
import time
from typing import Any

import numpy as np

from apnpql_jax.robot.doubles.plant import World
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.sim.names import ARM_JOINTS

VERSION = (5, 25, 1, 130182)
SERIAL = "20265500000"

_READY, _DONE = 1, 2
_NO_COMMAND, _ZERO_WRENCH, _SERVO, _SERVO_STOP, _PAYLOAD = 0, 8, 11, 16, 17
_PROTECTIVE_STOP, _STOP_JOINTS, _WATCHDOG, _STOP_PROGRAM = 31, 34, 35, 255
_COMMAND = "input_int_register_0"
_RUNNING, _STOPPED = 2, 1  # runtime_state
_STANDARD = {
  "robot_mode": 7,
  "speed_scaling": 1.0,
  "actual_main_voltage": 48.0,
  "actual_robot_voltage": 48.0,
  "joint_temperatures": [30.0] * 6,
  "joint_mode": [253] * 6,
}
_SAFETY = {
  "NORMAL": (1, 1),
  "PROTECTIVE_STOP": (3, 1 << 2),
  "ROBOT_EMERGENCY_STOP": (7, 0xC0),
}
"""Safety status of the dashboard -> safety_mode and safety_status_bits of RTDE."""


class Controller:
  """The state machine between the client's registers and the plant."""

  def __init__(
    self,
    plant: World,
    *,
    model: str = "UR5",
    remote: bool = True,
    speed_slider: float = 1.0,
  ):
    """Starts with brakes released and without a program.

    Args:
      plant: What it drives.
      model: Name in the dashboard; that of a UR5e is "UR5".
      remote: Whether the teach pendant gave control away.
      speed_slider: Its position on the teach pendant, 0 to 1.
    """
    self.plant, self.model, self.remote = plant, model, remote
    self._slider = speed_slider
    self.safety, self.running, self.programs = "NORMAL", False, 0
    self._boot = time.monotonic()
    self._inputs: dict[str, float] = {}
    self._executing, self._answer = False, 0
    self._silence, self._patience = 0.0, math.inf  # s since the last command

  def upload(self, script: bytes) -> None:
    """Starts a program, which ends in ``end``, if the arm may move."""
    self.programs += 1
    if script.rstrip().endswith(b"end") and self.remote and self.safety == "NORMAL":
      self.running, self._executing, self._answer = True, False, _READY
      self._silence, self._patience = 0.0, math.inf

  def write(self, registers: Mapping[str, float]) -> None:
    """Takes input registers; the program reads them in its next cycle."""
    self._inputs.update(registers)
    if _COMMAND in registers:
      self._silence = 0.0

  def stop_program(self) -> None:
    """Ends the program; the arm brakes."""
    self.running = False
    self.plant.brake()

  def protective_stop(self) -> None:
    """Stops as after a collision."""
    self._safety_stop("PROTECTIVE_STOP")

  def emergency_stop(self) -> None:
    """Stops as if the emergency button had been pushed."""
    self._safety_stop("ROBOT_EMERGENCY_STOP")

  def cycle(self) -> None:
    """Runs one control cycle; the watchdog ends a program without commands."""
    self._silence += TIMESTEP
    if self.running and self._silence > self._patience:
      self.stop_program()
    if self.running:
      self._program()
    if self.plant.step() and self.safety == "NORMAL":
      self.protective_stop()

  def variables(self) -> dict[str, Any]:
    """Returns the outputs of RTDE after a cycle."""
    mode, bits = _SAFETY[self.safety]
    plant = self.plant
    return {
      **_STANDARD,
      "timestamp": time.monotonic() - self._boot,
      "actual_execution_time": TIMESTEP,
      "target_speed_fraction": self._slider,
      "actual_q": plant.position.tolist(),
      "actual_qd": plant.velocity.tolist(),
      "target_q": plant.target.tolist(),
      "target_qd": plant.target_velocity.tolist(),
      "actual_TCP_force": plant.wrench.tolist(),
      "safety_mode": mode,
      "safety_status_bits": bits,
      "robot_status_bits": 1 | self.running << 1,
      "runtime_state": _RUNNING if self.running else _STOPPED,
      "output_int_register_0": self._answer,
    }

  def ask(self, line: str) -> str:
    """Returns the dashboard's answer to a line."""
    version = "URSoftware " + ".".join(map(str, VERSION)) + " (Jan 01 2026)"
    answers = {
      "polyscopeversion": version,
      "get robot model": self.model,
      "get serial number": SERIAL,
      "is in remote control": str(self.remote).lower(),
      "robotmode": "Robotmode: RUNNING",
      "safetystatus": f"Safetystatus: {self.safety}",
      "safetymode": f"Safetymode: {self.safety}",
      "running": f"Program running: {str(self.running).lower()}",
      "programstate": f"{'PLAYING' if self.running else 'STOPPED'} <unnamed>",
      "quit": "Disconnected",
    }
    command = line.strip().lower()
    if command == "stop":
      self.stop_program()
      return "Stopped"
    if command == "unlock protective stop":
      self.safety = "NORMAL" if self.safety == "PROTECTIVE_STOP" else self.safety
      return "Protective stop releasing"
    return answers.get(command, f"could not understand: '{line.strip()}'")

  def _safety_stop(self, status: str) -> None:
    self.safety, self.running = status, False
    self.plant.lock()

  def _program(self) -> None:
    """Obeys one command, as a cycle of the program does."""
    command = int(self._inputs.get(_COMMAND, _NO_COMMAND))
    if command == _NO_COMMAND:
      self._executing, self._answer = False, _READY
    elif command == _SERVO:
      joints = self._doubles(len(ARM_JOINTS))
      *_, lookahead, gain = self._doubles(11)
      self.plant.servo(np.array(joints), lookahead, gain)
      self._answer = _READY
    elif not self._executing:
      self._executing = self._obey(command)

  def _obey(self, command: int) -> bool:
    """Obeys a command that is executed once; returns whether it is done."""
    if command == _STOP_PROGRAM:
      self.stop_program()
      return True
    if command in (_SERVO_STOP, _STOP_JOINTS):
      self.plant.brake(*self._doubles(1))
      if not self.plant.at_rest:  # The client waits.
        return False
    elif command == _ZERO_WRENCH:
      self.plant.zero_wrench()
    elif command == _PAYLOAD:
      mass, *center = self._doubles(4)
      self.plant.set_payload(mass, np.array(center))
    elif command == _WATCHDOG:
      self._patience = 1 / self._doubles(1)[0]
    elif command == _PROTECTIVE_STOP:
      self.protective_stop()
    else:  # Not without notice: the double lacks what it would do.
      self.stop_program()
      return True
    self._answer = _DONE
    return True

  def _doubles(self, count: int) -> list[float]:
    return [self._inputs.get(f"input_double_register_{i}", 0.0) for i in range(count)]
