"""Bad cells and policies are one line each, with exit code 2, before anything moves."""

from __future__ import annotations

import json
from pathlib import Path
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from apnpql_jax.cli.main import main
from apnpql_jax.deploy.export import VERSION
from apnpql_jax.errors import ConfigError, DeviceError, FileError
from apnpql_jax.robot import cell, devices, policy_folder
from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.description import ROBOTS, Robot
from apnpql_jax.robot.limits import MotionLimiter
from apnpql_jax.testing import ROOT

CENTER = np.array([0.5, 0.0, 0.2])
"""A place inside of the workspace of the example."""


@pytest.fixture
def copied(exported, tmp_path) -> Path:
  """Returns a copy of the policy to damage."""
  folder = tmp_path / "copy"
  folder.mkdir()
  for file in exported.iterdir():
    (folder / file.name).write_bytes(file.read_bytes())
  return folder


def change(folder: Path, *keys: str, value: Any) -> None:
  about = json.loads((folder / "contract.json").read_text())
  part = about
  for key in keys[:-1]:
    part = part[key]
  part[keys[-1]] = value
  (folder / "contract.json").write_text(json.dumps(about))


def test_an_exported_policy_is_accepted(exported):
  policy = policy_folder.load(exported)
  assert policy.begins_closed  # push_plate begins with closed fingers.
  assert policy.neutral.shape == (6,) and policy_folder.VERSION == VERSION


@pytest.mark.parametrize(
  ("keys", "value", "message"),
  [
    (("contract",), 2, "another version of the contract"),
    (("control_period_s",), 0.001, "has a period of 0.001 s"),
    (("control_period_s",), 0.1512, "has a period of 0.1512 s"),
    (("joints", "state"), ["a"] * 7, "an arm with other joints"),
    (("joints",), {}, "is damaged"),
    (("joints", "ranges"), [[-1e3, 1e3]] * 7, "other ranges"),
    (("joints", "ranges"), [[float("nan")] * 2] * 7, "other ranges"),
    (("joints", "ranges"), [[0.0]], "other ranges"),
    (("frames", "tool_in_flange", "position_m"), [0, 0, 0.2], "another arm or gripper"),
    (("frames", "base_in_world", "position_m"), [0, 0, 0.2], "another arm or gripper"),
    (("action", "motor_model", "gain_1_per_s"), 30.0, "other motors"),
    (("observation", "fields"), {"robot": {}, "objects": {}}, "needs objects"),
    (("observation", "fields"), {"robot": {}, "tool": {}}, "needs no images"),
    (("program", "sha256"), "0", "is not the program of its contract"),
  ],
)
def test_policies_for_something_else_are_refused(copied, keys, value, message):
  change(copied, *keys, value=value)
  with pytest.raises((ConfigError, FileError), match=message) as error:
    policy_folder.load(copied)
  assert "\n" not in str(error.value)


def test_damaged_folders_are_refused(copied, tmp_path):
  with pytest.raises(FileError, match="not an exported policy"):
    policy_folder.load(tmp_path / "none")
  data = (copied / "policy.bin").read_bytes()
  (copied / "policy.bin").write_bytes(data[:-1] + b"x")
  with pytest.raises(FileError, match="is not the program of its contract"):
    policy_folder.load(copied)
  (copied / "policy.bin").unlink()
  with pytest.raises(FileError, match="cannot be read"):
    policy_folder.load(copied)
  text = (copied / "contract.json").read_text()
  (copied / "contract.json").write_text(text[:100])
  with pytest.raises(FileError, match="is damaged"):
    policy_folder.load(copied)


def test_the_example_of_a_cell_is_valid(tmp_path):
  path = tmp_path / "robot.toml"
  path.write_text(cell.EXAMPLE)
  found = cell.load_cell(path)
  assert found.arm_host == "192.168.0.10"
  assert found.calibration == tmp_path / "calibration.json"
  assert found.cameras == {"global": "123456789012", "wrist": "210987654321"}
  limits = found.limits({"joints": {"ranges": [[-1, 1]] * 7}, "control_period_s": 0.1})
  np.testing.assert_allclose(limits.box[:, 0], [0.25, -0.35, 0.005])
  np.testing.assert_allclose(limits.joints[0], [-0.95, 0.95])
  assert limits.period == 0.1


def test_a_cell_may_slow_the_arm(tmp_path):
  path = tmp_path / "robot.toml"
  path.write_text(cell.EXAMPLE + "[limits]\njoint_velocity_rad_per_s = 0.3\n")
  contract = {"joints": {"ranges": [[-7, 7]] * 7}, "control_period_s": 0.15}
  limiter = MotionLimiter(cell.load_cell(path).limits(contract), lambda joints: CENTER)
  limiter.start(np.zeros(6))
  for _ in range(1000):
    limiter.step(np.ones(6), limiter.position)
  np.testing.assert_allclose(limiter.velocity, 0.3)


def test_the_page_shows_the_example():
  page = (ROOT / "docs" / "robot.md").read_text(encoding="utf-8")
  assert f"```toml\n{cell.EXAMPLE}```" in page


def test_the_frame_of_the_workspace_is_that_of_the_pages():
  """World x is Base y, world y is minus Base x; test_robot.py has the DH base."""
  x, y, z = base = np.array([0.3, -0.4, 0.2])
  np.testing.assert_allclose(ArmModel().base_mat @ base, [y, -x, z], atol=1e-7)


@pytest.mark.parametrize(
  ("old", "new", "message"),
  [
    ("host = ", "hots = ", "unknown key arm.hots"),
    ('port = "/dev/ttyUSB0"', "", "has no gripper.port; add it as text in quotes"),
    ("payload_kg = 0.488", "payload_kg = -1", "payload_kg = -1.* a positive number"),
    ("payload_kg = 0.488", "payload_kg = true", "must be a positive number"),
    ("[0.25, -0.35, 0.005]", "[0.25, -0.35]", "must be three numbers"),
    ("[0.25, -0.35, 0.005]", "[0.25, nan, 0]", "must be three numbers"),
    ("[0.25, -0.35, 0.005]", "[-inf, -inf, -inf]", "must be three numbers"),
    ("[0.25, -0.35, 0.005]", "[0.9, 0, 0]", "low_m must be below"),
    ("210987654321", "123456789012", "are the same camera"),
    ("[arm]", "[arm", "cannot be read"),
    *(
      (
        "[gripper]",
        f"[{table}]\n{key} = {value}\n[gripper]",
        f"{table}.{key} = .*{text}",
      )
      for table, key, value, text in (
        ("limits", "joint_velocity_rad_per_s", 2, "must be 0.1 to 1"),
        ("admittance", "contact_stiffness_n_per_m", 10, "must be 5000 to 50000"),
        ("admittance", "contact_stiffness_n_per_m", 1e6, "must be 5000 to 50000"),
        ("admittance", "lag_s", 0.001, "must be 0.03 to 0.1"),
        ("admittance", "lag_s", 45, "must be 0.03 to 0.1"),  # Milliseconds.
      )
    ),
  ],
)
def test_bad_cells_name_the_key_and_the_cure(tmp_path, old, new, message):
  path = tmp_path / "robot.toml"
  assert old in cell.EXAMPLE
  path.write_text(cell.EXAMPLE.replace(old, new))
  with pytest.raises(ConfigError, match=message) as error:
    cell.load_cell(path)
  assert "\n" not in str(error.value)


@pytest.fixture
def real_cell(tmp_path) -> Path:
  """Returns the file of a cell without a calibration."""
  path = tmp_path / "robot.toml"
  path.write_text(cell.EXAMPLE)
  return path


@pytest.mark.parametrize(
  ("args", "message"),
  [
    ([], "robot needs an action: check, calibrate, run"),
    (["fly"], "unknown robot action 'fly'"),
    (["run", "--robot", "ur10"], "unknown --robot 'ur10'"),
    (["run"], "robot needs --policy"),
    (["run", "--episodes", "0"], "--episodes must be at least 1"),
    (["run", "--robot", "ur5e", "--latency-ms", "5"], "need --robot simulated"),
  ],
)
def test_bad_options_are_one_line(args, message, capsys):
  assert main(["robot", *args]) == 2
  shown = capsys.readouterr().err
  assert message in shown and shown.count("\n") == 1


def test_what_does_not_fit_the_cell_is_refused(exported, real_cell, capsys):
  command = ["robot", "run", "--policy", str(exported), "--cell", str(real_cell)]
  cases = {
    "for push_plate, not for flip_cup": ["--task", "flip_cup"],
    "calibration.json does not exist; make it with": ["--robot", "ur5e"],
  }
  for message, more in cases.items():
    assert main([*command, *more]) == 2
    shown = capsys.readouterr().err
    assert message in shown and shown.count("\n") == 1
  text = real_cell.read_text().replace("0.70, 0.35", "0.30, 0.35")
  real_cell.write_text(text)
  assert main([*command, "--robot", "ur5e"]) == 2
  assert "in the neutral pose of the policy the tool at" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ROBOTS)
@pytest.mark.parametrize(
  ("keys", "value"), [(["task"], "stack_box"), (["origin"], {"scene_sha256": "0"})]
)
def test_another_scene_is_refused_on_each_robot(
  copied, real_cell, capsys, kind, keys, value
):
  change(copied, *keys, value=value)
  command = ["robot", "run", "--robot", kind, "--policy", str(copied), "--yes"]
  assert main([*command, "--cell", str(real_cell)]) == 2
  task = value if keys == ["task"] else "push_plate"
  shown = capsys.readouterr().err
  assert f"was trained in another scene of {task}" in shown and shown.count("\n") == 1


@pytest.mark.parametrize(
  ("kind", "module", "package"),
  [
    ("ur5e", "rtde_receive", "ur_rtde"),
    ("double", "pyrealsense2", "pyrealsense2"),
  ],
)
def test_a_missing_package_names_the_extra(
  exported, monkeypatch, kind, module, package
):
  monkeypatch.setitem(sys.modules, module, None)
  contract = policy_folder.load(exported).contract
  robot = Robot(kind, contract, cell.Cell())
  opened = devices.open_arm if kind == "ur5e" else devices.open_cameras
  with pytest.raises(DeviceError) as error, opened(robot):
    pass
  assert str(error.value) == f"robot needs {package}: pip install 'apnpql-jax[robot]'"


def test_a_real_arm_does_not_move_unasked(exported, real_cell, capsys, monkeypatch):
  monkeypatch.setattr("apnpql_jax.robot.setup.check_calibration", lambda robot: None)
  command = ["robot", "run", "--robot", "ur5e", "--policy", str(exported)]
  assert main([*command, "--cell", str(real_cell)]) == 2
  assert "a real arm would move; add --yes" in capsys.readouterr().err


def test_the_control_side_imports_no_jax():
  code = (
    "import sys; import apnpql_jax.robot.session;"
    "import apnpql_jax.robot.simulated.devices;"
    "import apnpql_jax.robot.control_process, apnpql_jax.robot.policy_process;"
    "print('jax' in sys.modules)"
  )
  done = subprocess.run(
    [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
  )
  assert done.stdout.strip() == "False"
