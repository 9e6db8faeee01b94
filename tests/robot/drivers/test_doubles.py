"""The doubles together: one scene behind arm, gripper and cameras."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import time

import mujoco
import numpy as np
import pytest

from apnpql_jax.errors import ConfigError, DeviceError
from apnpql_jax.robot import doubles
from apnpql_jax.robot.doubles.plant import World
from apnpql_jax.robot.doubles.rtde import RtdeSession
from apnpql_jax.robot.doubles.server import ask
from apnpql_jax.robot.limits import TIMESTEP

PACKAGES = "rtde_control", "dynamixel_sdk", "pyrealsense2", "cv2"


def contract() -> dict:
  views = {}
  for name, height, width, fovy in (("global", 72, 96, 36.0), ("wrist", 36, 64, 42.5)):
    focal = 0.5 * height / math.tan(math.radians(fovy) / 2)
    views[name] = {
      "height": height,
      "width": width,
      "vertical_fov_deg": fovy,
      "intrinsics_px": {
        "fx": focal,
        "fy": focal,
        "cx": 0.5 * (width - 1),
        "cy": 0.5 * (height - 1),
      },
    }
  return {"task": "push_plate", "cameras": views}


@pytest.fixture
def rig():
  for name in PACKAGES:
    pytest.importorskip(name)
  with doubles.start("push_plate", contract()) as devices:
    yield devices


def newest(rig: doubles.Doubles, name: str) -> np.ndarray:
  """Returns an image that is captured from now on."""
  after = time.monotonic()
  while (frame := rig.cameras[name].get_observation()).time < after:
    assert time.monotonic() < after + 10
    time.sleep(0.01)
  return frame.image


def changed(before: np.ndarray, after: np.ndarray) -> float:
  """Returns the share of pixels that look different."""
  return float((np.abs(after.astype(int) - before).max(-1) > 20).mean())


def test_the_cameras_see_what_arm_and_gripper_do(rig):
  overview, wrist = newest(rig, "global"), newest(rig, "wrist")
  assert overview.shape == (72, 96, 3) and wrist.shape == (36, 64, 3)
  assert overview.std() > 10 and wrist.std() > 10
  np.testing.assert_array_equal(newest(rig, "global"), overview)
  rig.arm.start()
  begin, start = time.monotonic(), rig.arm.get_observation().position
  while (now := time.monotonic()) < begin + 1:
    rig.arm.send_action(start + [0.3 * (now - begin), 0, 0, 0, 0, 0])
    time.sleep(TIMESTEP)
  rig.arm.stop()
  assert changed(overview, newest(rig, "global")) > 0.01
  wrist = newest(rig, "wrist")
  assert changed(wrist, newest(rig, "wrist")) == 0  # The arm is at rest.
  rig.gripper.send_action(False)
  end = time.monotonic() + 8
  while rig.gripper.get_observation().angle > 0.05:
    assert time.monotonic() < end
    time.sleep(0.01)
  assert changed(wrist, newest(rig, "wrist")) > 0.01
  rig.ask("unplug_cameras")
  with pytest.raises(DeviceError, match="sent no frame"):
    while True:
      newest(rig, "wrist")


def test_a_task_that_does_not_exist_is_one_line():
  with pytest.raises(ConfigError, match="unknown MJCF file 'push_plat'"):
    doubles.serve("push_plat")


def test_they_end_when_they_are_closed():
  server = doubles.serve("push_plate")
  host, _ = server.greeting
  assert ask(host, "state")["cameras"]
  server.close()
  with pytest.raises(DeviceError, match="have ended"):
    ask(host, "state")


def test_they_end_with_a_parent_that_is_killed():
  code = """
import os, signal
from apnpql_jax.robot import doubles
print(doubles.serve("push_plate").greeting[0], flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
  done = subprocess.run(
    [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, timeout=60
  )
  assert done.returncode == -signal.SIGKILL
  end = time.monotonic() + 10
  with pytest.raises(DeviceError, match="have ended"):
    while time.monotonic() < end:
      ask(done.stdout.strip(), "state")


def test_ctrl_c_does_not_end_them():
  code = """
import os, signal, time
from apnpql_jax.robot import doubles
from apnpql_jax.robot.doubles.server import ask
server = doubles.serve("push_plate")
signal.signal(signal.SIGINT, signal.SIG_IGN)
os.killpg(0, signal.SIGINT)
time.sleep(0.5)
ask(server.greeting[0], "state")
server.close()
"""
  subprocess.run(
    [sys.executable, "-c", code], check=True, start_new_session=True, timeout=60
  )


def test_payload_of_the_rig_is_that_of_the_scene():
  plant = World("push_plate", noise=False)
  tool = plant.model.body("gripper").id
  assert plant.model.body_subtreemass[tool] == pytest.approx(doubles.PAYLOAD_KG)
  plant.zero_wrench()
  plant.set_payload(doubles.PAYLOAD_KG, np.array(doubles.PAYLOAD_COG_M))
  plant.step()
  plant.zero_wrench()
  plant.servo(plant.position + [0, 0, 0, 0, 1.0, 0], 0.03, 300)
  for _ in range(1000):
    plant.step()
  assert np.abs(plant.wrench[:3]).max() < 0.01  # N
  assert np.abs(plant.wrench[3:]).max() < 0.05  # N m; the fingers move their center


def test_drivers_and_doubles_import_no_jax():
  code = (
    "import sys; from apnpql_jax.robot import doubles; "
    "from apnpql_jax.robot.doubles import server, renderer; "
    "assert not {'jax', 'jaxlib'} & sys.modules.keys()"
  )
  subprocess.run([sys.executable, "-c", code], check=True)


def test_the_fingers_lift_an_object():
  plant = World("stack_box", noise=False)
  plant.zero_wrench()
  model, data = plant.model, plant.data
  box = model.joint(int(np.flatnonzero(model.jnt_type == 0)[0]))  # The first free body.
  mass = model.body_subtreemass[model.jnt_bodyid[box.id]]
  fingers = [model.joint(f"finger_{x}").qposadr[0] for x in ("r1", "r2", "l1", "l2")]
  data.qpos[fingers] = 0.0
  mujoco.mj_forward(model, data)
  tool = data.site("tool")
  address = box.qposadr[0]
  mujoco.mju_mat2Quat(data.qpos[address + 3 : address + 7], tool.xmat)
  data.qpos[address : address + 3] = tool.xpos
  model.opt.gravity[:] = 0  # Until the fingers hold it.
  plant.grip(1.1, 0.8, 3.5)
  for _ in range(1000):
    plant.step()
  model.opt.gravity[:] = 0, 0, -9.81
  start, place = plant.position, data.qpos[address : address + 3] - tool.xpos
  for step in range(500):
    plant.servo(start - [0, 0.2 * step * TIMESTEP, 0, 0, 0, 0], 0.03, 300)
    plant.step()
  held = data.qpos[address : address + 3] - tool.xpos
  assert np.linalg.norm(held) < 0.03 + np.linalg.norm(place)
  assert plant.wrench[2] == pytest.approx(-9.81 * mass, abs=1.0)


def test_the_plant_follows_with_the_lag_of_servo_j():
  plant = World("push_plate", noise=False)
  start, swing = plant.position, np.array([0.3, 0.1, -0.1, 0.2, -0.2, 0.3])
  times = np.arange(0, 3, TIMESTEP)
  targets = start + swing * np.sin(times[:, None]) ** 2
  for lookahead, gain, lag in ((0.03, 300, 0.03), (0.1, 300, 0.1), (0.03, 150, 0.06)):
    real = []
    for target in targets:
      plant.servo(target, lookahead, gain)
      assert not plant.step()
      real.append(plant.position)
    delays = np.arange(0.0, 0.2, TIMESTEP)
    for joint in range(6):
      late = [np.interp(times - d, times, targets[:, joint]) for d in delays]
      errors = [np.abs(x - np.array(real)[:, joint])[500:].mean() for x in late]
      best = delays[int(np.argmin(errors))]
      assert best == pytest.approx(lag, abs=3 * TIMESTEP)
      assert min(errors) < 0.01 * abs(swing[joint])


def test_other_bytes_than_rtde_are_refused():
  session = RtdeSession((5, 25, 0, 0), lambda _: None)
  with pytest.raises(ValueError, match="not RTDE"):
    session.receive(b"GET / HTTP/1.1\r\n\r\n")
