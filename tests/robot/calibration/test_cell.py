"""Calibration with the devices of a cell, against the double of the controller."""

from __future__ import annotations

import contextlib
import time

import numpy as np
import pytest

pytest.importorskip("rtde_receive", reason="needs ur_rtde")

from apnpql_jax.cli import robot as cli
from apnpql_jax.errors import DeviceError
from apnpql_jax.robot import doubles
from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.doubles.server import ask
from apnpql_jax.robot.drivers.ur_listener import Listener


@pytest.fixture(scope="module")
def host():
  """Yields the address of a controller whose arm stands still, without commands."""
  with contextlib.closing(doubles.serve("push_plate", noise=False)) as server:
    yield server.greeting[0]


def test_a_listener_reads_an_arm_without_control(host):
  arm = Listener(host)
  arm.connect()
  try:
    seen = arm.get_observation()
    np.testing.assert_allclose(seen.position, ask(host, "state")["position"], atol=1e-6)
    np.testing.assert_allclose(seen.velocity, np.zeros(6), atol=1e-4)
    assert 0 <= time.monotonic() - seen.time < 1
  finally:
    arm.disconnect()
  with pytest.raises(DeviceError, match="lost the connection"):
    arm.get_observation()


def test_a_missing_device_is_one_line(host, tmp_path):
  pytest.importorskip("pyrealsense2")
  pytest.importorskip("cv2")
  contract = {"cameras": {"global": {}, "wrist": {}}}
  serials = {"global": "1", "wrist": "2"}

  def calibrate(address: str) -> None:
    cell = Cell(arm_host=address, cameras=serials, calibration=out)
    cli._calibrate(args, Robot("ur5e", contract, cell))

  views, out = tmp_path / "views", tmp_path / "calibration.json"
  args = cli.Robot(action="calibrate", robot="ur5e", views=views)
  with pytest.raises(DeviceError, match="camera 2: not found .no camera is connected"):
    calibrate(host)
  with pytest.raises(DeviceError, match="127.0.0.1: port 30004"):
    calibrate("127.0.0.1")
  assert not views.exists() and not out.exists()
