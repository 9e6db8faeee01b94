"""Exported policies: the same bits without the package, a contract, clear refusals."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from render_oracles import cast_rays
from scipy.spatial.transform import Rotation

from apnpql_jax import testing
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.cli.main import main
from apnpql_jax.config.files import mjcf_path
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.deploy import contract, program
from apnpql_jax.deploy.export import export
from apnpql_jax.envs.env import observation_shapes
from apnpql_jax.errors import FileError, UserError
from apnpql_jax.sim.names import FLANGE_SITE
from apnpql_jax.sim.scene import load_scene
from apnpql_jax.tasks import make_task
from apnpql_jax.training.train import train
from apnpql_jax.types import Observation

COUNT = 100

ALONE = """
import sys
for name in ("apnpql_jax", "mujoco", "flax", "distrax", "optax"):
  sys.modules[name] = None  # Importing it fails.
import jax
from jax import export
import numpy as np
program, inputs, outputs = sys.argv[1:]
given = dict(np.load(inputs))
key = given.pop("key")
act = jax.jit(export.deserialize(bytearray(open(program, "rb").read())).call)
actions = [
  np.asarray(act({name: x[i] for name, x in given.items()}, key[i]))
  for i in range(len(key))
]
np.save(outputs, np.stack(actions))
"""


def python(*args: str, cwd: Path) -> str:
  """Returns the output of Python in another folder, without this checkout."""
  env = {k: x for k, x in os.environ.items() if k != "PYTHONPATH"}
  site = Path(np.__file__).parents[1], *map(Path, sys.path)
  env["PYTHONPATH"] = os.pathsep.join(
    str(path) for path in site if (path / "flatbuffers").is_dir()
  )
  done = subprocess.run(
    [sys.executable, *args], cwd=cwd, env=env, capture_output=True, text=True
  )
  assert done.returncode == 0, done.stderr
  return done.stdout


def observations(shapes: dict, count: int) -> dict[str, np.ndarray]:
  """Draws observations [count, 1, ...] by field."""
  rng = np.random.default_rng(0)

  def drawn(x: jax.ShapeDtypeStruct) -> np.ndarray:
    if x.dtype == jnp.uint8:
      return rng.integers(0, 256, (count, *x.shape)).astype(np.uint8)
    return rng.normal(size=(count, *x.shape)).astype(np.float32)

  return {name: drawn(x) for name, x in shapes.items()}


@pytest.mark.parametrize(
  ("acting", "settings", "needs_key"),
  [
    ("mean", {"candidate_precision": "bfloat16"}, False),
    ("policy", {"global_features": "both", "wrist_features": "keypoints"}, True),
    ("mean", {"lstm_instants": 2}, False),
    ("mean", {"algorithm": "ap_cem"}, True),
  ],
  ids=["bfloat16", "keypoints", "lstm", "cem"],
)
def test_same_bits_in_a_process_without_the_package(
  acting, settings, needs_key, tmp_path
):
  config = dataclasses.replace(testing.SMALL, **settings)
  agent, task = make_agent(config), make_task("push_plate")
  instants = config.lstm_instants
  seen = observation_shapes(EnvConfig(), task, lstm_instants=instants)
  params = agent.init(jax.random.key(1), zeros(seen)).params
  shapes = seen.present()
  made = program.export(program.make_act(agent, params, acting=acting), shapes)
  assert made.needs_key == needs_key

  given = observations(shapes, COUNT)
  keys = jax.random.split(jax.random.key(2), COUNT)
  inputs, outputs = tmp_path / "in.npz", tmp_path / "out.npy"
  arrays: dict[str, Any] = {"key": np.asarray(jax.random.key_data(keys)), **given}
  np.savez(inputs, **arrays)
  (tmp_path / "policy.bin").write_bytes(made.data)
  python("-c", ALONE, "policy.bin", inputs.name, outputs.name, cwd=tmp_path)

  act = jax.jit(lambda *x: agent.act(*x, acting=acting)[0])
  expected = [
    np.asarray(act(params, Observation(**{k: x[i] for k, x in given.items()}), keys[i]))
    for i in range(COUNT)
  ]
  np.testing.assert_array_equal(np.load(outputs), np.stack(expected))
  assert len(np.unique(np.stack(expected), axis=0)) == COUNT


def zeros(shapes: Observation) -> Observation:
  return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory) -> Path:
  """Returns the folder of a short run."""
  folder = tmp_path_factory.mktemp("runs") / "run"
  replay = dataclasses.replace(testing.TINY.replay, expert_steps=0, expert_share=0.0)
  train(
    dataclasses.replace(testing.TINY, total_steps=testing.STEPS, replay=replay), folder
  )
  return folder


def test_folder_holds_what_the_example_needs(run_dir, tmp_path):
  folder = tmp_path / "policy"
  args = ["export", str(run_dir), str(folder), "--acting", "greedy"]
  assert main(args) == 0
  assert {x.name for x in folder.iterdir()} == {
    "policy.bin",
    "contract.json",
    "example.py",
  }
  assert len((folder / "example.py").read_text().splitlines()) == 20
  printed = python(str(folder / "example.py"), cwd=tmp_path)
  action = np.fromstring(printed.strip("[] \n"), sep=" ")
  assert action.shape == (7,) and (np.abs(action) <= 1).all()
  about = json.loads((folder / "contract.json").read_text())
  assert about["acting"] == {"rule": "greedy", "needs_key": True}
  assert about["origin"]["checkpoint_step"] == testing.STEPS
  assert str(testing.ROOT).encode() not in (folder / "policy.bin").read_bytes()
  # The same checkpoint has the same hashes.
  export(run_dir, tmp_path / "again", acting="greedy")
  again = json.loads((tmp_path / "again" / "contract.json").read_text())
  assert again["program"] == about["program"]
  assert again["origin"]["params_sha256"] == about["origin"]["params_sha256"]


def test_only_an_export_is_replaced(run_dir, tmp_path):
  folder = tmp_path / "policy"
  export(run_dir, folder)
  with pytest.raises(FileError, match="policy' exists; replace it with --overwrite"):
    export(run_dir, folder)
  export(run_dir, folder, overwrite=True)
  (folder / "notes.txt").write_text("mine")
  with pytest.raises(FileError, match="not an exported policy"):
    export(run_dir, folder, overwrite=True)
  assert (folder / "notes.txt").read_text() == "mine"


def test_a_program_that_calls_this_process_is_refused():
  def act(observation, key):
    shape = jax.ShapeDtypeStruct((1, 7), jnp.float32)
    return jax.pure_callback(lambda x: np.zeros((1, 7), np.float32), shape, key)

  shapes = {"robot": jax.ShapeDtypeStruct((1, 21), jnp.float32)}
  with pytest.raises(UserError, match="this policy cannot be exported"):
    program.export(act, shapes)


@pytest.mark.parametrize("camera", ["global", "wrist"])
def test_contract_projects_points_to_the_pixels_where_they_are_seen(camera):
  task, config = make_task("stack_box"), EnvConfig(task="stack_box")
  scene = task.scene
  shapes = observation_shapes(config, task, lstm_instants=0).present()
  about = contract.describe(config, scene, shapes, lstm_instants=0)
  data = mujoco.MjData(scene.model)
  data.qpos[:] = scene.keyframe("neutral")
  data.qpos[scene.arm_qpos] += [0.1, 0.2, 0.1, -0.4, 0.1, 0.0]
  mujoco.mj_forward(scene.model, data)

  seen = about["cameras"][camera]
  ids, _, _ = cast_rays(scene.model, data, camera, seen["height"], seen["width"])
  boxes = [scene.id("geom", name) for name in ("yellow", "blue")]
  box = max(boxes, key=lambda i: (ids == i).sum())
  rows, columns = np.nonzero(ids == box)
  assert len(rows) > 10

  if camera == "global":
    position, turn = pose(seen["pose_in_world"])
  else:
    flange = data.site(FLANGE_SITE)
    mat, (position, turn) = flange.xmat.reshape(3, 3), pose(seen["pose_in_flange"])
    position, turn = flange.xpos + mat @ position, mat @ turn
  x, y, z = turn.T @ (data.geom_xpos[box] - position)
  lens = seen["intrinsics_px"]
  column, row = lens["fx"] * x / z + lens["cx"], lens["fy"] * y / z + lens["cy"]
  # The center of what is seen of a box lies near the projection of its center.
  assert abs(column - columns.mean()) < 2.5 and abs(row - rows.mean()) < 2.5


def test_contract_gives_a_camera_on_a_stand_in_the_world():
  def add(spec: mujoco.MjSpec) -> None:
    tripod = spec.worldbody.add_body(pos=[0.0, 1.0, 0.5]).add_body(quat=[1, 1, 0, 0])
    tripod.add_camera(name="side", pos=[0.1, 0.2, 0.3])

  scene = load_scene(mjcf_path("stack_box"), variants=[add])
  data = mujoco.MjData(scene.model)
  mujoco.mj_forward(scene.model, data)
  shown = contract._camera(data, scene, "side", (72, 96))
  position, turn = pose(shown["pose_in_world"])
  np.testing.assert_allclose(position, data.camera("side").xpos, atol=1e-8)
  expected = data.camera("side").xmat.reshape(3, 3) * [1, -1, -1]
  np.testing.assert_allclose(turn, expected, atol=1e-8)


def pose(shown: dict) -> tuple[np.ndarray, np.ndarray]:
  turn = Rotation.from_quat(shown["quaternion_wxyz"], scalar_first=True)
  return np.array(shown["position_m"]), turn.as_matrix()


def test_contract_names_joints_limits_and_tool():
  task, config = make_task("push_plate"), EnvConfig()
  about = contract.describe(config, task.scene, {}, lstm_instants=0)
  assert about["joints"]["state"][:3] == ["shoulder_pan", "shoulder_lift", "elbow"]
  assert about["action"]["order"][-1] == "gripper"
  assert about["control_period_s"] == 0.15 and about["cameras"] == {}
  position, _ = pose(about["frames"]["tool_in_flange"])
  np.testing.assert_allclose(position, [0, 0, 0.1449], atol=1e-9)
  assert json.loads(json.dumps(about)) == about
