"""The check names whatever would keep a run from working, with exit code 2."""

from __future__ import annotations

from collections.abc import Callable, Generator
import contextlib
import dataclasses
import functools
import hashlib
import itertools
import json
from pathlib import Path
import re
import time
from typing import Any

import jax
from jax import export
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.cli.main import main
from apnpql_jax.errors import DeviceError
from apnpql_jax.robot import cell, devices, policy_folder, policy_process, setup
from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.calibration import files, limits
from apnpql_jax.robot.calibration.lenses import Lens
from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.check import devices as check_devices, program
from apnpql_jax.robot.check.command import check
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.doubles.server import ask
from apnpql_jax.robot.drivers import realsense
from apnpql_jax.robot.policy_folder import PolicyFolder
from apnpql_jax.robot.protocols import CAMERAS, ArmState, Frame, GripperState

OPEN_CAMERAS = devices.open_cameras


@dataclasses.dataclass
class Arm:
  """An arm that only measures."""

  position: np.ndarray
  age: float = 0.001
  fault: str = ""
  wrench: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(6))

  def connect(self) -> None: ...

  def disconnect(self) -> None: ...

  def describe(self) -> dict[str, Any]:
    return {"model": "UR5e", "polyscope": "5.25"}

  def get_observation(self) -> ArmState:
    when = time.monotonic() - self.age
    return ArmState(when, self.position, np.zeros(6), self.wrench, self.fault)


class Gripper(Arm):
  """A gripper that only measures."""

  def get_observation(self) -> Any:
    return GripperState(time.monotonic() - self.age, 1.1)


@dataclasses.dataclass
class Camera:
  """A camera whose frames have an age."""

  view: dict[str, Any]
  age: float = 0.03
  most: int = 1000

  def connect(self) -> None: ...

  def disconnect(self) -> None: ...

  def describe(self) -> dict[str, Any]:
    return {"model": "D435"}

  def get_observation(self) -> Frame:
    self.most -= 1
    if self.most < 0:
      raise DeviceError("camera 12: sent no frame for 1.0 s")
    size = self.view["height"], self.view["width"], 3
    return Frame(time.monotonic() - self.age, np.zeros(size, np.uint8))


@dataclasses.dataclass
class Bench:
  """A cell whose devices can be made worse."""

  policy: PolicyFolder
  arm: Arm
  cameras: list[Camera]
  cell: Cell = Cell()
  act: Any = None
  gripper: Gripper = dataclasses.field(default_factory=lambda: Gripper(np.zeros(6)))

  def check(self) -> dict[str, Any]:
    robot = Robot("double", self.policy.contract, self.cell)
    return check(robot, self.policy)


@pytest.fixture
def bench(exported, monkeypatch) -> Bench:
  """Returns a cell that is ready, with a program that takes no time."""
  monkeypatch.setattr(check_devices, "_WATCH_S", 0.1)
  monkeypatch.setattr(program, "_INSTANTS", 6)
  policy = policy_folder.load(exported)
  views = policy.contract["cameras"]
  found = Bench(policy, Arm(policy.neutral), [Camera(views[x]) for x in views])
  found.act = program.rest
  monkeypatch.setattr(devices, "make_arm", lambda robot, reads: found.arm)
  monkeypatch.setattr(devices, "make_gripper", lambda robot: found.gripper)
  monkeypatch.setattr(
    devices, "open_cameras", lambda robot: contextlib.nullcontext((found.cameras, None))
  )
  load = policy_process.load_program
  monkeypatch.setattr(
    policy_process, "load_program", lambda *args, **kw: found.act or load(*args, **kw)
  )
  return found


def test_a_cell_that_is_ready_has_all_rows(bench, capsys):
  found = bench.check()
  assert [*found] == [
    *("policy", "cell", "calibration", "arm", "force", "tool", "gripper"),
    *("camera global", "camera wrist", "program", "admittance"),
  ]
  assert found["arm"].startswith("UR5e, polyscope 5.25; measured up to ")
  assert "inside the workspace box" in found["tool"]
  assert "frames of up to 3" in found["camera wrist"]
  assert found["program"].endswith("ms per action, period 150 ms")
  assert capsys.readouterr().err == ""


def stale_joints(bench: Bench) -> None:
  bench.arm.age = 0.05


def stale_gripper(bench: Bench) -> None:
  bench.gripper.age = 0.4


def protective_stop(bench: Bench) -> None:
  bench.arm.fault = "protective stop: clear the collision"


def tool_outside(bench: Bench) -> None:
  bench.cell = Cell(workspace_high_m=(0.3, 0.3, 0.3))


def joint_outside(bench: Bench) -> None:
  bench.arm.position = np.full(6, 6.28)


def a_turn_away(bench: Bench) -> None:
  bench.arm.position = bench.policy.neutral + 2 * np.pi * np.eye(6)[0]


def stale_frames(bench: Bench) -> None:
  bench.cameras[1].age = 0.15


def no_frames(bench: Bench) -> None:
  bench.cameras[0].most = 4


def small_images(bench: Bench) -> None:
  bench.cameras[0].view = {"height": 7, "width": 9}


def slow_program(bench: Bench) -> None:
  def act(*args: Any) -> np.ndarray:
    time.sleep(0.16)
    return np.zeros(7)

  bench.act = act


def nan(bench: Bench) -> None:
  bench.act = lambda *args: np.full(7, np.nan)


def six(bench: Bench) -> None:
  bench.act = lambda *args: np.zeros(6)


def broken(bench: Bench) -> None:
  def act(*args: Any) -> np.ndarray:
    raise ValueError("shapes\ndiffer")

  bench.act = act


@pytest.mark.parametrize(
  ("worsen", "row", "text"),
  [
    (stale_joints, "arm", "ms ago, the limit is 20 ms: check the network"),
    (stale_gripper, "gripper", "ms ago, the limit is 300 ms"),
    (protective_stop, "arm", "FAILS: protective stop"),
    (tool_outside, "tool", "is outside the workspace box: move the arm by hand"),
    (joint_outside, "tool", "is outside its range"),
    (a_turn_away, "tool", "is outside the workspace box: first move the arm by hand"),
    (stale_frames, "camera wrist", "when it acts, the limit is 100 ms"),
    (no_frames, "cameras", "FAILS: camera 12: sent no frame for 1.0 s"),
    (small_images, "cameras", "camera global: an image of (7, 9, 3), not 72 x 96"),
    (slow_program, "program", "per action, period 150 ms: use a faster machine"),
    (nan, "program", "its action is not finite"),
    (six, "program", "its action has 6 numbers, not 7"),
    (broken, "program", "it cannot be run: shapes differ"),
  ],
)
def test_what_would_stop_a_run_fails_and_the_rest_is_shown(
  bench, capsys, worsen, row, text
):
  worsen(bench)
  found = bench.check()
  assert found["exit_code"] == 2 and row in found["not_ready"]
  assert found[row].startswith("FAILS: ") and text in found[row]
  assert "\n" not in found[row]
  assert {"arm", "tool", "gripper", "program", "admittance"} <= {*found}
  shown = capsys.readouterr().err
  assert shown.startswith("apnpql: not ready: ") and shown.count("\n") == 1


def one_in_five(device: Any, age: float) -> None:
  """Gives every fifth measurement of a device another age."""
  read, usual, count = device.get_observation, device.age, itertools.count()

  def get_observation() -> Any:
    device.age = age if next(count) % 5 == 4 else usual
    return read()

  device.get_observation = get_observation


def program_that_waits_now_and_then(bench: Bench) -> None:
  count = itertools.count()

  def act(*args: Any) -> np.ndarray:
    time.sleep(0.16 * (next(count) % 5 == 4))
    return np.zeros(7)

  bench.act = act


@pytest.mark.parametrize(
  ("worsen", "rows"),
  [
    (lambda bench: one_in_five(bench.arm, 0.05), {"arm"}),
    (lambda bench: one_in_five(bench.gripper, 0.4), {"gripper"}),
    (lambda bench: one_in_five(bench.cameras[0], 0.15), {"camera global"}),
    # Frames grow old while the program waits.
    (program_that_waits_now_and_then, {"program", "camera global", "camera wrist"}),
  ],
)
def test_what_is_too_old_or_slow_now_and_then_fails(bench, worsen, rows):
  """In a run, each cycle counts: one measurement that is too old ends it."""
  worsen(bench)
  assert {*bench.check()["not_ready"]} == rows


def test_the_first_action_may_take_longer(bench):
  def act(observation: Any, episode: int, instant: int) -> np.ndarray:
    time.sleep(0.3 * (instant == 0))
    return np.zeros(7)

  bench.act = act
  assert "not_ready" not in bench.check()


def test_a_device_that_is_missing_fails_alone(bench, monkeypatch):
  def nothing(robot: Robot) -> None:
    raise DeviceError("gripper: could not open port /dev/nothing")

  monkeypatch.setattr(devices, "make_gripper", nothing)
  found = bench.check()
  assert found["not_ready"] == ["gripper"]
  assert found["gripper"] == "FAILS: could not open port /dev/nothing"


def test_a_gripper_that_falls_silent_fails_once_and_not_the_program(bench, monkeypatch):
  class Failing(Gripper):
    silent = False

    def get_observation(self) -> Any:
      if self.silent:
        raise DeviceError("gripper: it does not answer")
      return super().get_observation()

  def act(*args: Any) -> np.ndarray:
    gripper.silent = True
    return np.zeros(7)

  gripper, bench.act = Failing(np.zeros(6)), act
  monkeypatch.setattr(devices, "make_gripper", lambda robot: gripper)
  found = bench.check()
  assert found["not_ready"] == ["gripper"]
  assert found["gripper"] == "FAILS: it does not answer"
  assert found["program"].endswith("ms per action, period 150 ms")


def test_a_real_arm_is_checked_before_its_calibration(bench, tmp_path, monkeypatch):
  path = tmp_path / "robot.toml"
  path.write_text(cell.EXAMPLE)
  robot = setup.describe("ur5e", bench.policy, path, calibrated=False)
  found = check(robot, bench.policy)
  assert found["not_ready"] == ["calibration"]
  assert "calibration.json does not exist; make it with" in found["calibration"]


def test_a_camera_that_has_moved_fails_the_calibration_alone(
  bench, tmp_path, monkeypatch
):
  contract, calibrated = bench.policy.contract, {}
  for name in CAMERAS:
    pose, entry = limits.place(contract, name)
    pose[0, 3] += 0.02 * (name == "global")
    lens = Lens(480, 848, 430.0, 430.0, 423.5, 239.5)
    about = {"lens_from": "views"}
    calibrated[name] = files.CalibratedCamera(name, lens, entry, pose, about)
  path = tmp_path / "calibration.json"
  files.save(path, files.Calibration("now", "0", "board", calibrated))
  bench.cell = Cell(calibration=path, cameras={x: x for x in CAMERAS})
  cameras = dict(zip(CAMERAS, bench.cameras, strict=True))
  monkeypatch.setattr(devices, "open_cameras", OPEN_CAMERAS)
  monkeypatch.setattr(realsense, "RealSense", lambda serial, **kw: cameras[serial])
  found = check(Robot("ur5e", contract, bench.cell), bench.policy)
  assert found["not_ready"] == ["calibration"]
  assert "20.0 mm off along x" in found["calibration"]
  assert "frames of up to 3" in found["camera global"]


def test_the_force_is_shown_in_the_world(bench):
  """A push from below is along +z, whichever axes the base of the arm has."""
  up = ArmModel().base_mat.T @ [0.0, 0.0, 12.0]
  bench.arm.wrench = np.append(up, np.zeros(3))
  assert bench.check()["force"].replace("-0.0", "0.0").startswith("(0.0, 0.0, 12.0) N")


def export_program(
  folder: Path, source: Path, act: Callable[..., jax.Array], platform: str = "cpu"
) -> PolicyFolder:
  """Writes a policy whose program is ``act``, a function of (observation, key)."""
  about = json.loads((source / "contract.json").read_text())
  fields = about["observation"]["fields"]
  shapes = {
    k: jax.ShapeDtypeStruct((1, *x["shape"]), x["dtype"]) for k, x in fields.items()
  }
  key = jax.ShapeDtypeStruct((2,), np.uint32)
  made = export.export(jax.jit(act), platforms=[platform])(shapes, key)
  data = bytes(made.serialize())
  about["program"]["sha256"] = hashlib.sha256(data).hexdigest()
  folder.mkdir()
  (folder / about["program"]["file"]).write_bytes(data)
  (folder / "contract.json").write_text(json.dumps(about))
  return policy_folder.load(folder)


def zeros(observation: dict[str, jax.Array], key: jax.Array) -> jax.Array:
  return jnp.zeros((1, 7)) * observation["robot"][0, 0]


def six_zeros(observation: dict[str, jax.Array], key: jax.Array) -> jax.Array:
  return jnp.zeros((1, 6)) * observation["robot"][0, 0]


def not_finite(observation: dict[str, jax.Array], key: jax.Array) -> jax.Array:
  """Divides by a number that is zero at load, and not zero with real joints."""
  return jnp.ones((1, 7)) / jnp.where(observation["robot"][0, 0] == 0, 1.0, 0.0)


@pytest.mark.parametrize(
  ("act", "platform", "text"),
  [
    (zeros, "cpu", " ms per action, period 150 ms"),
    (zeros, "tpu", "FAILS: .* cannot be loaded: .*tpu"),
    (not_finite, "cpu", "FAILS: its action is not finite"),
    (six_zeros, "cpu", "FAILS: its action has 6 numbers, not 7"),
  ],
)
def test_the_program_is_run(bench, exported, tmp_path, act, platform, text):
  bench.act = None
  bench.policy = export_program(tmp_path / "policy", exported, act, platform)
  found = bench.check()
  assert re.search(text, found["program"])
  assert found.get("not_ready", []) == (["program"] if "FAILS" in text else [])


@contextlib.contextmanager
def double(policy: Path, monkeypatch, **controller: Any) -> Generator[Robot]:
  """Starts doubles; the program takes no time."""
  for name in ("rtde_receive", "dynamixel_sdk", "pyrealsense2"):
    pytest.importorskip(name)
  from apnpql_jax.robot import doubles

  serve = functools.partial(doubles.serve, noise=False, **controller)
  monkeypatch.setattr(doubles, "serve", serve)
  monkeypatch.setattr(policy_process, "load_program", lambda *args, **kw: program.rest)
  robot = setup.describe("double", policy_folder.load(policy), Path("none"))
  with setup.doubled(robot) as started:
    yield started


LOCAL = "the teach pendant has control: switch to remote control"
SLOW = "the speed slider is at 30%: set it to 100%"
PROTECTIVE, EMERGENCY = "protective stop: clear the collision", "emergency stop of"
OTHER = "the arm must be a UR5e, not a UR10"
PROBLEMS = LOCAL, SLOW, PROTECTIVE, EMERGENCY, OTHER


@pytest.mark.parametrize(
  ("controller", "fault", "texts"),
  [
    ({}, "", []),
    ({"remote": False}, "", [LOCAL]),
    ({"speed_slider": 0.3}, "", [SLOW]),
    ({}, "protective_stop", [PROTECTIVE]),
    (
      {"remote": False, "speed_slider": 0.3},
      "emergency_stop",
      [EMERGENCY, LOCAL, SLOW],
    ),
    ({"model": "UR10"}, "", [OTHER]),
  ],
)
def test_the_arm_of_a_double_is_only_read(
  exported, monkeypatch, controller, fault, texts
):
  with double(exported, monkeypatch, **controller) as robot:
    host = robot.cell.arm_host
    if fault:
      ask(host, fault)
    before = ask(host, "state")
    found = check(robot, policy_folder.load(exported))
    after = ask(host, "state")
  for text in PROBLEMS:
    assert (text in found["arm"]) == (text in texts), found["arm"]
  assert not texts or "arm" in found["not_ready"]
  assert before["program_runs"] is after["program_runs"] is False
  assert "gripper" not in found.get("not_ready", [])
  np.testing.assert_allclose(after["position"], before["position"], atol=1e-6)
  assert after["finger"] == pytest.approx(before["finger"], abs=1e-3)


def test_the_command_ends_with_exit_code_2(bench, exported, monkeypatch, capsys):
  command = ["robot", "check", "--robot", "double", "--policy", str(exported)]
  monkeypatch.setattr(setup, "doubled", contextlib.nullcontext)
  assert main(command) == 0
  bench.arm.fault = "protective stop"
  capsys.readouterr()
  assert main(command) == 2
  shown = capsys.readouterr()
  assert "FAILS: protective stop" in shown.out and "admittance" in shown.out
  assert shown.err == "apnpql: not ready: arm\n"
