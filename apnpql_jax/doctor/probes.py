"""Checks that import JAX and MuJoCo; they run in a process of their own.

A broken driver may end or stop that process, which ``worker`` reports.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import dataclasses
import functools
import os
from pathlib import Path
import shutil
import time
from typing import Any

from apnpql_jax import runtime
from apnpql_jax.config import files
from apnpql_jax.doctor.findings import Finding, checked
from apnpql_jax.errors import ConfigError, UserError

_DEVICES = "devices"
_SELF_TEST = "self-test"
_NVIDIA = Path("/proc/driver/nvidia/gpus")
_REINSTALL = "pip install --force-reinstall"
_EPISODES = 4  # of each expert
_ROWS = 16  # of a bank, a quarter of which is held out

Send = Callable[[list[Finding] | int | None], None]


def run(send: Send, self_test: bool) -> None:
  """Sends the findings of one check at a time, and the free bytes of the device.

  Ends early if JAX or MuJoCo cannot be used.
  """
  for name, check, cure in (
    ("JAX", _devices, f"JAX cannot be used: {_REINSTALL} jax jaxlib"),
    (
      "engine",
      _engine,
      f"MuJoCo cannot be used: {_REINSTALL} mujoco mujoco-mjx",
    ),
  ):
    found = checked(_DEVICES, name, check, cure)
    send(found)
    if any(x.broken for x in found):
      return
  send(_free_bytes())
  if not self_test:
    return
  from apnpql_jax import tasks

  for name in tasks.task_names():
    send(checked(_SELF_TEST, f"expert of {name}", functools.partial(_expert, name)))
  send(checked(_SELF_TEST, "renderer and update", _renderer_and_update))


def has_nvidia_gpu() -> bool:
  """Returns whether the driver of NVIDIA lists a GPU, visible to JAX or not."""
  return _NVIDIA.is_dir() and any(_NVIDIA.iterdir()) or bool(shutil.which("nvidia-smi"))


def _devices() -> Iterator[Finding]:
  try:
    runtime.configure()
    from apnpql_jax import devices

    found = devices.start()
  except UserError as error:
    cure = str(error)
    if isinstance(error, ConfigError):  # Not that of a setting of JAX.
      cure = "unset JAX_PLATFORMS, or run make cuda if it names a GPU"
    yield Finding(_DEVICES, "JAX", str(error), cure, broken=True)
    return
  kinds = ", ".join(f"{x.platform} {x.id} ({x.device_kind})" for x in found)
  cure = ""
  wanted = os.environ.get("JAX_PLATFORMS") or os.environ.get("CUDA_VISIBLE_DEVICES")
  if found[0].platform == "cpu" and wanted is None and has_nvidia_gpu():
    cure = "no GPU build of JAX although an NVIDIA GPU is present: make cuda, or "
    cure += "pip install 'apnpql-jax[cuda]'"
  yield Finding(_DEVICES, "JAX", kinds, cure)


def _free_bytes() -> int | None:
  """Returns the free bytes of the first device; None for a CPU, or if unknown."""
  try:
    import jax

    from apnpql_jax import devices

    on_host = jax.default_backend() == "cpu"
    return None if on_host else devices.available_memory()
  except Exception:  # Reported above.
    return None


def _engine() -> Iterator[Finding]:
  import jax
  import mujoco

  from apnpql_jax import tasks
  from apnpql_jax.sim import engines

  scene = tasks.make_task(tasks.task_names()[0]).scene
  name = engines.make_physics("auto", scene, substeps=1).name
  text = f"{name} ({jax.default_backend()}, MuJoCo {mujoco.__version__})"
  yield Finding(_DEVICES, "engine", text)


def _expert(task: str) -> Iterator[Finding]:
  from apnpql_jax.training.evaluate import evaluate_expert

  env = files.task_env(task)
  env = dataclasses.replace(env, obs="state", backend="native", bank_rows=_ROWS)
  began = time.monotonic()
  figures = evaluate_expert(env, episodes=_EPISODES, seed=0, noise=0.0)
  solved = figures["successes"]
  seconds = time.monotonic() - began
  cure = ""
  if 2 * solved < _EPISODES:
    cure = f"the expert of {task} fails: look at apnpql collect {task} --video e.mp4"
  text = f"{solved} of {_EPISODES} episodes solved, {seconds:.1f} s"
  yield Finding(_SELF_TEST, f"expert of {task}", text, cure)


def _renderer_and_update() -> Iterator[Finding]:
  """Draws both cameras, and makes one update of a small network from the images."""
  import jax
  import jax.numpy as jnp

  from apnpql_jax.agents.learner import make_agent
  from apnpql_jax.envs.env import make_env
  from apnpql_jax.testing import SMALL, random_batch

  began = time.monotonic()
  env_config = files.task_env("push_plate")
  env_config = dataclasses.replace(
    env_config, obs="pixels", backend="native", bank_rows=_ROWS
  )
  env = make_env(env_config)
  seen = env.reset(jnp.arange(_ROWS)).timestep.observation
  images: dict[str, Any] = {"global": seen.global_image, "wrist": seen.wrist_image}
  contrasts = {name: float(jnp.std(x.astype(float))) for name, x in images.items()}
  text = ", ".join(f"{name} {x.shape[1]}x{x.shape[2]}" for name, x in images.items())
  flat = [name for name, contrast in contrasts.items() if contrast < 1.0]
  cure = f"the images of {' and '.join(flat)} are empty; report it" if flat else ""
  text = f"{text}, {time.monotonic() - began:.1f} s"
  yield Finding(_SELF_TEST, "renderer", text, cure)

  began = time.monotonic()
  agent = make_agent(SMALL)
  batch = random_batch(0, batch=_ROWS, pixels=True)
  batch = batch.replace(observation_tm1=seen, observation_t=seen)
  key = jax.random.key(0)
  state = jax.jit(agent.init)(key, seen)
  after, metrics = jax.jit(agent.update)(state, batch, key)
  wrong = _not_finite({"metrics": metrics, "weights": after.params})
  cure = f"an update from pixels gives NaN in {', '.join(wrong)}; report it"
  text = f"loss of Q {float(metrics['loss/q']):.3g}, {time.monotonic() - began:.1f} s"
  yield Finding(_SELF_TEST, "update", text, cure if wrong else "")


def _not_finite(trees: dict[str, Any]) -> list[str]:
  """Returns the names of the trees that hold NaN or infinity."""
  import jax
  import numpy as np

  return [
    name
    for name, tree in trees.items()
    if not all(np.isfinite(x).all() for x in jax.tree.leaves(tree))
  ]
