"""Peers do the same work as this project, and sides answer or fail clearly."""

from __future__ import annotations

import json

import jax
import mujoco
from mujoco.mjx._src import scan, solver
import numpy as np
import pytest

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.files import load_preset
from apnpql_jax.sim import mjx_patches
from apnpql_jax.tasks import make_task, task_names
from apnpql_jax.transfer import urdf
from benchmarks.common import noise
from benchmarks.common.mjx_patching import patched
from benchmarks.page import reports
from benchmarks.peers import compare, mujoco_worlds, sides, worlds
from benchmarks.peers.worlds import World

CAMERAS = {"global": (72, 96), "wrist": (36, 64)}


def random_world(model: mujoco.MjModel, rows: int) -> World:
  """Draws joints anywhere, and objects and marks near where they are."""
  rng, data = np.random.default_rng(0), mujoco.MjData(model)
  qpos = np.tile(model.key("neutral").qpos, (rows, 1))
  for joint in range(model.njnt):
    address = model.jnt_qposadr[joint]
    if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
      qpos[:, address : address + 3] += rng.uniform(-0.2, 0.2, (rows, 3))
      quat = rng.normal(size=(rows, 4))
      quat /= np.linalg.norm(quat, axis=1, keepdims=True)
      qpos[:, address + 3 : address + 7] = quat
    else:
      qpos[:, address] = rng.uniform(*model.jnt_range[joint], rows)
  mocap_pos = data.mocap_pos + rng.uniform(-0.2, 0.2, (rows, *data.mocap_pos.shape))
  mocap_quat = np.tile(data.mocap_quat, (rows, 1, 1))
  return World(model, qpos, mocap_pos, mocap_quat, CAMERAS)


@pytest.mark.parametrize("name", task_names())
def test_pybullet_has_every_body_where_mujoco_has_it(name):
  pytest.importorskip("pybullet")
  from benchmarks.peers.pybullet_worlds import BulletEnv

  world = random_world(make_task(name).scene.model, rows=8)
  env, data = BulletEnv(world), mujoco.MjData(world.model)
  for row in range(len(world.qpos)):
    env.reset(row)
    data.qpos[:] = world.qpos[row]
    data.mocap_pos[:], data.mocap_quat[:] = world.mocap_pos[row], world.mocap_quat[row]
    mujoco.mj_kinematics(world.model, data)
    for body in range(world.model.nbody):
      position, rotation = env.pose(body)
      np.testing.assert_allclose(position, data.xpos[body], atol=1e-4)
      np.testing.assert_allclose(rotation.ravel(), data.xmat[body], atol=1e-4)


def test_pybullet_moves_the_arm_as_commanded(task):
  pytest.importorskip("pybullet")
  from benchmarks.peers.pybullet_worlds import BulletEnv

  world = random_world(task.scene.model, rows=1)
  world.qpos[0] = task.scene.keyframe("neutral")
  env = BulletEnv(world)
  env.reset(0)
  velocity = np.array([0.3, -0.2, 0.1, 0.2, -0.3, 0.4])
  for _ in range(3):
    seen = env.step(np.append(velocity, 1.0), images=True)
  moved = seen["robot"][:6] - world.qpos[0, task.scene.arm_qpos]
  np.testing.assert_allclose(moved, 3 * 0.15 * velocity, atol=0.01)
  for name, size in CAMERAS.items():
    assert seen[name].shape == (*size, 3) and seen[name].std() > 1.0


def test_mujoco_peer_is_the_native_engine(task, engines, resets):
  """Its own control law, and float64 where the engine's state is float32."""
  rows = len(resets.qpos)
  world = World(
    task.scene.model,
    *map(np.asarray, (resets.qpos, resets.mocap_pos)),
    np.asarray(resets.mocap_quat),
    CAMERAS,
  )
  rng, state = np.random.default_rng(1), resets
  envs = [mujoco_worlds.MujocoEnv(world) for _ in range(rows)]
  for row, env in enumerate(envs):
    env.reset(row)
  for _ in range(5):
    action = rng.uniform(-1.0, 1.0, (rows, 7))
    action[:, 6] = rng.integers(2, size=rows)
    state = engines["native"](
      state, *map(jax.numpy.float32, (action[:, :6], action[:, 6]))
    )
    for env, command in zip(envs, action, strict=True):
      env.step(command, images=False)
  found = np.stack([env.data.qpos for env in envs])
  np.testing.assert_allclose(found, state.qpos, atol=1e-3)


def test_stock_mjx_is_stock_while_it_is_traced():
  mjx_patches.patch_mjx()
  ours = scan.body_tree, solver._update_gradient
  stock = mjx_patches._stock_body_tree, mjx_patches._stock_update_gradient
  with patched(barrier=False, cones=False):
    assert (scan.body_tree, solver._update_gradient) == stock
  assert (scan.body_tree, solver._update_gradient) == ours != stock


def test_urdf_refuses_what_it_cannot_express():
  model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><geom size='0.1'/><joint type='slide'/>"
    "<body><geom size='0.1'/><joint type='slide'/></body></body></worldbody></mujoco>"
  )
  with pytest.raises(ValueError, match="body 2"):
    urdf.write(model, 1)


@pytest.fixture
def settings(tmp_path) -> dict:
  """Returns the settings of a side with MuJoCo's worlds."""
  worlds.export("push_plate", CAMERAS, tmp_path)
  return {"folder": str(tmp_path), "gymnasium": False}


def test_a_side_adds_up_its_processes_and_names_errors(settings):
  with sides.Side("mujoco_worlds", settings, count=2, limit_s=120) as side:
    assert side.rate("physics", 0.2) > 0
    with pytest.raises(sides.SideFailed, match="KeyError: 'nothing'"):
      side.rate("nothing", 0.2)
    assert side.rate("physics", 0.2) > 0


def test_a_side_that_cannot_start_or_is_late_fails(settings):
  with pytest.raises(sides.SideFailed, match="No module named 'benchmarks.peers.no'"):
    sides.Side("no", settings, limit_s=60)
  with pytest.raises(sides.SideFailed, match="no answer within 0 s"):
    sides.Side("mujoco_worlds", settings, limit_s=0.05)


@pytest.mark.slow
def test_ratios_are_reported_or_why_there_are_none(capsys):
  compare.main(["--quick", "--json", "--peers", "mujoco", "gymnasium"])
  report = json.loads(capsys.readouterr().out)
  physics = next(
    r for r in report["results"] if r.get("rate") == compare.RATES["physics"]
  )
  (ours,), (theirs,) = physics["ours_per_s"], physics["theirs_per_s"]
  assert physics["ratio"] == pytest.approx(ours / theirs) and ours > 0
  for result in report["results"]:
    assert ("missing" in result) != ("ratio" in result)
  assert physics["peer"] in reports.block(report)


def test_torch_learns_with_networks_of_the_same_size():
  torch = pytest.importorskip("torch")
  from benchmarks.peers import torch_learner

  config = load_preset("push_plate")
  agent, example = make_agent(config.agent), noise.transitions(config).observation_tm1
  params = jax.eval_shape(agent.init, jax.random.key(0), example).params
  learner = torch_learner.Learner(config.agent, "cpu", compiled=False)
  count = sum(x.size for x in jax.tree.leaves(params))
  assert sum(x.numel() for x in learner.online.parameters()) == count
  batch = torch_learner.random_batch(4, "cpu")
  losses = [learner.update(batch) for _ in range(10)]
  assert np.isfinite(losses).all() and losses[-1] < losses[0]
  assert all(torch.isfinite(x).all() for x in learner.target.parameters())
