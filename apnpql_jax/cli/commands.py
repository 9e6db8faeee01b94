"""Commands of ``apnpql``: each takes its options and returns its result.

JAX, MuJoCo and the modules that need them are imported inside the functions, so that
help and errors are fast.
"""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apnpql_jax.atomic import check_writable
from apnpql_jax.cli.options import (
  Collect,
  Convert,
  Diagnose,
  Evaluate,
  List,
  Repeat,
  Train,
)
from apnpql_jax.config import files, user_files
from apnpql_jax.config.checks import BACKENDS, validate
from apnpql_jax.config.schema import EnvConfig, TrainConfig
from apnpql_jax.console import print_line
from apnpql_jax.errors import ConfigError, check_name
from apnpql_jax.runs import provenance, run_folder

if TYPE_CHECKING:
  from jax.sharding import Mesh

  from apnpql_jax.data.demonstrations import Demonstrations

Json = dict[str, Any]

FORMATS = ("npz", "lerobot")
"""Formats of what ``collect`` saves."""


def base_config(args: Train) -> TrainConfig:
  """Returns the settings that ``train`` starts from: those of the preset or the run."""
  if args.resume is not None and (args.run is not None or args.overwrite):
    raise ConfigError("--resume names the run itself; leave out --run and --overwrite")
  if args.resume is not None and args.init_from is not None:
    raise ConfigError("--resume has the weights of its run; leave out --init-from")
  if args.preset and args.resume is None:
    if args.task_file is not None:
      user_files.load(args.task_file)  # First: the preset may need its task.
    return files.load_preset(args.preset)
  if args.resume is None:
    names = ", ".join(files.preset_names())
    raise ConfigError(f"train needs a preset; choose from {names}")
  return run_config(args.resume, args.task_file)


def train(args: Train) -> Json:
  """Trains or resumes a run and returns its summary."""
  config, resume = with_shortcuts(args), args.resume is not None
  if args.init_from is not None:
    run_folder.split_origin(args.init_from)
  with contextlib.ExitStack() as stack:
    run_dir = args.resume or args.run
    if run_dir is None:
      validate(config)
      name = Path(args.preset).stem
      run_dir = stack.enter_context(run_folder.new_run_dir(name))
    # ``run_training`` repeats this; here it is fast, because JAX is not imported yet.
    run_folder.check_start(run_dir, config, resume=resume, overwrite=args.overwrite)
    mesh = _mesh(args)

    from apnpql_jax import devices
    from apnpql_jax.training.train import train as run_training

    summary = run_training(
      config,
      run_dir,
      resume=resume,
      overwrite=args.overwrite,
      init_from=args.init_from,
      mesh=mesh,
      handle_signals=True,
    )
  return summary if devices.is_primary() else {}


def evaluate(args: Evaluate) -> Json:
  """Plays held-out episodes with a checkpoint of a run."""
  run_dir = existing_run(args.run, "evaluate", args.task_file)
  check_free(args.video, overwrite=args.overwrite)

  from apnpql_jax.training.evaluate import evaluate as evaluate_run

  return evaluate_run(
    run_dir,
    episodes=args.episodes,
    seed=args.seed,
    backend=args.backend,
    step=checkpoint_step(args.run, args.checkpoint),
    acting=args.acting,
    bank_seed=args.bank_seed,
    video=args.video,
  )


def diagnose(args: Diagnose) -> Json:
  """Reports what limits the success of a trained agent."""
  run_dir = existing_run(args.run, "diagnose", args.task_file)

  from apnpql_jax.training.diagnose import diagnose as diagnose_run

  return diagnose_run(
    run_dir,
    episodes=args.episodes,
    seed=args.seed,
    backend=args.backend,
    step=checkpoint_step(args.run, args.checkpoint),
    acting=args.acting,
    bank_seed=args.bank_seed,
  )


def collect(args: Collect) -> Json:
  """Plays episodes with the scripted expert of a task."""
  check_free(args.video, overwrite=args.overwrite)
  check_name("--format", args.format, FORMATS)
  dataset = args.format == "lerobot"
  if args.save is None and (args.append or args.solved_only or dataset):
    raise ConfigError("--append, --solved-only and --format need --save")
  if args.save is not None and dataset:
    _check_dataset(args.save, append=args.append)
  elif args.save is not None:
    _check_demonstrations(args.save, overwrite=args.overwrite, append=args.append)
  # The expert acts on privileged poses, so images are not needed.
  env = dataclasses.replace(task_env(args.task), backend=args.backend, obs="state")

  from apnpql_jax.envs.env import make_env
  from apnpql_jax.training import expert
  from apnpql_jax.training.evaluate import evaluate_expert

  earlier = _earlier(args.save, env) if args.save and args.append else None
  settings: Json = {"episodes": args.episodes, "seed": args.seed, "noise": args.noise}
  figures = evaluate_expert(env, video=args.video, **settings)
  if args.save is not None:
    demos = expert.record_expert(make_env(env), **settings)
    if dataset:
      figures |= _save_dataset(args, args.save, env, demos)
    else:
      figures |= _save(args, args.save, env, demos, earlier)
  return figures


def convert(args: Convert) -> Json:
  """Converts recorded joint trajectories into demonstrations."""
  if not args.out:
    raise ConfigError("usage: apnpql convert REC TASK OUT.npz")
  recording, out = Path(args.recording), Path(args.out)
  _check_demonstrations(out, overwrite=args.overwrite, append=args.append)
  if args.append and recording.resolve() == out.resolve():
    raise ConfigError(f"{out} cannot be added to itself")
  env = task_env(args.task)

  from apnpql_jax import devices, tasks
  from apnpql_jax.data import demonstrations, lerobot, recordings
  from apnpql_jax.data.lerobot import conversion

  devices.start()
  earlier = _earlier(out, env) if args.append else None
  task = tasks.make_task(env.task)
  if lerobot.is_dataset(recording):
    demos = conversion.convert(recording, task.scene, period_s=env.control_period_s)
  elif demonstrations.is_demonstrations(recording):
    demos = demonstrations.load(recording, task, env, allow_unsolved=True)
  else:
    demos = recordings.convert(recording, task.scene, period_s=env.control_period_s)
  if not args.allow_unsolved:
    demonstrations.check_solved(demos, task, env, flag="--allow-unsolved")
  demonstrations.check_reachable(demos, task)
  return _save(args, out, env, demos, earlier)


def repeat(args: Repeat) -> Json:
  """Repeats the update that stopped a run and names what was not finite."""
  if not args.file:
    raise ConfigError("repeat needs a file: apnpql repeat RUN/faults/step_<n>.npz")
  path = Path(args.file).absolute()
  run_config(path.parent.parent, args.task_file)

  from apnpql_jax import devices
  from apnpql_jax.training import skipped_updates

  devices.start()
  return skipped_updates.repeat(path)


def list_names(args: List) -> Json:
  """Returns the names that other commands accept, or a contact report of each task.

  Builds the tasks of ``args.files``, so that what is wrong with them shows.
  """
  modules = [user_files.load(file) for file in args.files]
  from apnpql_jax import devices, tasks
  from apnpql_jax.agents import table_one

  names = tasks.task_names()
  if modules or args.contacts:
    devices.start()
  for module in modules:
    for name in tasks.registered_by(module.__name__):
      tasks.make_task(name)
  if args.contacts:
    from apnpql_jax.tasks.contact_report import contact_report

    return {name: contact_report(tasks.make_task(name)) for name in names}
  return {
    "tasks": names,
    "presets": files.preset_names(),
    "algorithms": list(table_one.ALGORITHMS),
    "backends": list(BACKENDS),
  }


def with_shortcuts(args: Train) -> TrainConfig:
  """Returns the settings with --backend, --obs and --algorithm applied.

  Those of a new run name the file of its task, which may be --task-file.
  """

  def updated(part: Any, **settings: str | None) -> Any:
    given = {name: value for name, value in settings.items() if value is not None}
    return dataclasses.replace(part, **given)

  env = updated(args.config.env, backend=args.backend, obs=args.obs)
  agent = updated(args.config.agent, algorithm=args.algorithm)
  config = dataclasses.replace(args.config, env=env, agent=agent)
  if args.task_file is None or args.resume is not None:
    return config
  return files.with_file(user_files.load(args.task_file), config)


def _mesh(args: Train) -> Mesh | None:
  """Returns the devices to train on; waits for the other processes, if any.

  Called before anything is written, so that all processes find the same run folder.
  """
  if args.coordinator and args.run is None and args.resume is None:
    raise ConfigError("processes of one run must be given the same --run")
  if not args.coordinator and (args.processes, args.process) != (None, None):
    raise ConfigError("--processes and --process need a --coordinator")
  from apnpql_jax import devices

  if not args.coordinator:
    return devices.make_mesh(args.devices)
  devices.join(args.coordinator, args.processes, args.process)
  return devices.make_mesh(0)


def existing_run(run: str, command: str, task_file: Path | None) -> Path:
  """Returns the folder of a run; raises ``UserError`` if it is not one."""
  if not run:
    raise ConfigError(f"{command} needs a run folder: apnpql {command} RUN")
  run_config(Path(run), task_file)
  return Path(run)


def run_config(run_dir: Path, task_file: Path | None) -> TrainConfig:
  """Returns the settings of a run, after executing the file of its task, if given."""
  config = run_folder.load_run_config(run_dir, print_line)
  if task_file is not None:
    user_files.load(task_file)
    if provenance.changed_task(run_dir, task_file):
      print_line(f"{task_file} or its MJCF has changed since {run_dir} began")
  elif config.env.task_file:
    user_files.check_loaded(config.env.task_file, config.env.task)
  return config


def _check_demonstrations(path: Path, *, overwrite: bool, append: bool) -> None:
  """Raises ``ConfigError`` if demonstrations cannot be written, or must not be."""
  if overwrite and append:
    raise ConfigError("use either --append or --overwrite")
  if path.is_dir() or not path.absolute().parent.is_dir():
    raise ConfigError(f"{path} is a folder or its parent is missing; name another file")
  check_writable(path.absolute().parent)
  check_free(path, overwrite=overwrite or append)


def _check_dataset(path: Path, *, append: bool) -> None:
  """Raises ``UserError`` if a dataset cannot be written."""
  if append:
    raise ConfigError("--append needs --format npz; name a new folder for a dataset")
  if path.is_file() or path.is_dir() and any(path.iterdir()):
    raise ConfigError(f"{path} exists; name a new folder for the dataset")
  check_writable(path)

  from apnpql_jax.data import lerobot

  lerobot.check_available()


def _earlier(path: Path, env: EnvConfig) -> Demonstrations | None:
  """Returns the demonstrations in a file, or None if there is no file."""
  from apnpql_jax import tasks
  from apnpql_jax.data import demonstrations

  if not path.exists():
    return None
  return demonstrations.load(path, tasks.make_task(env.task), env, allow_unsolved=True)


def _save(
  args: Collect | Convert,
  path: Path,
  env: EnvConfig,
  demos: Demonstrations,
  earlier: Demonstrations | None,
) -> Json:
  """Writes demonstrations after ``earlier`` ones; returns the file and its counts."""
  from apnpql_jax import tasks
  from apnpql_jax.data import demonstrations

  task = tasks.make_task(env.task)
  demonstrations.check(demos, task.scene)
  if args.solved_only:
    demos = demonstrations.only_solved(demos, task, env)
  if earlier is not None:
    demos = demonstrations.join(earlier, demos)
  period_s = env.control_period_s
  counts = demonstrations.save(path, demos, task=env.task, control_period_s=period_s)
  solved = int(demonstrations.solved(demos, task, env).sum())
  return counts | {"solved_demonstrations": solved}


def _save_dataset(
  args: Collect, path: Path, env: EnvConfig, demos: Demonstrations
) -> Json:
  """Writes demonstrations as a dataset; returns the folder and its counts."""
  from apnpql_jax import tasks
  from apnpql_jax.data import demonstrations
  from apnpql_jax.training.expert_dataset import write_dataset

  task = tasks.make_task(env.task)
  if args.solved_only:
    demos = demonstrations.only_solved(demos, task, env)
  return write_dataset(path, demos, task, env)


def check_free(path: Path | None, *, overwrite: bool) -> None:
  """Raises ``ConfigError`` if a file exists and must not be replaced."""
  if path is not None and path.is_file() and not overwrite:
    raise ConfigError(f"{path} exists; replace it with --overwrite, or name another")


def task_env(task: str) -> EnvConfig:
  """Returns the environment of a task that exists, or of the preset in its file."""
  if not user_files.is_file(task):
    from apnpql_jax import tasks

    check_name("task", task, tasks.task_names())
  return files.task_env(task)


def checkpoint_step(run: Path | str, checkpoint: str) -> int | None:
  """Returns the step of the checkpoint asked for; None for the newest."""
  if checkpoint == "newest":
    return None
  if checkpoint == "best":
    from apnpql_jax.runs.checkpoint_reader import best_step

    return best_step(Path(run))
  if checkpoint.isdecimal() and len(checkpoint) < 20:
    return int(checkpoint)
  raise ConfigError(
    f"unknown --checkpoint {checkpoint!r}; choose from newest, best, or a step"
  )
