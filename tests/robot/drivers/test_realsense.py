"""The driver of the cameras, by the vendor's library, against software devices."""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import math
import sys
import threading
import time
from typing import Any

import numpy as np
import pytest

from apnpql_jax.errors import DeviceError
from apnpql_jax.robot import images
from apnpql_jax.robot.doubles.cameras import SIZE, SoftwareCamera
from apnpql_jax.robot.drivers.realsense import RATE, RealSense

rs = pytest.importorskip("pyrealsense2", reason="needs pyrealsense2")
pytest.importorskip("cv2", reason="needs OpenCV")

FOCAL = 18 / math.tan(math.radians(42.5) / 2)
INNER = {"fx": FOCAL, "fy": FOCAL, "cx": 31.5, "cy": 17.5}
VIEW = {"height": 36, "width": 64, "vertical_fov_deg": 42.5, "intrinsics_px": INNER}
WIDER = {**VIEW, "width": 90, "intrinsics_px": {**INNER, "cx": 44.5}}


def picture(seed: int) -> np.ndarray:
  return np.random.default_rng(seed).integers(0, 256, (*SIZE, 3), np.uint8)


@contextlib.contextmanager
def connected(**settings: Any) -> Generator[tuple[SoftwareCamera, RealSense]]:
  """Yields a camera that has delivered picture(0)."""
  double = SoftwareCamera(rs, "wrist")
  camera = RealSense(
    double.serial, view=VIEW, size=SIZE, devices=[double.device], **settings
  )
  over = threading.Event()

  def first() -> None:  # A frame before the start of the stream is lost.
    while not over.wait(0.05):
      double.show(picture(0), time.time())

  thread = threading.Thread(target=first)
  thread.start()
  try:
    camera.connect()
  finally:
    over.set()
    thread.join()
  yield double, camera
  camera.disconnect()


def test_frames_arrive_bit_for_bit_and_prepared():
  with connected() as (double, camera):
    prepare = images.Preparation(camera.lens(), VIEW)
    for seed in range(1, 6):
      when = time.time()
      double.show(picture(seed), when)
      native, frame = camera.get_native(), camera.get_observation()
      np.testing.assert_array_equal(native.image, picture(seed))
      np.testing.assert_array_equal(frame.image, prepare(picture(seed)))
      assert frame.image.shape == (36, 64, 3)
      assert native.time == frame.time
      first, since_epoch, last = time.monotonic(), time.time(), time.monotonic()
      age = since_epoch - when
      assert first - age - 5e-3 < frame.time < last - age + 1e-3


def test_the_newest_frame_by_capture_wins_and_nothing_waits():
  with connected() as (double, camera):
    now = time.time()
    for seed, when in ((1, now), (2, now + 0.01), (3, now - 0.2)):
      double.show(picture(seed), when)
      camera.get_native()
    np.testing.assert_array_equal(camera.get_native().image, picture(2))
    begin, seen = time.monotonic(), camera.get_observation()
    for _ in range(100):
      assert camera.get_observation() is seen
    assert time.monotonic() - begin < 0.1


def test_a_capture_is_never_in_the_future():
  with connected() as (double, camera):
    double.show(picture(1), time.time() + 5)
    assert camera.get_native().time <= time.monotonic()


def test_an_unplugged_camera_is_one_line_in_time():
  with connected() as (_, camera):
    begin = time.monotonic()
    with pytest.raises(DeviceError, match="sent no frame for 1.0 s") as error:
      while time.monotonic() < begin + 3:
        camera.get_observation()
        time.sleep(0.01)
    assert time.monotonic() < begin + 1.5
    assert "\n" not in str(error.value)


class FailingQueue:
  """The queue of a stream that fails."""

  def poll_for_frame(self) -> None:
    raise RuntimeError("hwmon command failed\nat usb")


def test_a_failure_of_the_library_is_one_line():
  with connected() as (_, camera):
    camera._queue = FailingQueue()
    for read in (camera.get_native, camera.get_observation):
      with pytest.raises(DeviceError, match="camera double-wrist: hwmon") as error:
        read()
      assert "\n" not in str(error.value)


def test_the_lens_is_that_of_the_camera_or_the_given_one():
  with connected() as (double, camera):
    lens = camera.lens()
    assert (lens["height"], lens["width"]) == SIZE
    assert lens["fx"] == pytest.approx(double.focal)
    about = camera.describe()
    assert "D435" in about["model"] and about["serial_number"] == double.serial
  assert (about["firmware"], about["stream"]) == ("0.0.0.0", f"424x240 at {RATE}/s")
  assert about["lens"] == lens
  with connected(lens={**lens, "cx": 210.0}) as (_, camera):
    assert camera.lens()["cx"] == 210.0


@pytest.mark.parametrize(
  ("settings", "text"),
  [
    ({"serial": "123"}, "camera 123: not found .connected: double-wrist"),
    ({"size": (480, 848)}, f"has no RGB mode of 848x480 at {RATE}/s"),
    ({"view": WIDER}, "but the policy needs 88.4 x 42.5 degrees"),
  ],
)
def test_a_camera_that_will_not_do_is_one_line(settings, text):
  double = SoftwareCamera(rs, "wrist")
  given: dict[str, Any] = {"serial": double.serial, "view": VIEW, "size": SIZE}
  given |= settings
  camera = RealSense(given.pop("serial"), devices=[double.device], **given)
  with pytest.raises(DeviceError, match=text) as error:
    camera.connect()
  assert "\n" not in str(error.value)
  camera.disconnect()  # Harmless.


def test_a_camera_that_sends_nothing_is_one_line(monkeypatch):
  monkeypatch.setattr("apnpql_jax.robot.drivers.realsense._FIRST_FRAME", 0.3)
  double = SoftwareCamera(rs, "wrist")
  camera = RealSense(double.serial, view=VIEW, size=SIZE, devices=[double.device])
  with pytest.raises(DeviceError, match="no frame within 0.3 s"):
    camera.connect()


def test_no_camera_or_no_package_is_one_line(monkeypatch):
  with pytest.raises(DeviceError, match="not found .no camera is connected"):
    RealSense("1", view=VIEW, devices=()).connect()
  monkeypatch.setitem(sys.modules, "pyrealsense2", None)
  with pytest.raises(DeviceError, match="robot needs pyrealsense2: pip install"):
    RealSense("1", view=VIEW).connect()
