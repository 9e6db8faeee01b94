"""Control periods per second of plain ``mjx.step`` with and without our patches.

  python -m benchmarks.speed.engines --worlds 1024

Variants of the physics of push_plate: the barrier between bodies, the cones in blocks,
the scene's limit on contacts, and MJX-Warp. "qpos_differs" is the largest difference
from C MuJoCo after the period, in m or rad.
"""

import argparse
from collections.abc import Iterator, Sequence
import functools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

from apnpql_jax.sim.quiet_mjx import mjx
from apnpql_jax.tasks import Task, make_task
from apnpql_jax.tasks.contact_report import SUBSTEPS
from apnpql_jax.types import Array
from benchmarks.common import command, timing
from benchmarks.common.mjx_patching import patched

TASK = "push_plate"
VARIANTS: dict[str, dict[str, Any]] = {
  "barrier and cones": {"barrier": True, "cones": True},
  "barrier": {"barrier": True, "cones": False},
  "cones": {"barrier": False, "cones": True},
  "cones, all contacts": {"barrier": False, "cones": True, "limited": False},
  "stock": {"barrier": False, "cones": False},
  "Warp": {"barrier": False, "cones": False, "impl": "warp"},
}
"""On a CPU the first is in use, on a GPU the third."""


def main() -> None:
  parser = command.parser(__doc__, repeats=3)
  flag = parser.add_argument
  flag("--worlds", type=int, default=32)
  flag("--substeps", type=int, default=SUBSTEPS, help="physics steps per period")
  flag("--variants", nargs="+", choices=VARIANTS, help="default: those fast enough")
  args = command.parse(parser)
  if args.quick:
    args.worlds, args.substeps = 2, 1
  # Without a barrier a period takes minutes on a CPU.
  slow = jax.default_backend() == "cpu"
  fast = [name for name in VARIANTS if VARIANTS[name]["barrier"] or not slow]
  header = {"task": TASK, "worlds": args.worlds, "substeps": args.substeps}
  results = measure_all(args.variants or fast, args)
  command.publish("engines", args, results, **header)


def measure_all(names: Sequence[str], args: argparse.Namespace) -> Iterator[dict]:
  """Yields the figures of every variant, or why it does not run."""
  task = make_task(TASK)
  start = task.sample_resets(np.random.default_rng(0), args.worlds).qpos
  expected = native_period(task.scene.model, start, args.substeps)
  for name in names:
    try:
      ready = prepare(task, start, args.substeps, **VARIANTS[name])
      figures = timing.figures("period", {name: ready}, repeats=args.repeats)[name]
    except Exception as error:  # Warp may be missing or may not support the scene.
      lines = str(error).splitlines() or [""]
      yield {"variant": name, "missing": f"{type(error).__name__}: {lines[0][:200]}"}
      continue
    differs = float(np.abs(np.asarray(ready.run()) - expected).max())
    yield {"variant": name, **figures, "qpos_differs": differs}


def prepare(
  task: Task,
  start: np.ndarray,
  substeps: int,
  impl="jax",
  limited=True,
  **patches: bool,
) -> timing.Ready:
  """Compiles a period of all worlds, from rest at ``start`` to the final qpos.

  ``limited`` is whether the scene's limit on contacts applies; see also ``patched``.
  """
  all_contacts = make_task(TASK).scene.model
  all_contacts.numeric("max_contact_points").data[:] = -1
  sizes = {}
  if impl == "warp":  # It ignores the limit and shares contacts among worlds.
    slots = mjx.make_data(all_contacts, impl="jax")._impl
    sizes = {"naconmax": len(start) * slots.ncon, "njmax": slots.nefc}
  model = task.scene.model if limited else all_contacts
  put, data = mjx.put_model(model, impl=impl), mjx.make_data(model, impl=impl, **sizes)

  def period(qpos: Array) -> Array:
    def step(worlds: Any, _: None) -> tuple[Any, None]:
      # The scan is around the batch, because Warp steps all worlds at once.
      return jax.vmap(mjx.step, in_axes=(None, 0))(put, worlds), None

    worlds = jax.vmap(lambda qpos: data.replace(qpos=qpos))(qpos)
    return jax.lax.scan(step, worlds, None, length=substeps)[0].qpos

  qpos = jnp.asarray(start, jnp.float32)
  with patched(**patches):
    run, compile_s = timing.compiled(jax.jit(period), qpos)
  return timing.Ready(functools.partial(run, qpos), None, len(start), compile_s)


def native_period(model: mujoco.MjModel, qpos: np.ndarray, steps: int) -> np.ndarray:
  """Returns f64[worlds, nq] after some steps of C MuJoCo from rest at ``qpos``."""
  kind, data = mujoco.mjtState.mjSTATE_FULLPHYSICS, mujoco.MjData(model)
  starts = np.empty((len(qpos), mujoco.mj_stateSize(model, kind)))
  for world, start in zip(qpos, starts, strict=True):
    data.qpos[:] = world
    mujoco.mj_getState(model, data, start, kind)
  states, _ = mujoco.rollout.rollout(model, data, starts, nstep=steps)
  return states[:, -1, 1 : 1 + model.nq]  # The time comes first.


if __name__ == "__main__":
  main()
