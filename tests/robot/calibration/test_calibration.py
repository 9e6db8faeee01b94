"""Calibration of both cameras: rendered boards, with MuJoCo's poses as the truth."""

from __future__ import annotations

import copy
import dataclasses
import json
from pathlib import Path
import shutil
from typing import Any

import numpy as np
from PIL import Image
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("cv2")

import jax
from rendered import HEIGHT, WIDTH, Studio, displace, postures, studio, write_views

from apnpql_jax.cli import robot as cli
from apnpql_jax.cli.main import main
from apnpql_jax.config import files as project_files
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.deploy import contract as contracts
from apnpql_jax.errors import ConfigError, FileError, UserError
from apnpql_jax.robot import devices
from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.calibration import command, files, limits, solve, views
from apnpql_jax.robot.calibration.boards import Board
from apnpql_jax.robot.calibration.problem import Problem, angle_deg
from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.protocols import ArmState, Frame
from apnpql_jax.sim.scene import load_scene

MOST_MM, MOST_DEG = 2.0, 0.3
BOARD = Board()
DISTORTION = (0.1, -0.2, 0.001, -0.0005, 0.05)
VIEWS = 12
SHIFTS = {"wrist": (0.001, -0.0015, 0.0008), "global": (-0.009, 0.012, 0.007)}
TURNS = {"wrist": (0.01, -0.008, 0.012), "global": (-0.012, 0.01, 0.006)}
"""How the cameras are mounted: off the contract, within what training varies."""


@pytest.fixture(scope="module")
def contract() -> dict[str, Any]:
  """Returns the contract of a policy that was trained with randomization."""
  scene = load_scene(project_files.mjcf_path("push_plate"))
  config = EnvConfig(task="push_plate", randomize=True)
  images = {
    f"{name}_image": jax.ShapeDtypeStruct((1, *size, 3), np.uint8)
    for name, size in (("global", config.global_size), ("wrist", config.wrist_size))
  }
  found = contracts.describe(config, scene, images, lstm_instants=0)
  return json.loads(json.dumps(found))


@dataclasses.dataclass
class Case:
  """A folder of views and the truth about their camera."""

  folder: Path
  truth: np.ndarray
  joints: np.ndarray


def photograph(made: Studio, folder: Path, name: str, **options: Any) -> Case:
  displace(made, name, SHIFTS[name], TURNS[name])
  joints = postures(made, name, VIEWS)
  write_views(folder / name, made, name, joints, serial=f"serial of {name}", **options)
  return Case(folder / name, made.truth(name), joints)


@pytest.fixture(scope="module")
def wrist(tmp_path_factory) -> Case:
  """Returns twelve views of a board on the table, by a distorting lens."""
  with studio(BOARD, on_tool=False) as made:
    return photograph(
      made, tmp_path_factory.mktemp("wrist"), "wrist", distortion=DISTORTION
    )


@pytest.fixture(scope="module")
def held(tmp_path_factory) -> Case:
  """Returns twelve views of a board in the hand by the global camera."""
  with studio(BOARD, on_tool=True) as made:
    return photograph(made, tmp_path_factory.mktemp("held"), "global")


@pytest.fixture
def both(tmp_path, wrist, held) -> Path:
  """Returns a folder with the views of both cameras."""
  shutil.copytree(wrist.folder, tmp_path / "views" / "wrist")
  shutil.copytree(held.folder, tmp_path / "views" / "global")
  return tmp_path / "views"


def assert_close(found: np.ndarray, truth: np.ndarray) -> None:
  assert 1e3 * np.linalg.norm(found[:3, 3] - truth[:3, 3]) < MOST_MM
  assert angle_deg(found, truth) < MOST_DEG


def problem(case: Case, *, on_tool: bool) -> Problem:
  shown = views.load(case.folder)
  seen = views.seen_in(BOARD, shown)
  motion = np.tile(np.eye(4), (len(seen), 1, 1))
  for pose, i in zip(motion, seen, strict=True):
    pose[:3, 3], pose[:3, :3] = ArmModel().flange_pose(shown.joints[i])
  if not on_tool:
    motion = np.linalg.inv(motion)
  assert shown.lens is not None
  return Problem(BOARD, shown.lens, [*seen.values()], motion)


def test_both_cameras_are_found(contract, both, wrist, held, tmp_path):
  out = tmp_path / "calibration.json"
  result = command.calibrate(contract, both, out)
  calibration = files.load(out, contract)
  assert_close(calibration.cameras["wrist"].pose, wrist.truth)
  assert_close(calibration.cameras["global"].pose, held.truth)
  assert calibration.cameras["wrist"].entry == "pose_in_flange"
  assert calibration.cameras["global"].entry == "pose_in_world"
  assert calibration.cameras["wrist"].serial == "serial of wrist"
  assert calibration.contract_sha256 == files.hash_of(contract)
  for name, case in (("wrist", wrist), ("global", held)):
    residuals = calibration.cameras[name].about["residuals"]
    assert residuals["px"] < 0.5 and residuals["held_out"]["px"] < 0.6
    assert residuals["held_out"]["mm"] < MOST_MM
    assert residuals["held_out"]["deg"] < MOST_DEG
    # What is reported as off is what the camera was displaced by.
    off = np.array(result[name]["off_deg"])
    np.testing.assert_allclose(off, np.degrees(TURNS[name]), atol=MOST_DEG)
    assert np.linalg.norm(result[name]["off_mm"]) == pytest.approx(
      1e3 * np.linalg.norm(SHIFTS[name]), abs=MOST_MM
    )
    # The stated deviation holds the true error (three of them).
    pose = calibration.cameras[name].pose
    error = 1e3 * np.linalg.norm(pose[:3, 3] - case.truth[:3, 3])
    assert error < 3 * residuals["deviation_mm"] + 0.3
  assert [Path(x).name for x in result["pictures"]] == [
    "calibration_wrist.png",
    "calibration_global.png",
  ]


def test_the_picture_aligns_the_simulated_view(contract, both, tmp_path):
  """With the pose found, edges of the simulated view fall on edges of the photo."""
  out = tmp_path / "calibration.json"
  (path,) = command.calibrate(contract, _only(both, "global"), out)["pictures"]
  real, _, overlay = np.split(np.asarray(Image.open(path)).astype(float), 3, 1)
  edges = (overlay == (255, 90, 0)).all(-1)
  assert edges.sum() > 500
  gradient = np.hypot(*np.gradient(real.mean(-1)))

  def agreement(shift: int) -> float:
    """Returns the median gradient of the photo where edges are, moved by pixels."""
    return float(np.median(np.roll(gradient, (shift, shift), (0, 1))[edges]))

  assert agreement(0) > 3 * max(agreement(shift) for shift in (-6, -4, 4, 6))


def test_a_board_on_the_table_serves_both_cameras(contract, wrist, tmp_path):
  """The wrist camera finds the board, and the global camera sees it there."""
  folder = tmp_path / "views"
  shutil.copytree(wrist.folder, folder / "wrist")
  with studio(BOARD, on_tool=False) as made:
    displace(made, "global", SHIFTS["global"], TURNS["global"])
    aside = [[-2.8, -1.9, 1.9, -1.6, -1.6, x] for x in (0.0, 0.1, 0.2)]
    write_views(folder / "global", made, "global", np.array(aside))
    truth = made.truth("global")
  out = tmp_path / "calibration.json"
  result = command.calibrate(contract, folder, out, board_on="table")
  camera = files.load(out, contract).cameras["global"]
  assert_close(camera.pose, truth)
  residuals = camera.about["residuals"]
  assert 0 < residuals["deviation_mm"] < MOST_MM
  assert residuals["px"] < residuals["held_out"]["px"] < 0.6
  assert result["global"]["error_mm"] == round(residuals["held_out"]["mm"], 2) > 0
  for path in [*(folder / "global").glob("00[12].*")]:
    path.unlink()
  with pytest.raises(ConfigError, match="one view shows the board, but at least 2"):
    command.calibrate(contract, folder, out, board_on="table", overwrite=True)
  (folder / "wrist").rename(tmp_path / "wrist")
  with pytest.raises(ConfigError, match="global camera: with the board on the table"):
    command.calibrate(contract, folder, out, board_on="table", overwrite=True)


def test_the_lens_is_estimated_where_the_camera_gives_none(contract, wrist, tmp_path):
  folder = tmp_path / "views"
  shutil.copytree(wrist.folder, folder / "wrist")
  (folder / "wrist" / "camera.json").write_text('{"serial": "1"}')
  found = command._calibrate_one(contract, "wrist", folder / "wrist", BOARD, "tool", {})
  assert found.camera.about["lens_from"] == "views"
  known = views.load(wrist.folder).lens
  assert known is not None
  assert found.camera.lens.fx == pytest.approx(known.fx, rel=0.01)
  assert_close(found.camera.pose, wrist.truth)


def test_the_closed_form_is_that_of_opencv(wrist):
  """From views with noise, for which each solver finds another pose."""
  cv2 = pytest.importorskip("cv2")
  if not hasattr(cv2, "calibrateHandEye"):
    pytest.skip("the wheels of OpenCV 5 have no such solver")
  case = problem(wrist, on_tool=False)
  poses = np.stack([case.lens.board_pose(BOARD, x) for x in case.seen])
  hands = np.linalg.inv(case.motion)
  turn, shift = cv2.calibrateHandEye(
    *(hands[:, :3, :3], hands[:, :3, 3], poses[:, :3, :3], poses[:, :3, 3]),
    method=cv2.CALIB_HAND_EYE_PARK,
  )
  found = solve.hand_eye(hands, poses)
  np.testing.assert_allclose(found[:3, :3], turn, atol=1e-9)
  np.testing.assert_allclose(found[:3, 3], shift.ravel(), atol=1e-9)


@pytest.mark.parametrize("on_tool", [False, True])
def test_outliers_are_left_out(wrist, held, on_tool):
  """Three of twelve views have the joint angles of another."""
  case = held if on_tool else wrist
  good = problem(case, on_tool=on_tool)
  wrong = [1, 4, 7]
  motion = good.motion.copy()
  motion[wrong] = motion[[4, 7, 1]]
  found = solve.solve(dataclasses.replace(good, motion=motion))
  assert np.flatnonzero(~found.kept).tolist() == wrong
  assert found.residuals["outliers"] == wrong
  assert_close(found.camera, case.truth)


def test_an_arm_that_is_not_exact_suffices(wrist):
  """A flange that is off by 0.7 mm and 0.1 degrees along each axis, at random."""
  good = problem(wrist, on_tool=False)
  rng, motion = np.random.default_rng(0), good.motion.copy()
  for pose in motion:
    pose[:3, 3] += rng.normal(scale=0.7e-3, size=3)
    turn = Rotation.from_rotvec(np.radians(rng.normal(scale=0.1, size=3)))
    pose[:3, :3] = turn.as_matrix() @ pose[:3, :3]
  found = solve.solve(dataclasses.replace(good, motion=motion))
  assert found.kept.all() and found.residuals["held_out"]["mm"] > 0.7
  assert_close(found.camera, wrist.truth)


def test_views_that_contradict_each_other_are_refused(wrist):
  good = problem(wrist, on_tool=False)
  mixed = dataclasses.replace(good, motion=np.roll(good.motion, 1, axis=0))
  with pytest.raises(ConfigError, match="views contradict each other by .* pixels"):
    solve.solve(mixed)


def test_motion_about_one_axis_is_refused(wrist):
  good = problem(wrist, on_tool=False)
  first = good.motion[0]
  motion = np.stack([first] * len(good.seen))
  for i, pose in enumerate(motion):
    pose[:3, :3] = Rotation.from_euler("z", 0.1 * i).as_matrix() @ first[:3, :3]
  with pytest.raises(ConfigError, match="about one axis and 0.0 about a second"):
    solve.solve(dataclasses.replace(good, motion=motion))
  still = np.stack([first] * len(good.seen))
  with pytest.raises(ConfigError, match="turns 0.0 degrees about one axis"):
    solve.solve(dataclasses.replace(good, motion=still))


def test_a_print_of_another_size_is_refused(wrist):
  """A printer that fits the page prints at 94 %."""
  good = problem(wrist, on_tool=False)
  larger = Board(square_mm=BOARD.square_mm / 0.94, marker_mm=BOARD.marker_mm / 0.94)
  with pytest.raises(ConfigError, match=r"squares measure 3[56]\.\d+ mm, not 38\.2979"):
    solve.solve(dataclasses.replace(good, board=larger))


def _only(folder: Path, name: str) -> Path:
  for other in folder.iterdir():
    if other.name != name:
      shutil.rmtree(other)
  return folder


def test_a_camera_out_of_range_is_refused_with_the_cure(contract, both, tmp_path):
  """Where the policy was trained without randomization, much less is allowed."""
  folder, out = _only(both, "global"), tmp_path / "calibration.json"
  strict = copy.deepcopy(contract) | {"randomization": None}
  with pytest.raises(ConfigError) as caught:
    command.calibrate(strict, folder, out)
  message = str(caught.value)
  assert "\n" not in message
  assert "(limit 5.0)" in message and "(limit 0.57)" in message
  # Shifts and turns are in the camera's axes there; the message has the world's.
  nominal, _ = limits.place(contract, "global")
  back = -1e3 * nominal[:3, :3] @ SHIFTS["global"]
  stated = message.split("move it by (")[1].split(")")[0].split(", ")
  np.testing.assert_allclose([float(x) for x in stated], back, atol=1.5)
  assert "turn it by (" in message
  assert not out.exists()
  assert out.with_name("calibration_global.png").exists()


def test_limits_are_those_of_the_randomization(contract):
  nominal, _ = limits.place(contract, "global")
  lens = views.Lens(720, 1280, 900.0, 900.0, 639.5, 359.5)
  limits.check(contract, "global", nominal, lens)
  for name, most in (("global", 0.02), ("wrist", 0.002)):
    nominal, _ = limits.place(contract, name)
    for axis, sign in ((0, 1), (1, -1), (2, 1)):
      moved = nominal.copy()
      along = np.eye(3)[axis] if name == "global" else nominal[:3, axis]
      moved[:3, 3] += sign * 0.98 * most * along
      limits.check(contract, name, moved, lens)
      moved[:3, 3] += sign * 0.04 * most * along
      with pytest.raises(ConfigError, match=rf"mm off along {'xyz'[axis]} \(limit"):
        limits.check(contract, name, moved, lens)
      turned = nominal.copy()
      turned[:3, :3] @= Rotation.from_rotvec(0.021 * np.eye(3)[axis]).as_matrix()
      with pytest.raises(ConfigError, match=rf"degrees off about its {'xyz'[axis]}"):
        limits.check(contract, name, turned, lens)
  # The cure leads back.
  moved = nominal.copy()
  moved[:3, 3] += 0.003 * nominal[:3, 0]
  with pytest.raises(ConfigError, match=r"move it by \(-3\.0, [+-]0\.0, [+-]0\.0\) mm"):
    limits.check(contract, "wrist", moved, lens)
  narrow = dataclasses.replace(lens, fx=1800.0, fy=1800.0)
  with pytest.raises(ConfigError, match="global camera: the camera sees"):
    limits.check(contract, "global", limits.place(contract, "global")[0], narrow)


def _refused(contract: dict[str, Any], folder: Path, match: str, **options) -> None:
  with pytest.raises(UserError, match=match) as caught:
    command.calibrate(contract, folder, folder.parent / "made.json", **options)
  assert "\n" not in str(caught.value)
  assert not (folder.parent / "made.json").exists()


def test_bad_views_are_one_line(contract, both, tmp_path):
  folder = both / "wrist"

  def each(change) -> None:
    for path in sorted(folder.glob("*.png")):
      change(path)

  shutil.rmtree(both / "global")
  for path in sorted(folder.glob("*.png"))[7:]:
    path.rename(path.with_suffix(".aside"))
  _refused(contract, both, "wrist camera: 7 views show the board, but at least 8")
  camera = (folder / "camera.json").read_text()
  (folder / "camera.json").write_text('{"serial": "1"}')
  _refused(contract, both, "7 views of the board do not determine the lens")
  (folder / "camera.json").write_text(camera)
  for path in sorted(folder.glob("*.aside")):
    path.rename(path.with_suffix(".png"))
  _refused(contract, both, "shows .* markers of 5x5_100", board="7x5:36:27:4x4_50")
  _refused(contract, both, "shows .* of 5x5_100 in another", board="12x9:36:27:5x5_100")
  _refused(contract, both, "'7x5' is no board; write it as 7x5:36", board="7x5")
  _refused(contract, both, "unknown --board-on 'wall'", board_on="wall")
  serials = {"wrist": "77", "global": "78"}
  other = "views in .* are of serial of wrist, but the robot has 77"
  _refused(contract, both, other, serials=serials)
  _refused(contract | {"cameras": {}}, both, "the policy sees no images")
  angles = folder / "003.json"
  before = angles.read_text()
  angles.write_text('{"joints": [90, -90, 0, 0, 0, 0]}')
  _refused(contract, both, "003.json: a joint angle of 90.0: use rad")
  angles.write_text('{"joints": [1, 2]}')
  _refused(contract, both, "003.json: joints must be six numbers")
  angles.unlink()
  _refused(contract, both, "cannot read .*003.json")
  angles.write_text(before)
  image = folder / "003.png"
  whole = image.read_bytes()
  image.write_bytes(whole[:1000])
  _refused(contract, both, "cannot read .*003.png")
  Image.fromarray(np.zeros((480, 640, 3), np.uint8)).save(image)
  _refused(contract, both, "003.png has 640x480 pixels, not 768x432")
  each(lambda p: Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).save(p))
  _refused(contract, both, "no view shows the board 7x5:36:27:5x5_100: light it")
  (folder / "camera.json").write_text("{}")
  _refused(contract, both, 'camera.json must have "serial"')
  (folder / "camera.json").unlink()
  _refused(contract, both, "cannot read .*camera.json")
  shutil.rmtree(folder)
  _refused(contract, both, "there are no views in")


@pytest.fixture
def written(contract, tmp_path) -> Path:
  """Returns a calibration of cameras that are where the contract says."""
  lens = views.Lens(720, 1280, 900.0, 900.0, 639.5, 359.5)
  cameras = {}
  for name in contract["cameras"]:
    pose, entry = limits.place(contract, name)
    cameras[name] = files.CalibratedCamera(f"of {name}", lens, entry, pose, {})
  path = tmp_path / "calibration.json"
  files.save(path, files.Calibration("now", "0", BOARD.text, cameras))
  return path


def test_a_reader_refuses_what_is_missing_or_of_other_cameras(
  contract, written, tmp_path
):
  serials = {"global": "of global", "wrist": "of wrist"}
  files.load(written, contract, serials)

  def refused(match: str, path: Path = written, **options: Any) -> None:
    with pytest.raises(UserError, match=match) as caught:
      files.load(path, contract, **options)
    assert "\n" not in str(caught.value)

  refused("wrist camera of wrist, but x is", serials=serials | {"wrist": "x"})
  refused("cannot read .*none.json.*apnpql robot calibrate", tmp_path / "none.json")
  value = json.loads(written.read_text())

  def changed(**entries: Any) -> None:
    written.write_text(json.dumps(value | entries))

  changed(cameras={"global": value["cameras"]["global"]})
  refused("lacks the wrist camera: calibrate it")
  changed(version=2)
  refused("its format is not apnpql-calibration 1")
  moved = copy.deepcopy(value["cameras"])
  moved["global"]["pose_in_world"]["position_m"][1] += 0.05
  changed(cameras=moved)
  refused("global camera is not where the policy was trained for: 50.0 mm off along y")
  moved["global"]["pose_in_world"]["position_m"] = ["a"]
  changed(cameras=moved)
  refused("is damaged")
  blind = copy.deepcopy(value["cameras"])
  blind["global"]["lens"]["fx"] = float("nan")
  changed(cameras=blind)
  refused("a lens has impossible numbers")
  written.write_text("{")
  refused("is damaged")


def test_an_earlier_calibration_is_kept_or_completed(
  contract, both, written, wrist, tmp_path
):
  folder = _only(both, "wrist")
  with pytest.raises(FileError, match="exists; replace it with --overwrite"):
    command.calibrate(contract, folder, written)
  command.calibrate(contract, folder, written, overwrite=True)
  loaded = files.load(written, contract)
  assert loaded.cameras["global"].serial == "of global"
  assert loaded.cameras["wrist"].serial == "serial of wrist"
  assert_close(loaded.cameras["wrist"].pose, wrist.truth)


def test_a_damaged_calibration_is_replaced_by_one_of_all_cameras(
  contract, both, written, held
):
  written.write_text("{")
  command.calibrate(contract, both, written, overwrite=True)
  assert_close(files.load(written, contract).cameras["global"].pose, held.truth)
  written.write_text("{")
  with pytest.raises(FileError, match="is damaged"):
    command.calibrate(contract, _only(both, "wrist"), written, overwrite=True)


def test_the_command_calibrates_a_cell(contract, both, tmp_path, held):
  """Without devices; the lens that is the maker's is not that of another mode."""
  out = tmp_path / "calibration.json"
  serials = {name: f"serial of {name}" for name in contract["cameras"]}
  robot = Robot("ur5e", contract, Cell(calibration=out, cameras=serials))
  args = cli.Robot(action="calibrate", robot="ur5e", views=both, recorded=True)
  result = cli._calibrate(args, robot)
  assert result["wrist"]["views"] >= 8 and result["global"]["views"] >= 8
  assert_close(files.read(out).cameras["global"].pose, held.truth)
  assert devices.calibrated_modes(robot) == {}
  value = json.loads(out.read_text())
  value["cameras"]["wrist"]["lens_from"] = "views"
  out.write_text(json.dumps(value))
  (mode,) = devices.calibrated_modes(robot).values()
  assert mode["size"] == (HEIGHT, WIDTH) and mode["lens"]["fx"] > 0
  with pytest.raises(ConfigError, match="only the cameras of --robot ur5e"):
    cli._calibrate(args, Robot("simulated", contract, Cell()))


def test_the_command_prints_a_board(tmp_path, capfd):
  path = tmp_path / "board.pdf"
  assert main(["robot", "calibrate", "--print-board", str(path)]) == 0
  assert "7 squares must be 252 mm long" in capfd.readouterr().out
  assert path.exists()
  assert main(["robot", "calibrate", "--print-board", "x.pdf", "--board", "3"]) == 2
  assert "'3' is no board; write it as 7x5:36:27" in capfd.readouterr().err


SWINGING = 4
"""Number of the posture at which the arm does not come to rest."""


class Hand:
  """An arm that is moved by hand through postures, and trembles before each."""

  def __init__(self, joints: np.ndarray, camera: Sensor):
    self.joints, self.at, self.now = joints, -1, 0.0
    self.camera = camera

  def move(self, text: str) -> str:
    """Answers the question for a view."""
    self.at += 1
    self.moved = self.now
    return "d" if self.at == len(self.joints) else ""

  def get_observation(self) -> ArmState:
    # It trembles at first, and swings all the time at one posture.
    moving = self.now < self.moved + 0.2 or self.at == SWINGING
    speed = 0.1 if moving else 0.0
    joints = self.joints[min(self.at, len(self.joints) - 1)] + 0.1 * speed
    self.camera.showing = None if moving else self.at
    return ArmState(self.now, joints, np.full(6, speed), np.zeros(6))


class Sensor:
  """A camera that shows the photo of the posture, and black while the arm moves."""

  def __init__(self, images: list[np.ndarray], lens: dict[str, Any]):
    self.images, self._lens, self.showing = images, lens, None
    self.clock: Any = None

  def describe(self) -> dict[str, Any]:
    return {"serial_number": "live"}

  def lens(self) -> dict[str, Any]:
    return self._lens

  def get_native(self) -> Frame:
    black = np.zeros_like(self.images[0])
    image = black if self.showing is None else self.images[self.showing]
    return Frame(self.clock.now, image)


def test_a_used_folder_is_found_before_the_first_view(contract, tmp_path):
  sensor, asked = Sensor([], {}), []
  (tmp_path / "views" / "global").mkdir(parents=True)
  with pytest.raises(FileError, match="global exists; name another folder"):
    command.calibrate(
      contract,
      tmp_path / "views",
      tmp_path / "calibration.json",
      arm=Hand(np.zeros((1, 6)), sensor),  # ty: ignore[invalid-argument-type]
      cameras=dict.fromkeys(("wrist", "global"), sensor),  # ty: ignore[invalid-argument-type]
      ask=lambda text: asked.append(text) or "d",
    )
  assert not asked


def test_views_are_taken_with_connected_devices(
  contract, wrist, tmp_path, monkeypatch, capfd
):
  """Only at rest; a view without the board is not kept, nor one of a moving arm."""
  shown = views.load(wrist.folder)
  assert shown.lens is not None
  more = [2, SWINGING - 1]  # One without the board, one that is not held still.
  joints = np.insert(shown.joints, more, shown.joints[0], axis=0)
  images = [*shown.images[:2], np.zeros_like(shown.images[0]), shown.images[2]]
  images += [shown.images[0], *shown.images[3:]]
  sensor = Sensor(images, shown.lens.to_json())
  arm = Hand(joints, sensor)
  sensor.clock = arm

  def sleep(seconds: float) -> None:
    arm.now += seconds

  monkeypatch.setattr(views.time, "monotonic", lambda: arm.now)
  monkeypatch.setattr(views.time, "sleep", sleep)
  out = tmp_path / "calibration.json"
  command.calibrate(
    contract,
    tmp_path / "live",
    out,
    arm=arm,  # ty: ignore[invalid-argument-type]
    cameras={"wrist": sensor},  # ty: ignore[invalid-argument-type]
    ask=arm.move,
  )
  told = capfd.readouterr().err
  assert told.count("not in view") == 1 and told.count("not come to rest") == 1
  taken = views.load(tmp_path / "live" / "wrist")
  np.testing.assert_array_equal(taken.joints, shown.joints)
  made = files.read(out).cameras["wrist"]
  assert made.serial == "live"
  assert_close(made.pose, wrist.truth)
  with pytest.raises(FileError, match="exists; name another folder for new views"):
    views.record(tmp_path / "live" / "wrist", BOARD, arm, sensor, ask=arm.move)  # ty: ignore[invalid-argument-type]

  def nobody(text: str) -> str:
    raise EOFError

  views.record(tmp_path / "none" / "wrist", BOARD, arm, sensor, ask=nobody)  # ty: ignore[invalid-argument-type]
  assert not (tmp_path / "none").exists()
  with pytest.raises(ConfigError, match="wrist camera gives no images of its sensor"):
    views.record(tmp_path / "new" / "wrist", BOARD, arm, arm, ask=arm.move)  # ty: ignore[invalid-argument-type]
