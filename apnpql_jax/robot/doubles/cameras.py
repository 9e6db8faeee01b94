"""Software devices of librealsense that show the doubles' scene.

A frame goes through librealsense from a thread of this process, so that the driver
cannot tell it from that of a camera. The pictures are drawn in a process of their own.
"""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import math
import threading
import time
from typing import Any

import numpy as np

from apnpql_jax.errors import DeviceError
from apnpql_jax.robot.doubles.child import Child
from apnpql_jax.robot.doubles.server import ask
from apnpql_jax.robot.drivers.realsense import RATE, RealSense
from apnpql_jax.robot.vendors import vendor

SIZE = 240, 424  # a mode of both cameras
MODELS = {"global": ("D455", 90.0), "wrist": ("D435", 69.8)}
"""Camera of the contract -> model and horizontal field of view, degrees."""

_PERIOD = 1 / 15  # s between two frames at least, as software renders them
_EXTENSION = "Intel RealSense "


class SoftwareCamera:
  """One software device with a color stream."""

  def __init__(self, rs: Any, name: str, size: tuple[int, int] = SIZE):
    """Makes the device for a camera of the contract."""
    self._rs, self._number = rs, 0
    model, angle = MODELS[name]
    self.size, self.serial = size, f"double-{name}"
    height, width = size
    self.focal = 0.5 * width / math.tan(math.radians(angle) / 2)
    inner = rs.intrinsics()
    inner.height, inner.width = size
    inner.fx = inner.fy = self.focal
    inner.ppx, inner.ppy = 0.5 * (width - 1), 0.5 * (height - 1)
    inner.model, inner.coeffs = rs.distortion.inverse_brown_conrady, [0.0] * 5
    stream = rs.video_stream()
    stream.type, stream.index, stream.uid = rs.stream.color, 0, 1
    stream.width, stream.height, stream.fps = width, height, RATE
    stream.bpp, stream.fmt, stream.intrinsics = 3, rs.format.rgb8, inner
    self.device = rs.software_device()
    info = {
      rs.camera_info.serial_number: self.serial,
      rs.camera_info.name: _EXTENSION + model,
      rs.camera_info.firmware_version: "0.0.0.0",
    }
    for key, value in info.items():
      self.device.register_info(key, value)
    self._sensor = self.device.add_sensor("RGB Camera")
    self._profile = self._sensor.add_video_stream(stream)

  def show(self, image: np.ndarray, when: float) -> None:
    """Delivers a frame that was captured at a time of ``time.time``, if opened."""
    rs = self._rs
    frame = rs.software_video_frame()
    frame.pixels = np.ascontiguousarray(image)
    frame.stride, frame.bpp = 3 * image.shape[1], 3
    self._number += 1
    frame.frame_number, frame.timestamp = self._number, 1000 * when
    frame.domain = rs.timestamp_domain.system_time
    frame.profile = self._profile.as_video_stream_profile()
    self._sensor.on_video_frame(frame)

  @property
  def vertical_angle(self) -> float:
    """Vertical field of view, degrees."""
    return math.degrees(2 * math.atan(0.5 * self.size[0] / self.focal))


@contextlib.contextmanager
def cameras(
  host: str, task: str, contract: dict[str, Any]
) -> Generator[dict[str, RealSense]]:
  """Starts the doubles of the contract's cameras; their drivers are not connected.

  Args:
    host: Address of the doubles of arm and gripper, see ``serve``.
    task: Name of the task, or path of its MJCF file.
    contract: That of the policy.

  Raises:
    UserError: A package or a graphics library is missing.
  """
  rs = vendor("pyrealsense2", "pyrealsense2")
  views = contract["cameras"]
  devices = {name: SoftwareCamera(rs, name) for name in views}
  angles = {name: device.vertical_angle for name, device in devices.items()}
  renderer = Child("apnpql_jax.robot.doubles.renderer", (task, angles, SIZE))
  end = threading.Event()

  def run() -> None:
    with contextlib.suppress(DeviceError):  # The doubles may end first.
      begin = time.monotonic()
      while not end.wait(max(0.0, begin + _PERIOD - time.monotonic())):
        begin = time.monotonic()
        when, state = time.time(), ask(host, "state")
        if state["cameras"]:
          for device, image in zip(devices.values(), renderer.ask(state), strict=True):
            device.show(image, when)

  thread = threading.Thread(target=run, daemon=True)
  thread.start()
  try:
    yield {
      name: RealSense(x.serial, view=views[name], size=SIZE, devices=[x.device])
      for name, x in devices.items()
    }
  finally:
    end.set()
    thread.join()
    renderer.close()
