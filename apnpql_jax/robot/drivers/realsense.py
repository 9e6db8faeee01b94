"""The cameras D435 and D455, by ``pyrealsense2``.

The color sensor alone is opened. A queue of one frame keeps the newest, so that nothing
waits, and an old frame is never taken for a new one: each has the time of its capture.
"""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import time
from typing import Any

import numpy as np

from apnpql_jax.errors import DeviceError, one_line
from apnpql_jax.robot import images
from apnpql_jax.robot.protocols import Frame
from apnpql_jax.robot.vendors import vendor

Json = dict[str, Any]

SIZE = 480, 848
"""Height and width of a mode that both cameras have with their whole width of view."""

RATE = 30  # frames per second
MODELS = "D435", "D455"

_FIRST_FRAME = 5.0  # s after the start of the stream
_SILENCE = 1.0  # s without a new frame after which the camera counts as lost


class RealSense:
  """A ``Camera`` that also gives its images as they are."""

  def __init__(
    self,
    serial: str,
    *,
    view: Json,
    size: tuple[int, int] = SIZE,
    rate: int = RATE,
    lens: Json | None = None,
    devices: Sequence[Any] | None = None,
  ):
    """Stores the settings; ``connect`` opens the camera.

    Args:
      serial: Serial number of the camera.
      view: An entry of ``cameras`` of the contract.
      size: Height and width of the mode.
      rate: Frames per second of the mode.
      lens: A calibrated lens, see ``images``, instead of the maker's.
      devices: Those among which to look for the camera; all connected ones if None.
    """
    self._serial, self._view, self._lens = serial, view, lens
    self._mode, self._devices = (*size, rate), devices
    self._rs: Any = None
    self._sensor: Any = None
    self._queue: Any = None
    self._prepare: images.Preparation | None = None
    self._native: Frame | None = None
    self._frame: Frame | None = None
    self._arrival = 0.0
    self._about: Json = {}

  def connect(self) -> None:
    """See ``protocols.Device``; waits for the first frame.

    Raises:
      DeviceError: The camera is missing, lacks the mode, is in use, sees less than the
        policy needs, or sends nothing.
    """
    self._rs = rs = vendor("pyrealsense2", "pyrealsense2")
    try:
      device = self._find()
      sensor, profile = self._choose(device)
      lens = self._lens or self._maker_lens(profile)
      self._prepare = images.Preparation(lens, self._view)
      for option, value in (
        (rs.option.global_time_enabled, 1),
        (rs.option.auto_exposure_priority, 0),  # Else frames get rarer in the dark.
      ):
        if sensor.supports(option):
          sensor.set_option(option, value)
      self._queue = rs.frame_queue(1)
      sensor.open(profile)
      self._sensor, self._lens = sensor, lens
      sensor.start(self._queue)
    except DeviceError as error:
      raise DeviceError(f"camera {self._serial}: {error}") from None
    except RuntimeError as error:  # Those of librealsense.
      self.disconnect()
      raise DeviceError(f"camera {self._serial}: {one_line(error)}") from None
    self._native = self._frame = None
    try:
      self._wait_for_first()
    except DeviceError:
      self.disconnect()
      raise

  def disconnect(self) -> None:
    """See ``protocols.Device``."""
    sensor, self._sensor = self._sensor, None
    for call in (sensor.stop, sensor.close) if sensor else ():
      with contextlib.suppress(RuntimeError):
        call()

  def describe(self) -> Json:
    """See ``protocols.Device``."""
    height, width, rate = self._mode
    stream = f"{width}x{height} at {rate}/s"
    return {**self._about, "stream": stream, "lens": self._lens}

  def get_observation(self) -> Frame:
    """See ``protocols.Camera``.

    Raises:
      DeviceError: The camera sends no frames.
    """
    native = self.get_native()
    if self._frame is None or self._frame.time != native.time:
      assert self._prepare
      self._frame = Frame(native.time, self._prepare(native.image))
    return self._frame

  def get_native(self) -> Frame:
    """Returns the newest image of the sensor: neither undistorted nor cropped.

    Raises:
      DeviceError: The camera sends no frames.
    """
    if self._sensor is None:
      raise DeviceError(f"camera {self._serial} is not connected")
    self._poll()
    assert self._native
    if (age := time.monotonic() - self._arrival) > _SILENCE:
      raise DeviceError(
        f"camera {self._serial} sent no frame for {age:.1f} s: check its cable"
      )
    return self._native

  def lens(self) -> Json:
    """Returns the lens of these images, see ``images``."""
    if self._lens is None:
      raise DeviceError(f"camera {self._serial} is not connected")
    return self._lens

  def _find(self) -> Any:
    rs = self._rs
    found = []
    for device in self._devices or rs.context().query_devices():
      serial = device.get_info(rs.camera_info.serial_number)
      found.append(serial)
      if serial == self._serial:
        about = {
          "model": rs.camera_info.name,
          "firmware": rs.camera_info.firmware_version,
          "usb": rs.camera_info.usb_type_descriptor,
        }
        self._about = {"serial_number": serial} | {
          k: device.get_info(x) for k, x in about.items() if device.supports(x)
        }
        return device
    there = f"connected: {', '.join(found)}" if found else "no camera is connected"
    raise DeviceError(f"not found ({there})")

  def _choose(self, device: Any) -> tuple[Any, Any]:
    """Returns the color sensor and its profile in the wanted mode."""
    rs, (height, width, rate) = self._rs, self._mode
    model = self._about.get("model", "")
    if not any(name in model for name in MODELS):
      raise DeviceError(f"it is a {model}, not a {' or '.join(MODELS)}")
    for sensor in device.query_sensors():
      for profile in sensor.get_stream_profiles():
        if profile.stream_type() != rs.stream.color or profile.fps() != rate:
          continue
        video = profile.as_video_stream_profile()
        if (video.height(), video.width()) == (height, width):
          if profile.format() == rs.format.rgb8:
            return sensor, profile
    usb = self._about.get("usb", "")
    cure = f"; it is at USB {usb}, plug it into a USB 3 port" if usb[:1] == "2" else ""
    raise DeviceError(f"has no RGB mode of {width}x{height} at {rate}/s{cure}")

  def _maker_lens(self, profile: Any) -> Json:
    inner = profile.as_video_stream_profile().get_intrinsics()
    lens = {
      "height": inner.height,
      "width": inner.width,
      "fx": inner.fx,
      "fy": inner.fy,
      "cx": inner.ppx,
      "cy": inner.ppy,
    }
    return images.opencv_lens(lens, inner.model.name, inner.coeffs)

  def _wait_for_first(self) -> None:
    end = time.monotonic() + _FIRST_FRAME
    while not self._poll():
      if time.monotonic() > end:
        raise DeviceError(
          f"camera {self._serial}: no frame within {_FIRST_FRAME:g} s: check its cable"
        )
      time.sleep(0.005)

  def _poll(self) -> bool:
    """Takes the newest frame of the queue; returns whether there is a newer one.

    Raises:
      DeviceError: The library fails.
    """
    try:
      return self._take()
    except RuntimeError as error:  # Those of librealsense.
      raise DeviceError(f"camera {self._serial}: {one_line(error)}") from None

  def _take(self) -> bool:
    new = False
    while frame := self._queue.poll_for_frame():
      when = self._captured(frame)
      if self._native is None or when > self._native.time:
        # A copy, as librealsense has few buffers, which it uses again.
        self._native = Frame(when, np.array(frame.get_data()))
        self._arrival = time.monotonic()
        new = True
    return new

  def _captured(self, frame: Any) -> float:
    """Returns when a frame was captured by the clock ``time.monotonic``, s.

    If the time is by the camera's own clock, the kernel's time of arrival is used.
    """
    rs = self._rs
    since_epoch = frame.get_timestamp()
    if frame.get_frame_timestamp_domain() == rs.timestamp_domain.hardware_clock:
      kinds = rs.frame_metadata_value
      for kind in (kinds.backend_timestamp, kinds.time_of_arrival):
        if frame.supports_frame_metadata(kind):
          since_epoch = frame.get_frame_metadata(kind)
          break
      else:
        return time.monotonic()
    now = time.monotonic()  # First: a pause before the next clock makes a frame older.
    return min(since_epoch / 1000 - time.time() + now, now)
