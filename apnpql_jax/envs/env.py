"""A batch of worlds of one task: reset, step, observe, start again.

All functions are pure over ``EnvState`` and run inside jit; the world axis comes
first. A step taken from a terminal instant resets that world to a random row of the
bank and ignores the action, so terminal observations reach the replay. A world whose
state is no longer finite starts again in the same way, and is counted.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from apnpql_jax import devices
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.cameras import Renderer, make_cameras
from apnpql_jax.envs.state import Arrival, EnvState
from apnpql_jax.errors import ConfigError
from apnpql_jax.primitives import tracking
from apnpql_jax.primitives.reset_bank import ResetBank, load_bank
from apnpql_jax.randomization.randomize import make_randomize
from apnpql_jax.sim import arm, engines, physics
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.sim.scene import Scene
from apnpql_jax.tasks import Task, make_task
from apnpql_jax.types import Array, Observation, TimeStep

HISTORY = 3
"""Robot states stacked (paper Sec. V-A)."""

HELD_OUT_SHARE = 0.25
"""Share of the bank's rows that only evaluation sees."""


class Env:
  """The worlds of one task; holds constants only.

  A step is ``arrive(advance(state, ...))`` and a reset ``arrive(begin(rows))``. What
  they share is most of a program, and a loop that begins with it has it once.
  """

  def __init__(
    self,
    config: EnvConfig,
    task: Task,
    bank: ResetBank,
    mesh: Mesh | None = None,
    *,
    instants: int = 0,
  ):
    """
    Args:
      config: sizes, limits, backend and what is observed.
      task: the task.
      bank: its reset states.
      mesh: the devices between which the worlds are split; one device if None.
      instants: L of ``EnvState.seen``; 0 for the present observation alone.
    """
    scene = task.scene
    substeps = _substeps(config, scene)
    self.config = config
    self.task = task
    self.mesh = mesh
    self.physics = engines.make_physics(config.backend, scene, substeps=substeps)
    self._bank = bank
    self._instants = instants
    self._chain = arm.make_chain(scene)
    self._kinematics = make_kinematics(scene)
    self._cameras = make_cameras(config, scene)
    # Traced once for each number of worlds; called outside jit, they are compiled.
    self._arrive = devices.per_device(jax.jit(self._judge_and_observe), mesh)
    self._reset = jax.jit(lambda rows: self.arrive(self.begin(rows)))
    self._randomize = None
    if config.randomize:
      self._randomize = make_randomize(config.randomization, scene)

  def on_one_device(self) -> Env:
    """The same worlds without a mesh, for evaluations and videos."""
    if self.mesh is None:
      return self
    return Env(self.config, self.task, self._bank, instants=self._instants)

  @property
  def bank_split(self) -> int:
    """Rows from here on are held out for evaluation."""
    return int(self._bank.rows * (1 - HELD_OUT_SHARE))

  @property
  def held_out(self) -> int:
    """Number of held-out rows."""
    return self._bank.rows - self.bank_split

  def reset(self, rows: Array) -> EnvState:
    """Starts one world per bank row; a row always has the same randomization.

    Args:
      rows: i32[worlds].
    """
    return self._reset(rows)

  def step(self, state: EnvState, action: Array, key: Array) -> EnvState:
    """One control period in every world; arguments are those of ``advance``."""
    return self.arrive(self.advance(state, action, key))

  def begin(self, rows: Array) -> Arrival:
    """The first instants of one world per bank row.

    Args:
      rows: i32[worlds].

    Returns:
      [worlds, ...]; ``arrive`` makes of it what ``reset`` returns.
    """
    count = rows.shape[0]
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(0), rows)
    first = Arrival(
      physics=self._initial(rows, keys),
      targets=self._bank.targets[rows],
      elapsed=jnp.zeros(count, jnp.int32),
      fresh=jnp.ones(count, bool),
      history=jnp.zeros((count, HISTORY * 7)),
      faults=jnp.zeros(count, jnp.int32),
      recent=None,
    )
    if not self._instants:
      return first
    # Only shapes matter: where an episode begins, ``arrive`` repeats what is seen.
    seen = jax.eval_shape(self._arrive, first).timestep.observation
    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), seen)
    return first.replace(recent=jax.tree.map(self._repeated, empty))

  def advance(self, state: EnvState, action: Array, key: Array) -> Arrival:
    """Where a control period leads every world.

    Args:
      state: [worlds, ...].
      action: f32[worlds, 7], see ``types.ACTION_DIM``.
      key: draws the rows of worlds that start again.

    Returns:
      [worlds, ...]; ``arrive`` makes of it what ``step`` returns.
    """
    physics_step = devices.per_device(self.physics.step, self.mesh)
    moved = physics_step(state.physics, action[:, :6], action[:, 6])
    broken = ~state.timestep.last & ~self._sound(state, action, moved)
    reset = state.timestep.last | broken
    rows = jax.random.randint(key, reset.shape, 0, self.bank_split)
    keys = jax.random.split(jax.random.fold_in(key, 1), len(rows))
    initial = self._initial(rows, keys)
    merged = jax.tree.map(functools.partial(_where, reset), initial, moved)
    arrival = self.after(state, merged, self._bank.targets[rows], reset)
    return arrival.replace(faults=state.faults + broken)

  def after(
    self, before: EnvState, now: PhysicsState, targets: Array, fresh: Array
  ) -> Arrival:
    """The instant that follows on ``before`` when the worlds are as ``now``.

    Args:
      before: [worlds, ...].
      now: [worlds, ...].
      targets: f32[worlds, 3, 6], joint targets of episodes that begin, rad.
      fresh: bool[worlds], where they do.
    """
    return Arrival(
      physics=now,
      targets=_where(fresh, targets, before.targets),
      elapsed=jnp.where(fresh, 0, before.elapsed + 1),
      fresh=fresh,
      history=before.timestep.observation.robot,
      faults=before.faults,
      recent=before.recent,
    )

  def arrive(self, arrival: Arrival) -> EnvState:
    """Judges, labels and observes the instant that [worlds, ...] have come to."""
    state = self._arrive(arrival.replace(recent=None))
    if arrival.recent is None:
      return state

    def push(recent: Array, new: Array) -> Array:
      recent = _where(arrival.fresh, self._repeated(new), recent)
      return jnp.concatenate([recent[:, 1:], new[:, None]], axis=1)

    recent = jax.tree.map(push, arrival.recent, state.timestep.observation)
    return state.replace(recent=recent)

  def tool_targets(self, state: PhysicsState) -> tuple[Array, Array, Array]:
    """See ``Task.tool_targets``."""
    return self.task.tool_targets(state, self._kinematics(state))

  def variant(self, rows: Array) -> Array:
    """i32[worlds]: of the scene, at rows of the bank."""
    return self._bank.variant[rows]

  def expert_action(self, state: EnvState) -> Array:
    """f32[worlds, 7]: what the task's scripted expert does now."""
    kinematics = self._kinematics(state.physics)
    return self.task.expert(state.physics, kinematics, state.timestep.primitives)

  def view(self, renderer: Renderer, state: PhysicsState) -> Array:
    """u8[worlds, H, W, 3]: another look at the worlds, for videos."""
    return renderer(self._kinematics(state))

  def randomized(self, state: PhysicsState, keys: Array) -> PhysicsState:
    """States at rest in worlds of their own, if the configuration asks for that.

    Args:
      state: [worlds, ...].
      keys: [worlds], typed PRNG keys.
    """
    return state if self._randomize is None else self._randomize(state, keys)

  def _repeated(self, x: Array) -> Array:
    """[worlds, ...] -> [worlds, L, ...]."""
    return jnp.repeat(x[:, None], self._instants, axis=1)

  def _initial(self, rows: Array, keys: Array) -> PhysicsState:
    bank = self._bank
    state = physics.initial_state(
      self.task.scene,
      bank.qpos[rows],
      bank.mocap_pos[rows],
      bank.mocap_quat[rows],
      bank.variant[rows],
    )
    return self.randomized(state, keys)

  def _sound(self, before: EnvState, action: Array, moved: PhysicsState) -> Array:
    """bool[worlds]: everything is finite, and the engine has not started over.

    C MuJoCo puts a world that is not finite back to its default pose without a word;
    its clock then shows less than before.
    """
    seen = jax.tree.leaves((before.physics, before.targets, action, moved))
    finite = [jnp.isfinite(x).all(tuple(range(1, x.ndim))) for x in seen]
    return jnp.stack(finite).all(0) & (moved.time > before.physics.time)

  def _judge_and_observe(self, arrival: Arrival) -> EnvState:
    """All of ``arrive`` but the last L observations."""
    state, fresh = arrival.physics, arrival.fresh
    kinematics = self._kinematics(state)
    *pose, close = self.task.tool_targets(state, kinematics)
    q = state.qpos[:, self.task.scene.arm_qpos]
    present = jnp.broadcast_to(q[:, None], arrival.targets.shape)
    chain = arm.with_base(self._chain, self.task.scene, state.fields)
    targets = tracking.refine(chain, arrival.targets, present, *pose)
    solved = self.task.success(state, kinematics) & ~fresh
    late = (arrival.elapsed >= self.config.episode_steps) & ~fresh
    timestep = TimeStep(
      observation=self._observe(state, kinematics, fresh, arrival.history),
      reward=solved.astype(jnp.float32),
      terminated=solved,
      truncated=late & ~solved,
      primitives=jnp.concatenate(
        [tracking.follow(targets, q[:, None]), close[..., None]], axis=-1
      ),
    )
    return EnvState(state, targets, arrival.elapsed, timestep, arrival.faults)

  def _observe(self, state, kinematics, fresh, history) -> Observation:
    scene = self.task.scene
    joints = state.qpos[:, jnp.append(scene.arm_qpos, scene.gripper_qpos)]
    stacked = jnp.concatenate([history[:, 7:], joints], axis=-1)
    robot = _where(fresh, jnp.tile(joints, (1, HISTORY)), stacked)
    tool = kinematics.site_xpos[:, scene.tool_site]
    if "body_pos" in state.fields or "body_quat" in state.fields:
      # What the robot reports: it does not know how the table stands.
      tool, _, _ = arm.forward(self._chain, state.qpos[:, scene.arm_qpos])
    seen = Observation(robot=robot, tool=tool)
    if self.config.obs == "state":
      return seen.replace(objects=self.task.objects(state))
    overview, wrist = (camera(kinematics) for camera in self._cameras)
    return seen.replace(global_image=overview, wrist_image=wrist)


def make_env(config: EnvConfig, mesh: Mesh | None = None, *, instants: int = 0) -> Env:
  """The worlds of ``config.task``; builds the reset bank on first use.

  Args:
    config: see ``Env``.
    mesh: see ``Env``.
    instants: see ``Env``; ``agent.lstm_instants`` of the agent that acts there.

  Raises:
    ConfigError: unknown task or backend, a scene that cannot be simulated or drawn, a
      control period that is not made of whole steps, or no resets within reach.
  """
  task = make_task(config.task)
  # What cannot be drawn is refused before the bank is built.
  make_cameras(config, task.scene)
  bank, _ = load_bank(task, config.bank_rows)
  return Env(config, task, bank, mesh, instants=instants)


def _substeps(config: EnvConfig, scene: Scene) -> int:
  """Physics steps per control period."""
  timestep = scene.model.opt.timestep
  substeps = round(config.control_period_s / timestep)
  if substeps < 1 or abs(substeps * timestep - config.control_period_s) > 1e-9:
    raise ConfigError(
      f"env.control_period_s={config.control_period_s} must be a multiple of the "
      f"scene's timestep, {timestep} s"
    )
  return substeps


def _where(condition: Array, yes: Array, no: Array) -> Array:
  """``jnp.where`` with a condition over the world axis only."""
  shape = condition.shape + (1,) * (yes.ndim - condition.ndim)
  return jnp.where(condition.reshape(shape), yes, no)
