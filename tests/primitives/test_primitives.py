"""Action primitives: targets against mink, and following without overshoot."""

from __future__ import annotations

import importlib
import io
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from typing import Any

from hand_made import SLOW_MJX
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.errors import UserError
from apnpql_jax.primitives import ik, reset_bank, tracking
from apnpql_jax.sim import arm, physics
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.sim.scene import load_scene
from apnpql_jax.tasks.stack_box import StackBox
from apnpql_jax.tasks.task import ResetDraw


@pytest.fixture(scope="module")
def small_bank(task, tmp_path_factory):
  """Returns a bank built into an empty cache, and its report; both can be reloaded."""
  with pytest.MonkeyPatch.context() as patch:
    patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
    built = reset_bank.load_bank(task, 48)
    again = reset_bank.load_bank(task, 48)
  jax.tree.map(np.testing.assert_array_equal, built[0], again[0])
  assert built[1] == again[1]
  return built


def test_a_damaged_or_foreign_bank_is_built_again(task, tmp_path, monkeypatch, capfd):
  monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
  os.umask(umask := os.umask(0))
  expected, _ = reset_bank.load_bank(task, 16)
  (path,) = (tmp_path / "apnpql_jax" / "banks").iterdir()
  assert path.stat().st_mode & 0o777 == 0o666 & ~umask  # Others may read it.
  whole = path.read_bytes()
  others, broken = io.BytesIO(), io.BytesIO()
  np.savez(others, report="{}", qpos=np.zeros(16))
  nans = np.full((16, 3, 6), np.nan, np.float32)
  arrays: dict[str, Any] = dict(np.load(io.BytesIO(whole))) | {"targets": nans}
  np.savez(broken, **arrays)
  flipped = bytearray(whole)
  flipped[len(whole) // 2] ^= 1
  damages = b"", b"text", whole[:-100], bytes(flipped), others.getvalue()
  for damage in (*damages, broken.getvalue()):
    path.write_bytes(damage)
    capfd.readouterr()
    bank, _ = reset_bank.load_bank(task, 16)
    jax.tree.map(np.testing.assert_array_equal, bank, expected)
    assert capfd.readouterr().err.count("cannot be used and is built again: ") == 1
  reset_bank.load_bank(task, 16)
  assert capfd.readouterr().err == ""


def test_a_bank_that_cannot_be_kept_costs_one_line(task, tmp_path, monkeypatch, capfd):
  (tmp_path / "apnpql_jax").mkdir()
  (tmp_path / "apnpql_jax" / "banks").write_text("a file")
  monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
  bank, _ = reset_bank.load_bank(task, 16)
  assert bank.rows == 16
  assert capfd.readouterr().err.count("cannot keep the reset bank: ") == 1


def test_bank_targets_reach_their_poses(task, small_bank):
  """Targets of mink reach the poses by the kinematics of the whole scene."""
  rows, report = small_bank
  assert rows.rows == 48
  assert report.max_position_residual < ik.POSITION_TOLERANCE
  assert report.max_rotation_residual < ik.ROTATION_TOLERANCE
  state = _at(task, rows)
  positions, rotations, _ = task.tool_targets(state, make_kinematics(task.scene)(state))
  reached, turned, _ = arm.forward(arm.make_chain(task.scene), rows.targets)
  np.testing.assert_allclose(reached, positions, atol=1e-3)
  angle = np.linalg.norm(arm.rotation_error(turned, rotations), axis=-1)
  assert angle.max() < ik.ROTATION_TOLERANCE


class Careless(StackBox):
  """A task with bad draws: boxes overlap in a third, and a third are out of reach."""

  def sample_resets(self, rng: np.random.Generator, count: int) -> ResetDraw:
    """Draws like ``StackBox``, then spoils two thirds."""
    draw = super().sample_resets(rng, count)
    (yellow, _), (blue, _) = map(self.scene.free_joint, ("yellow", "blue"))
    place = draw.qpos[::3, blue : blue + 3] + [0.02, 0.0, 0.0]
    draw.qpos[::3, yellow : yellow + 3] = place
    draw.qpos[1::3, yellow] += 1.0
    return draw


def test_bank_rejects_overlapping_and_unreachable_draws(capsys):
  """Takes two rounds of 32 draws, each with 10 usable ones."""
  careless = Careless()
  rows, report = reset_bank.build_bank(careless, 16)
  assert (report.drawn, rows.rows) == (64, 16)
  assert (report.rejected_restless, report.rejected_unreachable) == (22, 22)
  boxes = [careless.scene.free_joint(name)[0] for name in ("yellow", "blue")]
  spots = np.stack([rows.qpos[:, address : address + 3] for address in boxes])
  assert (np.linalg.norm(spots[0] - spots[1], axis=-1) > 0.12).all()
  assert (spots[..., 0] < 0.6).all()
  printed = " ".join(capsys.readouterr().err.split())
  assert "64 drawn; rejected: 22 not at rest, 22 out of reach" in printed


@pytest.mark.parametrize("timestep", [0.0025, 0.005])
def test_draws_settle_for_four_control_periods(timestep):
  def edit(spec: mujoco.MjSpec) -> None:
    spec.option.timestep = timestep

  careless = Careless()
  careless.scene = load_scene(careless.scene.path, variants=[edit])
  state, _ = reset_bank._settled(
    careless, np.random.default_rng(0), 3, reset_bank.BankReport()
  )
  np.testing.assert_allclose(state.time, physics.START_TIME + 0.6, rtol=1e-5)


def test_draws_settle_alike_in_parts(task, monkeypatch):
  def settled():
    rng, report = np.random.default_rng(0), reset_bank.BankReport()
    return jax.tree.leaves(reset_bank._settled(task, rng, 10, report)), report.drawn

  whole, drawn = settled()
  monkeypatch.setattr(reset_bank, "SETTLED_AT_ONCE", 4)
  parts, drawn_in_parts = settled()
  assert drawn == drawn_in_parts == 10
  for one, other in zip(whole, parts, strict=True):
    np.testing.assert_array_equal(one, other)


def test_a_base_class_in_another_file_is_part_of_the_banks_name(tmp_path, monkeypatch):
  monkeypatch.syspath_prepend(tmp_path)
  base = tmp_path / "bases.py"
  base.write_text(
    "from apnpql_jax.tasks.stack_box import StackBox\nclass Base(StackBox): pass\n"
  )
  (tmp_path / "mine.py").write_text(
    "import abc, bases\nclass Mine(abc.ABC, bases.Base): pass\n"
  )
  mine = importlib.import_module("mine").Mine()
  name = reset_bank._file_name(mine, 16, 0)
  assert name == reset_bank._file_name(mine, 16, 0)
  base.write_text(base.read_text() + "# Another draw.\n")
  assert name != reset_bank._file_name(mine, 16, 0)


def test_a_file_next_to_the_users_is_part_of_the_banks_name(tmp_path, monkeypatch):
  monkeypatch.syspath_prepend(tmp_path)
  ranges = tmp_path / "ranges.py"
  ranges.write_text("LOW, HIGH = 0.1, 0.2\n")
  (tmp_path / "ranged.py").write_text(
    "import ranges\nfrom apnpql_jax.tasks.stack_box import StackBox\n"
    "class Ranged(StackBox): pass\n"
  )
  (tmp_path / ".#ranged.py").symlink_to("user@host.1")  # Emacs edits the file.
  mine = importlib.import_module("ranged").Ranged()
  name = reset_bank._file_name(mine, 16, 0)
  assert name == reset_bank._file_name(mine, 16, 0)
  ranges.write_text("LOW, HIGH = 0.1, 0.3\n")
  assert name != reset_bank._file_name(mine, 16, 0)


BUILD = """
import multiprocessing, threading, time
from apnpql_jax.primitives.reset_bank import build_bank
from apnpql_jax.runtime import cores
from apnpql_jax.tasks import make_task

def report():
  while len(multiprocessing.active_children()) < min(cores(), 4):
    time.sleep(0.01)
  print(multiprocessing.active_children()[0].pid, flush=True)

threading.Thread(target=report, daemon=True).start()
build_bank(make_task("push_plate"), 128)
"""


def _build() -> tuple[subprocess.Popen[str], int]:
  """Returns a new process that builds a bank, and the pid of one of its workers."""
  command, pipe = [sys.executable, "-c", BUILD], subprocess.PIPE
  process = subprocess.Popen(
    command, stdout=pipe, stderr=pipe, text=True, cwd=testing.ROOT
  )
  assert process.stdout is not None
  return process, int(process.stdout.readline())


@pytest.mark.parametrize("delay", [0.0, 1.5], ids=["starting", "working"])
def test_workers_end_with_a_killed_process(delay):
  process, _ = _build()
  time.sleep(delay)
  process.kill()
  process.communicate(timeout=20)  # Ends with the last process that holds the pipe.


def test_a_killed_worker_ends_the_build_with_one_line():
  process, worker = _build()
  os.kill(worker, signal.SIGKILL)
  _, shown = process.communicate(timeout=60)
  assert process.returncode == 1
  assert "UserError: a worker process for the reset bank died" in shown


def test_a_worker_that_starts_while_the_others_end_ends_too():
  """The pool knows nothing of it, but would wait for it."""
  with pytest.raises(UserError, match="died"), reset_bank._workers() as pool:
    late = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(600,))
    late.start()
    pool.submit(os._exit, 1).result()
  late.join(20)
  assert late.exitcode == -signal.SIGKILL


def test_refinement_agrees_with_mink(task, small_bank):
  """From targets up to 5 cm away, the steps inside jit find mink's solution."""
  rows, _ = small_bank
  chain, solver = arm.make_chain(task.scene), ik.IkSolver()
  target = rows.targets[:, 0]
  position, rotation, _ = arm.forward(chain, target)
  shift = np.random.default_rng(0).uniform(-0.05, 0.05, position.shape)
  moved = position + jnp.asarray(shift, jnp.float32)
  refined = jax.jit(tracking.refine)(chain, target, target, moved, rotation)
  for i in range(16):
    q, residuals = solver.solve(*(np.asarray(x[i]) for x in (target, moved, rotation)))
    assert (residuals < [ik.POSITION_TOLERANCE, ik.ROTATION_TOLERANCE]).all()
    np.testing.assert_allclose(refined[i], q, atol=2e-3)


def test_refinement_starts_from_the_nearer_configuration(task):
  """The distant one is off by more than all steps together, in each joint in turn."""
  chain, rng = arm.make_chain(task.scene), np.random.default_rng(0)
  neutral = task.scene.keyframe("neutral")[task.scene.arm_qpos]
  solution = neutral + rng.uniform(-0.2, 0.2, (12, 6))
  near = solution + rng.uniform(-0.1, 0.1, (12, 6))
  too_far = 1.5 * tracking.REFINE_STEPS * tracking.MAX_REFINEMENT
  distant = solution + too_far * np.tile(np.eye(6), (2, 1))
  last_is_near = np.arange(12)[:, None] < 6
  last = np.where(last_is_near, near, distant)
  present = np.where(last_is_near, distant, near)
  position, rotation, _ = arm.forward(chain, jnp.asarray(solution))
  refined = jax.jit(tracking.refine)(chain, last, present, position, rotation)
  np.testing.assert_allclose(refined, solution, atol=1e-3)


def test_following_scales_all_joints_by_one_factor():
  """The speed is limited far from the target, brakes nearer, and is linear close by."""
  velocity = tracking.follow(jnp.array([2.0, -1.0, 0, 0, 0, 0]), jnp.zeros(6))
  np.testing.assert_allclose(velocity, [1.0, -0.5, 0, 0, 0, 0], rtol=1e-6)
  braking = tracking.follow(jnp.array([0.5, -0.25, 0, 0, 0, 0]), jnp.zeros(6))
  speed = np.sqrt(2 * tracking.BRAKING * 0.5)
  np.testing.assert_allclose(braking[:2], [speed, -speed / 2], rtol=1e-6)
  near = tracking.follow(jnp.full(6, 0.01), jnp.zeros(6))
  np.testing.assert_allclose(near, tracking.GAIN * 0.01, rtol=1e-6)


def test_a_destination_is_where_following_leads():
  rng = np.random.default_rng(0)
  q = jnp.asarray(rng.normal(size=(40, 6)), jnp.float32)
  way = rng.uniform(-1.0, 1.0, (40, 6)) * np.geomspace(0.001, 0.7, 40)[:, None]
  target = q + jnp.asarray(way, jnp.float32)
  found = tracking.destination(tracking.follow(target, q), q)
  np.testing.assert_allclose(found, target, atol=1e-5)
  far = tracking.destination(tracking.follow(q + 3.0, q), q)
  np.testing.assert_allclose(far - q, 1 / (2 * tracking.BRAKING), rtol=1e-4)
  np.testing.assert_array_equal(tracking.destination(0 * q, q), q)


@pytest.mark.parametrize("name", SLOW_MJX)
def test_following_reaches_a_target_without_overshoot(engines, resets, task, name):
  """Start, at rest, and target are random configurations near the workspace."""
  scene, step = task.scene, engines[name]
  worlds = resets.qpos.shape[0]
  rng = np.random.default_rng(5)
  neutral = task.scene.keyframe("neutral")[scene.arm_qpos]
  spread = np.array([0.8, 0.3, 0.4, 0.6, 0.6, 1.2])
  start, target = neutral + rng.uniform(-spread, spread, (2, worlds, 6))
  state = resets.replace(qpos=resets.qpos.at[:, scene.arm_qpos].set(start))
  target, close = jnp.asarray(target, jnp.float32), jnp.ones(worlds)
  side = np.sign(target - start)
  overshoot = 0.0
  for _ in range(50):
    q = state.qpos[:, scene.arm_qpos]
    state = step(state, tracking.follow(target, q), close)
    beyond = side * np.asarray(state.qpos[:, scene.arm_qpos] - target)
    overshoot = max(overshoot, beyond.max())
  assert overshoot < 0.02
  np.testing.assert_allclose(state.qpos[:, scene.arm_qpos], target, atol=0.02)


def _at(task, rows):
  poses = rows.qpos, rows.mocap_pos, rows.mocap_quat
  return physics.initial_state(task.scene, *poses, rows.variant)


def test_a_bank_of_another_seed_holds_other_states(task, tmp_path, monkeypatch):
  monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
  first, _ = reset_bank.load_bank(task, 16)
  other, _ = reset_bank.load_bank(task, 16, seed=1)
  again, _ = reset_bank.load_bank(task, 16, seed=1)
  assert np.array_equal(other.qpos, again.qpos)
  starts = {tuple(row) for row in np.asarray(first.qpos).tolist()}
  assert not starts & {tuple(row) for row in np.asarray(other.qpos).tolist()}
