"""Checks that a UR5e answers at an address, before ``ur_rtde`` connects to it.

The clients of ``ur_rtde`` wait forever for a server that accepts a connection but does
not speak RTDE.
"""

from __future__ import annotations

import contextlib
import re
import socket
import struct
from typing import Any

from apnpql_jax.errors import DeviceError, one_line

_SCRIPT, _RTDE = 30003, 30004
_PATIENCE = 2.0  # s for a server to answer
_OLDEST = 5, 6  # PolyScope that reports whether remote control is on
_HELLO = struct.pack(">HBH", 5, ord("V"), 2)  # asks for version 2 of RTDE
_WELCOME = struct.pack(">HB?", 4, ord("V"), True)


LOCAL = "the teach pendant has control: switch to remote control there"


def check_controller(host: str, dashboard_client: Any) -> dict[str, Any]:
  """Returns model, serial number and version of the UR5e at ``host``; see ``identify``.

  Raises:
    DeviceError: See ``identify``; or the teach pendant has control.
  """
  about, remote = identify(host, dashboard_client)
  if not remote:
    raise DeviceError(f"{host}: {LOCAL}")
  return about


def identify(host: str, dashboard_client: Any) -> tuple[dict[str, Any], bool]:
  """Returns what the UR5e at ``host`` is, and whether it is in remote control.

  Args:
    host: Address of the controller.
    dashboard_client: The module of ``ur_rtde``.

  Raises:
    DeviceError: Nothing answers there, or something that is not a UR5e.
  """
  check_rtde(host)
  about, remote = _ask_dashboard(host, dashboard_client)
  version = tuple(int(x) for x in about["polyscope"].split(".")[:2])
  model = about["model"].upper().replace(" ", "")
  if version < (5,) or model not in ("UR5", "UR5E"):
    what = f"{about['model']} with PolyScope {about['polyscope']}"
    raise DeviceError(f"{host}: the arm must be a UR5e, not a {what}")
  if version < _OLDEST:
    raise DeviceError(f"{host}: PolyScope {about['polyscope']} is older than 5.6")
  return {**about, "model": "UR5e"}, remote


def check_rtde(host: str) -> None:
  """Raises ``DeviceError`` unless a controller answers at ``host``."""
  for port in (_RTDE, _SCRIPT):
    try:
      with socket.create_connection((host, port), _PATIENCE) as connection:
        connection.settimeout(_PATIENCE)
        if port == _RTDE:
          connection.sendall(_HELLO)
          answer = connection.recv(len(_WELCOME), socket.MSG_WAITALL)
          if answer != _WELCOME:
            raise DeviceError(f"{host}: port {port} does not speak RTDE 2")
    except TimeoutError:
      raise DeviceError(f"{host}: port {port} does not answer") from None
    except OSError as error:
      reason = one_line(OSError(error.strerror or error))
      raise DeviceError(f"{host}: port {port}: {reason}; is it a UR5e?") from None


def _ask_dashboard(host: str, module: Any) -> tuple[dict[str, Any], bool]:
  """Returns model and versions, and whether the arm is in remote control."""
  client = module.DashboardClient(host)
  try:
    client.connect()
    version = client.polyscopeVersion()
    if not re.fullmatch(r"\d+\.\d+\.\d+.*", version):
      raise RuntimeError(f"answers {version!r} to PolyscopeVersion")
    about = {
      "model": client.getRobotModel(),
      "serial_number": client.getSerialNumber(),
      "polyscope": version,
    }
    return about, client.isInRemoteControl()
  except Exception as error:  # ur_rtde raises several kinds.
    raise DeviceError(f"{host}: the dashboard server: {one_line(error)}") from None
  finally:
    with contextlib.suppress(Exception):
      client.disconnect()
