"""The command ``apnpql train``."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from apnpql_jax.cli.inputs import run_config
from apnpql_jax.cli.options import Count, File, Flag, OfRun, default_hint
from apnpql_jax.config import files, user_files
from apnpql_jax.config.checks import validate
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import ConfigError
from apnpql_jax.runs import run_folder

if TYPE_CHECKING:
  from jax.sharding import Mesh

OfPreset = Annotated[str | None, default_hint("(default: as in the preset)")]


@dataclasses.dataclass(frozen=True)
class Train(OfRun):
  """Trains an agent: apnpql train PRESET [options].

  Every setting of the preset can be overridden, e.g. --agent.epsilon 0.5.

  apnpql train push_plate --seed 1 --run runs/mine

  apnpql train --resume runs/mine
  """

  preset: tyro.conf.Positional[str] = ""
  """Preset to start from; `apnpql list` shows all. Or the path of a file with a preset
  and its task, such as ./my_task.py."""

  run: Annotated[Path | None, default_hint("(default: first free runs/PRESET-<n>)")] = (
    None
  )
  """Run folder to create."""

  resume: File = None
  """Run folder to resume from its latest checkpoint."""

  init_from: Annotated[str | None, default_hint("")] = None
  """Run with whose weights the new one starts: RUN (its newest checkpoint), RUN:STEP or
  RUN:best."""

  overwrite: Flag = False
  """Replace the existing run in --run."""

  backend: OfPreset = None
  """Short for --env.backend: auto, mjx or native."""

  obs: OfPreset = None
  """Short for --env.obs: pixels or state."""

  algorithm: OfPreset = None
  """Short for --agent.algorithm; `apnpql list` shows all."""

  devices: int = 1
  """Devices that share the worlds and batches; 0: all (always with --coordinator). Not
  stored in the run: pass it again with --resume."""

  coordinator: str = ""
  """Address and port of the first of several processes, or auto to take it and the next
  two options from the batch system; see docs/scaling.md."""

  processes: Count = None
  """Number of processes that share the run."""

  process: Count = None
  """Index of this process, from 0."""

  config: Annotated[TrainConfig, tyro.conf.arg(name="")] = dataclasses.field(
    default_factory=TrainConfig
  )


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


def train(args: Train) -> dict[str, Any]:
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
