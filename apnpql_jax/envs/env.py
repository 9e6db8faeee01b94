"""A batch of worlds of one task: reset, step, observe.

All functions are pure over ``EnvState`` and can run inside jit; the world axis comes
first. A step from a terminal instant ignores the action and resets that world to a
random row of the bank, so that terminal observations reach the replay. A non-finite
world is reset in the same way, and counted.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Bool, Float, Int, PRNGKeyArray, UInt8

from apnpql_jax import devices
from apnpql_jax.config.checks import check_env
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.cameras import Renderer, make_cameras
from apnpql_jax.envs.state import Arrival, EnvState, where_world
from apnpql_jax.envs.static_targets import with_static_targets
from apnpql_jax.errors import ConfigError
from apnpql_jax.primitives import reset_bank, tracking
from apnpql_jax.primitives.reset_bank import ResetBank
from apnpql_jax.randomization.randomize import make_randomize
from apnpql_jax.sim import arm, engines, physics
from apnpql_jax.sim.kinematics import Kinematics, make_kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.sim.scene import Scene
from apnpql_jax.tasks import Task, make_task, task_names
from apnpql_jax.types import (
  ACTION_DIM,
  ARM_DOF,
  NUM_PRIMITIVES,
  Array,
  Observation,
  TimeStep,
)

HISTORY = 3  # robot states stacked in an observation (paper Sec. V-A)
HELD_OUT_SHARE = 0.25  # share of the bank's rows that is reserved for evaluation


class Env:
  """The worlds of one task. Holds only constants; the state is an ``EnvState``.

  ``reset`` and ``step`` consist of two halves each:

      reset:  rows ------- begin ----> Arrival -- observe --> EnvState
      step:   EnvState -- advance ---> Arrival -- observe --> EnvState

  ``observe`` is most of a compiled program. A loop that carries an ``Arrival`` and
  begins with ``observe`` contains it only once. ``Arrival.after`` prepares states from
  elsewhere for ``observe``.
  """

  def __init__(
    self,
    config: EnvConfig,
    task: Task,
    bank: ResetBank,
    mesh: Mesh | None = None,
    *,
    lstm_instants: int = 0,
    label_expert: bool = False,
  ):
    """Builds the engine and the cameras; see ``make_env``."""
    scene = task.scene
    self.config, self.task, self.mesh = config, task, mesh
    substeps = _substeps(config, scene)
    self.physics = engines.make_physics(config.backend, scene, substeps=substeps)
    self._bank, self._lstm_instants = bank, lstm_instants
    self._label_expert = label_expert
    self._chain = arm.make_chain(scene)
    self._kinematics = make_kinematics(scene)
    self._cameras = make_cameras(config, scene) if config.obs == "pixels" else ()
    # Traced once per number of worlds; compiled when called outside jit.
    self.begin, self.advance = jax.jit(self.begin), jax.jit(self.advance)
    self._observe = devices.per_device(jax.jit(self._judge_and_observe), mesh)
    self._randomize = (
      make_randomize(config.randomization, scene) if config.randomize else None
    )

  def on_one_device(self) -> Env:
    """Returns the same worlds without a mesh, for evaluations and videos."""
    if self.mesh is None:
      return self
    parts = self.config, self.task, self._bank
    return Env(
      *parts, lstm_instants=self._lstm_instants, label_expert=self._label_expert
    )

  @property
  def bank_split(self) -> int:
    """The first of the bank's rows that are held out for evaluation."""
    return int(self._bank.rows * (1 - HELD_OUT_SHARE))

  @property
  def held_out(self) -> int:
    """Number of held-out rows."""
    return self._bank.rows - self.bank_split

  def reset(
    self, rows: Int[Array, " worlds"], keys: PRNGKeyArray | None = None
  ) -> EnvState:
    """Starts one world per bank row; see ``begin``."""
    return self.observe(self.begin(rows, keys))

  def step(
    self, state: EnvState, action: Float[Array, "worlds 7"], key: PRNGKeyArray
  ) -> EnvState:
    """Runs one control period in every world; see ``advance``."""
    return self.observe(self.advance(state, action, key))

  def begin(
    self, rows: Int[Array, " worlds"], keys: PRNGKeyArray | None = None
  ) -> Arrival:
    """Starts one world per bank row: first half of ``reset``.

    A key per world draws its randomization. Without keys, that of a row never changes.
    """
    count = rows.shape[0]
    first = Arrival(
      physics=self._initial(rows, keys),
      targets=self._bank.targets[rows],
      elapsed=jnp.zeros(count, jnp.int32),
      fresh=jnp.ones(count, bool),
      history=jnp.zeros((count, HISTORY * 7)),
      faults=jnp.zeros(count, jnp.int32),
      recent=None,
    )
    if not self._lstm_instants:
      return first
    # Only shapes matter: ``observe`` overwrites the values where an episode begins.
    shapes = jax.eval_shape(self._observe, first).timestep.observation
    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return first.replace(recent=jax.tree.map(self._repeated, empty))

  def advance(
    self, state: EnvState, action: Float[Array, "worlds 7"], key: PRNGKeyArray
  ) -> Arrival:
    """Runs the physics of one control period: first half of ``step``.

    ``action`` is as in ``types.ACTION_DIM``; ``key`` draws the bank rows of resets.
    """
    count = action.shape[0]
    rows = jax.random.randint(key, (count,), 0, self.bank_split)
    # Drawing the rows splits the key in two; ``fold_in`` with 0 or 1 would repeat it.
    keys = jax.random.split(jax.random.fold_in(key, 2), count)
    return self.advance_or_begin(state, action, rows, keys)

  def advance_or_begin(
    self,
    state: EnvState,
    action: Float[Array, "worlds 7"],
    rows: Int[Array, " worlds"],
    keys: PRNGKeyArray | None,
  ) -> Arrival:
    """Runs ``advance`` with given resets: ``rows`` and ``keys`` as in ``begin``."""
    physics_step = devices.per_device(self.physics.step, self.mesh)
    moved = physics_step(state.physics, action[:, :6], action[:, 6])
    # Reset worlds whose episode is over or whose state is broken.
    broken = ~state.timestep.last & ~self._sound(state, action, moved)
    reset = state.timestep.last | broken
    initial = self._initial(rows, keys)
    merged = jax.tree.map(functools.partial(where_world, reset), initial, moved)
    arrival = Arrival.after(state, merged, self._bank.targets[rows], reset)
    return arrival.replace(faults=state.faults + broken)

  def observe(self, arrival: Arrival) -> EnvState:
    """Computes reward, labels, observation: second half of ``reset`` and ``step``."""
    state = self._observe(arrival.replace(recent=None))
    if arrival.recent is None:
      return state

    def push(recent: Array, new: Array) -> Array:
      recent = where_world(arrival.fresh, self._repeated(new), recent)
      return jnp.concatenate([recent[:, 1:], new[:, None]], axis=1)

    recent = jax.tree.map(push, arrival.recent, state.timestep.observation)
    return state.replace(recent=recent)

  def variant(self, rows: Int[Array, " worlds"]) -> Int[Array, " worlds"]:
    """Returns the variants of the scene at rows of the bank."""
    return self._bank.variant[rows]

  def expert_action(self, state: EnvState) -> Float[Array, "worlds 7"]:
    """Returns the actions of the task's scripted expert."""
    kinematics = self._kinematics(state.physics)
    return self.task.expert(state.physics, kinematics, self.moving_primitives(state))

  def moving_primitives(self, state: EnvState) -> Float[Array, "worlds 3 7"]:
    """Returns the primitives that follow the scene, even with static targets."""
    if not self.config.static_targets:
      return state.timestep.primitives
    kinematics = self._kinematics(state.physics)
    return self._tracked(state.physics, kinematics, state.targets)[1]

  def view(
    self, renderer: Renderer, state: PhysicsState
  ) -> UInt8[Array, "worlds H W 3"]:
    """Renders the worlds through another camera, for videos."""
    return renderer(self.poses(state))

  def poses(self, state: PhysicsState) -> Kinematics:
    """Returns the poses of geoms, sites and cameras in the world."""
    return self._kinematics(state)

  def _repeated(self, x: Array) -> Array:
    """Repeats L times, [worlds, ...] -> [worlds, L, ...]."""
    return jnp.repeat(x[:, None], self._lstm_instants, axis=1)

  def _initial(self, rows: Array, keys: PRNGKeyArray | None) -> PhysicsState:
    """Returns worlds at rest at rows of the bank, randomized if configured."""
    bank = self._bank
    if keys is None:
      keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(0), rows)
    drawn = bank.qpos, bank.mocap_pos, bank.mocap_quat, bank.variant
    state = physics.initial_state(self.task.scene, *(x[rows] for x in drawn))
    return state if self._randomize is None else self._randomize(state, keys)

  def _sound(
    self, before: EnvState, action: Array, moved: PhysicsState
  ) -> Bool[Array, " worlds"]:
    """Checks that all values are finite and that the engine has not reset the world."""
    leaves = jax.tree.leaves((before.physics, before.targets, action, moved))
    finite = [jnp.isfinite(x).all(tuple(range(1, x.ndim))) for x in leaves]
    # C MuJoCo silently resets a non-finite world, and its clock with it.
    return jnp.stack(finite).all(0) & (moved.time > before.physics.time)

  def _judge_and_observe(self, arrival: Arrival) -> EnvState:
    """Computes all of ``observe`` except the last L observations."""
    state, fresh = arrival.physics, arrival.fresh
    kinematics = self._kinematics(state)
    targets, tracked = self._tracked(state, kinematics, arrival.targets)
    primitives = tracked
    if self.config.static_targets:
      targets, q = arrival.targets, state.qpos[:, None, self.task.scene.arm_qpos]
      velocity = tracking.follow(targets, q)
      primitives = jnp.concatenate([velocity, tracked[..., ARM_DOF:]], axis=-1)
    # An episode cannot end at its first instant.
    solved = self.task.success(state, kinematics) & ~fresh
    late = (arrival.elapsed >= self.config.episode_steps) & ~fresh
    observation = self._observation(state, kinematics, fresh, arrival.history)
    if self.config.true_primitives:
      observation = observation.replace(primitives=primitives)
    timestep = TimeStep(
      observation=observation,
      reward=solved.astype(jnp.float32),
      terminated=solved,
      truncated=late & ~solved,
      primitives=primitives,
      expert=self.task.expert(state, kinematics, tracked)
      if self._label_expert
      else None,
    )
    return EnvState(state, targets, arrival.elapsed, timestep, arrival.faults)

  def _tracked(
    self, state: PhysicsState, kinematics: Kinematics, targets: Array
  ) -> tuple[Array, Array]:
    """Returns joint targets moved to where the tool should be now, and primitives."""
    *pose, close = self.task.tool_targets(state, kinematics)
    q = state.qpos[:, self.task.scene.arm_qpos]
    present = jnp.broadcast_to(q[:, None], targets.shape)
    chain = arm.with_base(self._chain, self.task.scene, state.fields)
    targets = tracking.refine(chain, targets, present, *pose)
    velocity = tracking.follow(targets, q[:, None])
    return targets, jnp.concatenate([velocity, close[..., None]], axis=-1)

  def _observation(
    self, state: PhysicsState, kinematics: Kinematics, fresh: Array, history: Array
  ) -> Observation:
    scene = self.task.scene
    joints = state.qpos[:, jnp.append(scene.arm_qpos, scene.gripper_qpos)]
    stacked = jnp.concatenate([history[:, 7:], joints], axis=-1)
    robot = where_world(fresh, jnp.tile(joints, (1, HISTORY)), stacked)
    tool = kinematics.site_xpos[:, scene.tool_site]
    if "body_pos" in state.fields or "body_quat" in state.fields:
      # The robot's own estimate, which does not include how the table stands.
      tool, _, _ = arm.forward(self._chain, state.qpos[:, scene.arm_qpos])
    observation = Observation(robot=robot, tool=tool)
    if self.config.obs == "state":
      return observation.replace(objects=self.task.objects(state))
    overview, wrist = (camera(kinematics) for camera in self._cameras)
    return observation.replace(global_image=overview, wrist_image=wrist)


def make_env(
  config: EnvConfig,
  mesh: Mesh | None = None,
  *,
  lstm_instants: int = 0,
  label_expert: bool = False,
  bank_seed: int = reset_bank.SEED,
) -> Env:
  """Builds the worlds of ``config.task``, and its reset bank on first use.

  Args:
    config: Settings of the environment.
    mesh: Devices that share the worlds; the default device if None.
    lstm_instants: ``agent.lstm_instants`` of the agent that acts in it: L of
      ``EnvState.recent``.
    label_expert: Whether ``TimeStep.expert`` is wanted.
    bank_seed: Seed of the reset states; training uses the default.

  Raises:
    ConfigError: A setting is invalid, JAX has no device, the scene cannot be simulated
      or drawn, or too few resets are usable.
  """
  check_env(config, tasks=task_names())
  devices.start()
  task = make_task(config.task)
  # Fail on what the scene does not allow before building the bank.
  _substeps(config, task.scene)
  if config.obs == "pixels":
    make_cameras(config, task.scene)
  if config.randomize:
    make_randomize(config.randomization, task.scene)
  bank, _ = reset_bank.load_bank(task, config.bank_rows, seed=bank_seed)
  if config.static_targets:
    tracked = dict(static_targets=False, obs="state", randomize=False)
    plain = Env(dataclasses.replace(config, **tracked), task, bank)
    bank = with_static_targets(bank, plain)
  return Env(
    config, task, bank, mesh, lstm_instants=lstm_instants, label_expert=label_expert
  )


def observation_shapes(
  config: EnvConfig, task: Task, *, lstm_instants: int
) -> Observation:
  """Returns ``EnvState.observation`` of one world as shapes, without building worlds.

  ``lstm_instants`` is L of ``EnvState.recent``.
  """
  recent = (lstm_instants,) if lstm_instants else ()

  def shapes(*shape: int, dtype: type = jnp.float32) -> Any:
    return jax.ShapeDtypeStruct((1, *recent, *shape), dtype)

  observation = Observation(robot=shapes(HISTORY * 7), tool=shapes(3))
  if config.true_primitives:
    primitives = shapes(NUM_PRIMITIVES, ACTION_DIM)
    observation = observation.replace(primitives=primitives)
  if config.obs == "state":
    model = task.scene.model
    start = functools.partial(physics.initial_state, task.scene)
    state = jax.eval_shape(
      start,
      *(
        jnp.zeros((1, *x)) for x in ((model.nq,), (model.nmocap, 3), (model.nmocap, 4))
      ),
      jnp.zeros(1, jnp.int32),
    )
    points = jax.eval_shape(task.objects, state)
    return observation.replace(objects=shapes(*points.shape[1:]))
  sizes = config.global_size, config.wrist_size
  overview, wrist = (shapes(*size, 3, dtype=jnp.uint8) for size in sizes)
  return observation.replace(global_image=overview, wrist_image=wrist)


def _substeps(config: EnvConfig, scene: Scene) -> int:
  """Returns the number of physics steps per control period."""
  timestep = scene.model.opt.timestep
  substeps = round(config.control_period_s / timestep)
  if substeps < 1 or abs(substeps * timestep - config.control_period_s) > 1e-9:
    raise ConfigError(
      f"env.control_period_s={config.control_period_s} must be a multiple of the "
      f"scene's timestep, {timestep} s"
    )
  return substeps
