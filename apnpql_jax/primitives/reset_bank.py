"""Reset states with the joint targets of their primitives, built once per task.

Inside jit a reset only gathers a random row, so random resets cost nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
import concurrent.futures
from concurrent.futures.process import BrokenProcessPool
import contextlib
import dataclasses
import functools
import hashlib
import inspect
import json
import multiprocessing
import operator
import pathlib
import sys
import time
from typing import Any

from flax import struct
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import Progress

from apnpql_jax import tasks
from apnpql_jax.atomic import replacing
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.console import Unfailing, print_line, reporting
from apnpql_jax.errors import ConfigError, UserError, one_line
from apnpql_jax.primitives import ik
from apnpql_jax.runtime import cache_dir, cores, end_with_parent
from apnpql_jax.sim import physics
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.sim.native import NativePhysics
from apnpql_jax.sim.scene import free_joints
from apnpql_jax.tasks.task import Task
from apnpql_jax.types import Array

VERSION = 3  # part of the cache key; increased when the meaning of a bank changes
SEED = 0  # of the banks that training and its evaluations use
CHUNK = 32
MAX_DRAWS = 20  # per row before the task is rejected for lack of usable resets
SETTLE_PERIODS = 4  # default control periods at rest before a draw is accepted
SETTLED_AT_ONCE = 512  # draws; an engine keeps memory for each of its worlds
SETTLE_SPEED = 0.05  # m/s and rad/s; above float32 contact noise (0.04)
SETTLE_SHIFT = 0.005  # m; an object that settles further away overlapped with another
MAX_TRAVEL = 2.5  # rad; a joint that turns further would pass through another branch


class ResetBank(struct.PyTreeNode):
  """Settled initial states and the joint targets of their primitives."""

  qpos: Array  # f32[rows, nq]
  mocap_pos: Array  # f32[rows, nmocap, 3]
  mocap_quat: Array  # f32[rows, nmocap, 4]
  variant: Array  # i32[rows]: variant of the scene
  targets: Array  # f32[rows, 3, 6], rad

  @property
  def rows(self) -> int:
    """Number of reset states."""
    return self.qpos.shape[0]


@dataclasses.dataclass
class BankReport:
  """Statistics of the construction of a bank."""

  drawn: int = 0
  rejected_restless: int = 0  # moved or still moving: objects overlapped
  rejected_unreachable: int = 0
  max_position_residual: float = 0.0  # m, by mink
  max_rotation_residual: float = 0.0  # rad, by mink
  seconds: float = 0.0  # build time

  def __str__(self) -> str:
    return (
      f"{self.drawn:,} drawn; rejected: {self.rejected_restless:,} not at rest, "
      f"{self.rejected_unreachable:,} out of reach; targets within "
      f"{1e3 * self.max_position_residual:.2f} mm and "
      f"{np.degrees(self.max_rotation_residual):.3f} degrees; {self.seconds:.0f} s"
    )


def load_bank(
  task: Task, rows: int, *, seed: int = SEED
) -> tuple[ResetBank, BankReport]:
  """Loads the task's bank from the user's cache; builds it if there is no valid one.

  ``seed`` draws its states. Prints one line if the cached bank cannot be used, or the
  new one cannot be saved.
  """
  cache = cache_dir()
  if cache is None:
    return build_bank(task, rows, seed=seed)
  path = cache / "banks" / _file_name(task, rows, seed)
  try:
    return _read(path, task, rows)
  except FileNotFoundError:
    pass
  except Exception as error:  # Whatever a damaged or foreign file causes.
    print_line(f"{path} cannot be used and is built again: {one_line(error)}")
  bank, report = build_bank(task, rows, seed=seed)
  arrays: dict[str, Any] = jax.tree.map(np.asarray, vars(bank))
  with reporting("keep the reset bank"):
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
      np.savez(part, report=json.dumps(vars(report)), **arrays)
  return bank, report


def _read(path: pathlib.Path, task: Task, rows: int) -> tuple[ResetBank, BankReport]:
  """Reads a bank; raises any exception if the file is not one of this task."""
  with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
    arrays = dict(stored)
  report = BankReport(**json.loads(str(arrays.pop("report"))))
  model = task.scene.model
  kinds = {
    "qpos": (np.float32, (rows, model.nq)),
    "mocap_pos": (np.float32, (rows, model.nmocap, 3)),
    "mocap_quat": (np.float32, (rows, model.nmocap, 4)),
    "variant": (np.int32, (rows,)),
    "targets": (np.float32, (rows, 3, 6)),
  }
  if {name: (x.dtype, x.shape) for name, x in arrays.items()} != kinds:
    raise ValueError("it holds other arrays")
  if not all(np.isfinite(x).all() for x in arrays.values()):
    raise ValueError("a number is not finite")
  return ResetBank(**jax.tree.map(jnp.asarray, arrays)), report


def build_bank(
  task: Task, rows: int, *, seed: int = SEED
) -> tuple[ResetBank, BankReport]:
  """Draws, settles and solves ``rows`` reset states; shows progress on stderr.

  Raises:
    ConfigError: Too many draws were rejected.
    UserError: A worker process died.
  """
  began = time.monotonic()
  rng = np.random.default_rng(seed)
  report = BankReport()
  kept: list[ResetBank] = []
  unfailing: Any = Unfailing(sys.stderr)
  with _workers() as pool, Progress(console=Console(file=unfailing)) as progress:
    bar = progress.add_task(f"reset bank of {task.name}", total=rows)
    while (missing := rows - sum(bank.rows for bank in kept)) > 0:
      progress.update(bar, completed=rows - missing)
      if report.drawn > MAX_DRAWS * rows:
        raise ConfigError(f"task {task.name!r} has too few usable resets: {report}")
      state, variant = _settled(task, rng, max(missing, CHUNK), report)
      if not len(variant):
        continue
      advance = functools.partial(progress.advance, bar)
      solved = _solve_targets(task, state, variant, pool, report, advance)
      kept.append(jax.tree.map(lambda x: x[:missing], solved))
    report.seconds = time.monotonic() - began
    progress.console.print(f"reset bank of {task.name}: {report}", highlight=False)
  return jax.tree.map(lambda *parts: jnp.concatenate(parts), *kept), report


@contextlib.contextmanager
def _workers() -> Generator[concurrent.futures.Executor]:
  """Yields worker processes, one per core; they end together.

  Raises:
    UserError: A worker process died.
  """
  others = set(multiprocessing.active_children())
  # Spawn, because forking a process in which XLA threads run can deadlock.
  context = multiprocessing.get_context("spawn")
  with concurrent.futures.ProcessPoolExecutor(
    cores(), context, end_with_parent
  ) as pool:
    try:
      yield pool
    except BrokenProcessPool:
      # The pool ends its workers, but not one that started in the meantime, and would
      # wait for that one forever.
      for process in set(multiprocessing.active_children()) - others:
        process.kill()
      raise UserError(
        "a worker process for the reset bank died; free some memory, and keep the "
        'guard `if __name__ == "__main__":` in a script'
      ) from None


def _settled(
  task: Task, rng: np.random.Generator, count: int, report: BankReport
) -> tuple[physics.PhysicsState, Array]:
  """Returns drawn states that stay at rest while the arm holds still, and variants."""
  draw = jax.tree.map(jnp.asarray, task.sample_resets(rng, count))
  state = physics.initial_state(task.scene, *draw)
  substeps = round(EnvConfig.control_period_s / task.scene.model.opt.timestep)
  engine = NativePhysics(task.scene, substeps=substeps)
  parts = []
  for start in range(0, count, SETTLED_AT_ONCE):
    chunk = operator.itemgetter(slice(start, start + SETTLED_AT_ONCE))
    part = jax.tree.map(chunk, state)
    closed = (part.qpos[:, task.scene.gripper_qpos] > 0.5).astype(jnp.float32)
    for _ in range(SETTLE_PERIODS):
      part = engine.step(part, jnp.zeros((len(closed), 6)), closed)
    parts.append(part)
  state = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
  restless = np.abs(np.asarray(state.qvel)).max(-1) > SETTLE_SPEED
  model = task.scene.model
  for address in model.jnt_qposadr[free_joints(model)]:
    shift = np.asarray(state.qpos - draw.qpos)[:, address : address + 3]
    restless |= np.linalg.norm(shift, axis=-1) > SETTLE_SHIFT
  report.drawn += count
  report.rejected_restless += int(restless.sum())
  return jax.tree.map(lambda x: x[~restless], (state, draw.variant))


def _solve_targets(
  task: Task,
  state: physics.PhysicsState,
  variant: Array,
  pool: concurrent.futures.Executor,
  report: BankReport,
  advance: Callable[[int], None],
) -> ResetBank:
  kinematics = make_kinematics(task.scene)(state)
  positions, rotations, _ = map(np.asarray, task.tool_targets(state, kinematics))
  starts = np.asarray(state.qpos[:, task.scene.arm_qpos])
  arrays = starts, positions, rotations
  chunks = [np.split(x, range(CHUNK, len(x), CHUNK)) for x in arrays]
  solved = []
  for result in pool.map(ik.solve_all, *chunks):
    solved.append(result)
    advance(len(result[0]))
  targets, residuals = map(np.concatenate, zip(*solved, strict=True))
  reached = (residuals < [ik.POSITION_TOLERANCE, ik.ROTATION_TOLERANCE]).all((1, 2))
  reached &= np.abs(targets - starts[:, None]).max((1, 2)) < MAX_TRAVEL
  report.rejected_unreachable += int((~reached).sum())
  worst = residuals[reached].max((0, 1), initial=0.0)
  report.max_position_residual = max(report.max_position_residual, float(worst[0]))
  report.max_rotation_residual = max(report.max_rotation_residual, float(worst[1]))
  return ResetBank(
    qpos=state.qpos[reached],
    mocap_pos=state.mocap_pos[reached],
    mocap_quat=state.mocap_quat[reached],
    variant=variant[reached],
    targets=jnp.asarray(targets[reached], jnp.float32),
  )


def _file_name(task: Task, rows: int, seed: int) -> str:
  key = json.dumps(
    [VERSION, seed, rows, task.name, task.scene.fingerprint, _source(task)]
  )
  digest = hashlib.sha256(key.encode()).hexdigest()[:16]
  return f"{task.name}-{rows}-{digest}.npz"


def _source(task: Task) -> str:
  """Returns a hash of the files of the task's classes and of those shared by tasks.

  A file of the user's counts with those next to it, from which it may import ranges.
  """
  package = pathlib.Path(tasks.__file__).parent
  shared = [
    path
    for path in sorted(package.glob("*.py"))
    if "\n@register_task\n" not in path.read_text(encoding="utf-8")
  ]
  own = [
    pathlib.Path(inspect.getfile(one))
    for one in type(task).__mro__
    if one.__module__ not in sys.stdlib_module_names
  ]
  folders = {path.parent: None for path in own if package not in path.parents}
  near = [path for folder in folders for path in sorted(folder.glob("*.py"))]
  near = filter(pathlib.Path.is_file, near)  # An editor's lock is a dangling link.
  own = [path for path in own if path not in shared]
  files = dict.fromkeys([*own, *near, *shared])
  contents = (path.read_bytes() for path in files)
  return hashlib.sha256(b"".join(contents)).hexdigest()
