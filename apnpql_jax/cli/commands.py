"""What each command of ``apnpql`` does with its options; returns what is to be shown.

JAX, MuJoCo and everything built on them are imported inside the functions, so that
help and refusals of bad input are instant.
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apnpql_jax.cli.options import (
  Collect,
  Convert,
  Evaluate,
  List,
  Repeat,
  Train,
  parse,
)
from apnpql_jax.config import files
from apnpql_jax.config.checks import BACKENDS, validate
from apnpql_jax.config.schema import EnvConfig, TrainConfig
from apnpql_jax.console import say
from apnpql_jax.errors import ConfigError, check_name
from apnpql_jax.runs import run_folder
from apnpql_jax.training import expert

if TYPE_CHECKING:
  from jax.sharding import Mesh

Json = dict[str, Any]


def train(args: Train, argv: Sequence[str]) -> Json:
  """Validates everything, then trains or goes on training; returns its summary."""
  if args.resume is not None and (args.run is not None or args.overwrite):
    raise ConfigError("--resume names the run itself; leave out --run and --overwrite")
  if not args.preset and args.resume is None:
    names = ", ".join(files.preset_names())
    raise ConfigError(f"train needs a preset; choose from {names}")
  if args.preset:
    base = files.load_preset(args.preset)
  else:
    base = run_folder.load_run_config(args.resume or Path(), say)
  # Parsed a second time, now on top of the settings asked for.
  args = parse(Train, "train", argv, default=Train(config=base))
  config = _with_shortcuts(args)
  run_dir = args.resume or args.run or run_folder.new_run_dir(args.preset)
  if args.resume is None:
    run_folder.check_free(run_dir, overwrite=args.overwrite)
  validate(config)
  if args.resume is not None:
    run_folder.check_resumable(args.resume, config)
  mesh = _mesh(args)
  _check_registered(config, num_devices=mesh.size if mesh else 1)

  from apnpql_jax import devices
  from apnpql_jax.training.train import train as run_training

  summary = run_training(
    config,
    run_dir,
    resume=args.resume is not None,
    overwrite=args.overwrite,
    mesh=mesh,
  )
  return summary if devices.leads() else {}


def evaluate(args: Evaluate, argv: Sequence[str]) -> Json:
  """Plays held-out episodes with a checkpoint of a run."""
  del argv
  if not args.run:
    raise ConfigError("evaluate needs a run folder: apnpql evaluate RUN")
  _check_episodes(args.episodes, args.seed)
  _check_video(args.video)
  if args.backend is not None:
    check_name("backend", args.backend, BACKENDS)
  run_folder.load_run_config(Path(args.run), say)

  from apnpql_jax.training.evaluate import evaluate as evaluate_run

  return evaluate_run(
    Path(args.run),
    episodes=args.episodes,
    seed=args.seed,
    backend=args.backend,
    step=_checkpoint_step(args),
    greedy=args.greedy,
    video=args.video,
  )


def collect(args: Collect, argv: Sequence[str]) -> Json:
  """Plays episodes with the scripted expert of a task."""
  del argv
  _check_episodes(args.episodes, args.seed)
  _check_video(args.video)
  check_name("backend", args.backend, BACKENDS)
  if not 0.0 <= args.noise < float("inf"):
    raise ConfigError(f"--noise {args.noise} must be a number of at least 0, in rad/s")

  from apnpql_jax import tasks

  check_name("task", args.task, tasks.task_names())
  env = EnvConfig(task=args.task)
  if args.task in files.preset_names():
    env = files.load_preset(args.task).env

  from apnpql_jax.training.evaluate import evaluate_expert

  # The expert acts on privileged poses: drawing images would only cost time.
  env = dataclasses.replace(env, task=args.task, backend=args.backend, obs="state")
  settings = {"episodes": args.episodes, "seed": args.seed, "noise": args.noise}
  figures = evaluate_expert(env, video=args.video, **settings)
  if args.save is None:
    return figures

  return figures | expert.save_expert(args.save, env, **settings)


def convert(args: Convert, argv: Sequence[str]) -> Json:
  """Makes demonstrations of recorded joint trajectories."""
  del argv
  if not args.out:
    raise ConfigError(
      "convert needs three names: apnpql convert RECORDING.npz TASK OUT.npz"
    )
  from apnpql_jax import tasks
  from apnpql_jax.data import demonstrations, real_arm

  check_name("task", args.task, tasks.task_names())
  period_s = EnvConfig().control_period_s
  if args.task in files.preset_names():
    period_s = files.load_preset(args.task).env.control_period_s
  scene = tasks.make_task(args.task).scene
  demos = real_arm.convert(Path(args.recording), scene, period_s=period_s)
  return demonstrations.save(
    Path(args.out), demos, task=args.task, control_period_s=period_s
  )


def repeat(args: Repeat, argv: Sequence[str]) -> Json:
  """Names what was not finite in an update that a run stopped for."""
  del argv
  if not args.file:
    raise ConfigError("repeat needs a file: apnpql repeat RUN/faults/step_<n>.npz")
  path = Path(args.file).absolute()
  run_folder.load_run_config(path.parent.parent, say)

  from apnpql_jax.training import faults

  return faults.repeat(path)


def list_names(args: List, argv: Sequence[str]) -> Json:
  """The names that other commands accept, or what the contacts of each task cost."""
  del argv
  from apnpql_jax import tasks
  from apnpql_jax.agents import table_one

  names = tasks.task_names()
  if args.contacts:
    from apnpql_jax.envs.contact_report import contact_report

    return {name: contact_report(tasks.make_task(name)) for name in names}
  return {
    "tasks": names,
    "presets": files.preset_names(),
    "algorithms": list(table_one.ALGORITHMS),
    "backends": list(BACKENDS),
  }


def _mesh(args: Train) -> Mesh | None:
  """The devices to train on; waits for the other processes, if there are any.

  Nothing is written until all have come here, so that all have seen the same run
  folder before.
  """
  if args.coordinator and args.run is None and args.resume is None:
    raise ConfigError("processes of one run must be given the same --run")
  if not args.coordinator and (args.processes, args.process) != (None, None):
    raise ConfigError("--processes and --process need a --coordinator")
  from apnpql_jax import devices

  count = args.devices
  if args.coordinator:
    devices.join(args.coordinator, args.processes, args.process)
    count = 0
  return devices.make_mesh(count)


def _check_registered(config: TrainConfig, *, num_devices: int) -> None:
  """Checks what needs the simulator, the learner or the device to be known."""
  from apnpql_jax import devices, tasks
  from apnpql_jax.agents import table_one

  validate(
    config,
    tasks=tasks.task_names(),
    algorithms=table_one.epsilon_bounds(),
    memory_bytes=devices.available_memory(),
    devices=num_devices,
  )


def _checkpoint_step(args: Evaluate) -> int | None:
  """Steps of the checkpoint asked for; None for the newest."""
  if args.checkpoint == "newest":
    return None
  if args.checkpoint == "best":
    from apnpql_jax.runs.checkpoint_reader import best_step

    return best_step(Path(args.run))
  if args.checkpoint.isdigit():
    return int(args.checkpoint)
  raise ConfigError(
    f"unknown --checkpoint {args.checkpoint!r}; choose from newest, best, or its steps"
  )


def _check_episodes(episodes: int, seed: int) -> None:
  if episodes < 1:
    raise ConfigError(f"--episodes {episodes} must be at least 1")
  if not 0 <= seed < 2**31:
    raise ConfigError(f"--seed {seed} must be within 0 and 2**31 - 1")


def _check_video(path: Path | None) -> None:
  if path is None:
    return
  if path.suffix not in (".mp4", ".gif"):
    raise ConfigError(f"--video {path} must end in .mp4 or .gif")
  try:
    folder = next(p for p in path.absolute().parents if p.exists())
    fit = folder.is_dir() and os.access(folder, os.W_OK) and not path.is_dir()
  except OSError as error:
    raise ConfigError(f"--video {path}: {error}") from None
  if not fit:
    raise ConfigError(f"--video {path} cannot be written")


def _with_shortcuts(args: Train) -> TrainConfig:
  config = args.config
  env = {"backend": args.backend, "obs": args.obs}
  env = {name: value for name, value in env.items() if value is not None}
  config = dataclasses.replace(config, env=dataclasses.replace(config.env, **env))
  if args.algorithm is None:
    return config
  agent = dataclasses.replace(config.agent, algorithm=args.algorithm)
  return dataclasses.replace(config, agent=agent)
