"""Calibration with the devices of a cell, against the double of the controller."""

from __future__ import annotations

import time

import numpy as np
import pytest

pytest.importorskip("rtde_receive", reason="needs ur_rtde")

from apnpql_jax.errors import DeviceError
from apnpql_jax.robot import doubles
from apnpql_jax.robot.calibration import live
from apnpql_jax.robot.drivers.ur_listener import Listener


@pytest.fixture(scope="module")
def rig():
  with doubles.start("push_plate", noise=False) as devices:
    devices.arm.start()
    yield devices


def test_a_listener_reads_an_arm_that_another_moves(rig):
  arm = Listener(rig.host)
  arm.connect()
  try:
    start = rig.arm.get_observation().position
    for i in range(100):
      rig.arm.send_action(start + [0.001 * i, 0, 0, 0, 0, 0])
      time.sleep(0.002)
    time.sleep(0.3)
    seen = arm.get_observation()
    np.testing.assert_allclose(seen.position, rig.state()["position"], atol=1e-3)
    assert seen.position[0] > start[0] + 0.05
    assert 0 <= time.monotonic() - seen.time < 0.1
  finally:
    arm.disconnect()
  with pytest.raises(DeviceError, match="lost the connection"):
    arm.get_observation()
  assert not rig.arm.get_observation().fault


def test_a_missing_device_is_one_line(rig, tmp_path):
  pytest.importorskip("pyrealsense2")
  pytest.importorskip("cv2")
  contract = {"cameras": {"global": {}, "wrist": {}}}
  serials = {"global": "1", "wrist": "2"}

  def calibrate(host: str) -> None:
    live.calibrate_cell(
      contract, views, out, host=host, serials=serials, recorded=False
    )

  views, out = tmp_path / "views", tmp_path / "calibration.json"
  with pytest.raises(DeviceError, match="camera 2: not found .no camera is connected"):
    calibrate(rig.host)
  with pytest.raises(DeviceError, match="127.0.0.1: port 30004"):
    calibrate("127.0.0.1")
  assert not views.exists() and not out.exists()
