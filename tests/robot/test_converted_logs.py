"""The log of a simulated robot as demonstrations.

In lockstep: plant, control, cameras and player take turns, so that the plant itself
tells what it was like at each instant.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
from rigs import Rig
from test_policy_player import CONTRACT, PERIOD

from apnpql_jax import testing
from apnpql_jax.cli import main
from apnpql_jax.data import demonstrations, lerobot
from apnpql_jax.data.demonstrations import Demonstrations
from apnpql_jax.data.lerobot import conversion
from apnpql_jax.envs.cameras import camera_renderer
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.errors import FileError
from apnpql_jax.robot.blackboard import Phase
from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.clock import Clock
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.player import Player
from apnpql_jax.robot.recorder import Recorder
from apnpql_jax.robot.simulated import cameras, devices
from apnpql_jax.sim import motors
from apnpql_jax.training import expert

pytest.importorskip("pyarrow")

MOVES, LATE, SOLVED = range(3)
"""Episodes: one up to the time limit, one that drops a period, one that is solved."""

ACTIONS = 10
DROPS = 3
"""Action that takes longer than a period."""

BEGINS = [0, 11, 11 + DROPS + 1, 21]
"""Instants at which demonstrations begin; each episode has one after its actions."""

INSTANTS = 23


@dataclasses.dataclass(frozen=True)
class RigClock(Clock):
  """The time of a rig, which runs while someone sleeps."""

  rig: Any = None

  def now(self) -> float:
    return self.rig.now

  def sleep(self, seconds: float) -> None:
    self.rig.turn()
    self.rig.run(seconds - 0.002)


class Session:
  """Episodes in lockstep; ``seen`` has what the plant was like at each instant."""

  def __init__(self, rig: Rig, folder: Path):
    self.rig, self.seen = rig, []
    plant = rig.plant_board
    robot = Robot("simulated", CONTRACT, Cell(), RigClock(rig=rig), plant.name)
    self._cameras, judge = cameras.make(plant.name, CONTRACT)
    self._operator = devices.Operator(plant, self._until)
    self._rng = np.random.default_rng(0)
    names = judge.environment_names()
    self._recorder = Recorder(folder, CONTRACT, judged=True, environment=names)
    self._player = Player(
      robot,
      rig.board,
      self._cameras,
      self._act,
      judge=judge,
      recorder=self._recorder,
    )

  def play(self, episode: int) -> None:
    rig = self.rig
    self._operator.place_objects()
    rig.go_home(True)
    rig.run_until_done()
    if episode == SOLVED:
      self._put_plate_on_goal()
    rig.order(Phase.PLAY)
    self._until(lambda: rig.state["phase"] == Phase.PLAY, "the episode to begin")
    self._player.play(rig.number, episode)
    self._look(np.zeros(7), self._cameras[0].get_observation().image)
    rig.order(Phase.IDLE)
    rig.run(1.0)

  def close(self) -> None:
    self._recorder.__exit__()
    for camera in self._cameras:
      camera.disconnect()

  def _act(self, seen: dict[str, np.ndarray], episode: int, instant: int) -> np.ndarray:
    action = self._rng.uniform(-0.5, 0.5, 7).astype(np.float32)
    action[6] = action[6] > 0
    self._look(action, seen["global_image"][0])
    if episode == LATE and instant == DROPS:
      self.rig.run(1.2 * PERIOD)
    return action

  def _look(self, action: np.ndarray, image: np.ndarray) -> None:
    data = self.rig.plant.data
    state = data.qpos, data.qvel, data.mocap_pos, data.mocap_quat
    self.seen.append((*(x.copy() for x in state), action, image))

  def _put_plate_on_goal(self) -> None:
    plant = self.rig.plant
    begin = plant.model.joint(plant.model.body("plate").jntadr[0]).qposadr[0]
    pose = np.concatenate([plant.data.mocap_pos[0], plant.data.mocap_quat[0]])
    plant.data.qpos[begin : begin + 7] = pose
    mujoco.mj_forward(plant.model, plant.data)

  def _until(self, condition: Callable[[], bool], what: str) -> None:
    end = self.rig.now + 20
    while not condition():
      assert self.rig.now < end, what
      self.rig.turn()


@dataclasses.dataclass
class Kept:
  """A log, and what its plant was like at each instant."""

  folder: Path
  qpos: np.ndarray
  qvel: np.ndarray
  mocap_pos: np.ndarray
  mocap_quat: np.ndarray
  action: np.ndarray
  images: np.ndarray


@pytest.fixture(scope="module")
def kept(tmp_path_factory) -> Kept:
  folder = tmp_path_factory.mktemp("simulated") / "log"
  with Rig.opened() as rig:
    session = Session(rig, folder)
    for episode in (MOVES, LATE, SOLVED):
      session.play(episode)
    session.close()
  return Kept(folder, *map(np.array, zip(*session.seen, strict=True)))


@pytest.fixture(scope="module")
def env() -> Env:
  return make_env(testing.TINY.env)


@pytest.fixture(scope="module")
def demos(kept, env) -> Demonstrations:
  return conversion.convert(kept.folder, env.task.scene, period_s=PERIOD)


def test_the_states_are_those_of_the_plant(kept, demos):
  """To the last bit of float32, at the moment of each image and after each episode."""
  assert demos.instants == INSTANTS
  for name in ("qpos", "qvel", "mocap_pos", "mocap_quat"):
    expected = getattr(kept, name).astype(np.float32)
    np.testing.assert_array_equal(getattr(demos, name), expected)
  np.testing.assert_array_equal(demos.action[:, :6], kept.action[:, :6])
  np.testing.assert_array_equal(np.flatnonzero(demos.first), BEGINS)


def test_the_images_show_the_states(kept, demos, env):
  """Drawn again from the demonstrations, as training does."""
  view, scene = CONTRACT["cameras"]["global"], env.task.scene
  size = view["height"], view["width"]
  camera = camera_renderer(env.config, scene, "global", size)
  drawn = np.asarray(env.view(camera, demos.states(scene))).astype(int)
  assert abs(drawn - kept.images).max() <= 1
  assert abs(np.diff(drawn, axis=0)).max((1, 2, 3)).min() > 1  # The arm moves.


def test_an_action_leads_to_the_next_state(demos, env):
  """In the engine of the training, except where a period was dropped.

  The simulated arm accelerates 30 ms later than that of the training.
  """
  arm, leads = env.task.scene.arm_qpos, ~demos.first[1:]

  def error(shift: int) -> float:
    """Returns the mean error in rad if each action is that of another instant."""
    action = np.roll(demos.action, shift, axis=0)
    after = env.physics.step(demos.states(env.task.scene), action[:, :6], action[:, 6])
    missed = np.asarray(after.qpos)[:-1, arm] - demos.qpos[1:, arm]
    return abs(missed[leads]).mean()

  late = 0.03 * motors.MAX_ACCELERATION * PERIOD
  assert error(0) < late
  assert error(0) < 0.6 * min(error(-1), error(1))


def test_the_command_converts_a_log_and_a_replay_holds_it(
  kept, demos, env, tmp_path, capfd
):
  out = tmp_path / "mine.npz"
  assert main.main(["convert", str(kept.folder), "push_plate", str(out), "--json"]) == 0
  counts = json.loads(capfd.readouterr().out.splitlines()[-1])
  assert (counts["demonstrations"], counts["solved_demonstrations"]) == (4, 1)
  loaded = demonstrations.load(out, env.task, env.config)
  for a, b in zip(loaded, demos, strict=True):
    np.testing.assert_array_equal(a, b)
  whole = dataclasses.replace(
    testing.TINY.replay, expert_steps=INSTANTS * testing.TINY.env.worlds
  )
  config = dataclasses.replace(testing.TINY, replay=whole)
  ring = expert.replay_from_demonstrations(loaded, config, env)
  slots = jax.tree.map(np.asarray, ring.slots)
  # Each column holds the log.
  index = np.broadcast_to(np.arange(INSTANTS)[:, None], slots.action.shape[:2])
  np.testing.assert_array_equal(slots.action, demos.action[index])
  np.testing.assert_array_equal(slots.timestep.terminated, index == INSTANTS - 1)
  np.testing.assert_array_equal(slots.timestep.reward > 0, index == INSTANTS - 1)


def _rewrite(kept: Kept, folder: Path, names: list[str]) -> Path:
  """Copies a log with some numbers of its states, as if a tracker had added them."""
  log = lerobot.read(kept.folder)
  columns = {x: log.names[x] for x in (lerobot.STATE, lerobot.ACTION, lerobot.TIMES)}
  index = [log.names[lerobot.ENVIRONMENT].index(name) for name in names]
  if names:
    columns[lerobot.ENVIRONMENT] = names
  with lerobot.Writer(
    folder, fps=log.fps, vectors=columns, robot_type="arm", judged=False
  ) as writer:
    for episode in log.episodes:
      for i in range(len(episode.time)):
        frame = {name: episode.columns[name][i] for name in columns}
        if names:
          frame[lerobot.ENVIRONMENT] = frame[lerobot.ENVIRONMENT][index]
        writer.add(frame)
      writer.end_episode(episode.task)
  return folder


def test_a_log_of_a_real_arm_needs_poses_and_has_its_own_times(
  kept, demos, env, tmp_path
):
  scene = env.task.scene
  with pytest.raises(FileError, match="has no observation.environment_state"):
    conversion.convert(_rewrite(kept, tmp_path / "bare", []), scene, period_s=PERIOD)
  parts = ("x", "y", "z", "qw", "qx", "qy", "qz")
  poses = [f"{body}.{x}" for body in ("plate", "goal") for x in parts]
  folder = _rewrite(kept, tmp_path / "tracked", poses)
  made = conversion.convert(folder, scene, period_s=PERIOD)
  # The dropped period, whose state was not measured, is there again.
  assert made.instants == INSTANTS + 1
  np.testing.assert_array_equal(np.flatnonzero(made.first), [0, 11, 22])
  found = np.delete(made.qpos, BEGINS[2], axis=0)
  address, _ = scene.free_joint("plate")
  known = [*scene.arm_qpos, *range(address, address + 7)]
  np.testing.assert_allclose(found[:, known], demos.qpos[:, known], atol=1e-5)
