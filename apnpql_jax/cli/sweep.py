"""The command ``apnpql sweep``: many runs with one line."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import dataclasses
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro

from apnpql_jax.cli.options import Command, Count, File, default_hint, parse
from apnpql_jax.cli.train import Train, base_config, with_shortcuts
from apnpql_jax.config import files, user_files
from apnpql_jax.config.checks import validate
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import ConfigError, UserError
from apnpql_jax.reports.groups import differences
from apnpql_jax.runs import run_folder
from apnpql_jax.runs.sinks import check_sinks
from apnpql_jax.sweeps.launcher import Launch, Launcher, LauncherName
from apnpql_jax.sweeps.manifest import Manifest, find_equal, load_manifest, open_folder
from apnpql_jax.sweeps.plan import Planned, make_plan

_ROOT = Path("runs")


@dataclasses.dataclass(frozen=True)
class Sweep(Command):
  """Trains many runs: apnpql sweep PRESET... [--grid OPTION=A,B]... [train options].

  Options other than those below are those of apnpql train, for all runs. The same
  command again continues where it stopped.

  apnpql sweep push_plate --grid agent.epsilon=0.5,1,2 --seeds 3 --jobs 2

  apnpql sweep push_plate stack_box --grid algorithm=ap_npql,sac --obs state
  """

  uses_jax: ClassVar[bool] = False

  presets: tyro.conf.Positional[tuple[str, ...]] = ()
  """Presets to start from, or paths of their files; `apnpql list` shows all."""

  grid: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
  """Values of an option, such as agent.epsilon=0.5,1,2; several make a product."""

  seeds: int = 1
  """Number of seeds, from 0. To choose them: --grid seed=3,7."""

  jobs: Count = None
  """Runs at the same time: 1 on this machine, all on a cluster unless given. They
  share the cores and GPUs evenly."""

  out: Annotated[
    Path | None, tyro.conf.arg(help_behavior_hint="(default: runs/PRESET-sweep-<n>)")
  ] = None
  """Folder of the sweep; runs are added to a sweep that it holds."""

  resume: File = None
  """Folder of a sweep to continue, as it was started: with its launcher, settings of
  jobs and number of jobs, unless you give others."""

  launcher: Annotated[LauncherName | None, default_hint("(default: local)")] = None
  """Where runs are started: on this machine, on a Slurm cluster, or on this machine as
  if it were a cluster. The latter two need the extra `sweep`."""

  slurm: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
  """Settings of the jobs as submitit names them, such as timeout_min=240,
  cpus_per_task=8, gpus_per_node=1 or slurm_partition=gpu."""

  train: tyro.conf.Suppress[tuple[str, ...]] = ()


def parse_sweep(argv: Sequence[str]) -> Sweep:
  """Returns the options of a sweep; those it does not have itself are in ``train``."""
  names = [x.name for x in dataclasses.fields(Sweep) if x.name != "train"]
  own = {*(f"--{name}" for name in names), "-h", "--help"}
  mine: list[str] = []
  others: list[str] = []
  chosen = mine
  for word in argv:
    if word.startswith("--") or word == "-h":
      chosen = mine if word.partition("=")[0] in own else others
    chosen.append(word)
  args = parse(Sweep, "sweep", mine)
  return dataclasses.replace(args, train=tuple(others))


def sweep(args: Sweep) -> dict[str, Any]:
  """Trains the runs that are not done; returns the states of all."""
  from apnpql_jax.sweeps import training

  if args.jobs is not None and args.jobs < 1:
    raise ConfigError(f"--jobs {args.jobs} must be at least 1")
  with contextlib.ExitStack() as stack:
    manifest = _open(args, stack)
    manifest.launch = launch_of(args, manifest.launch)
    training.train(manifest, _launcher(manifest))
  folder = str(training.shown(manifest.folder))
  runs = {entry.name: entry.state for entry in manifest.runs}
  return {"sweep": folder, "runs": runs if args.json else len(runs)}


def config_of(argv: Sequence[str]) -> TrainConfig:
  """Returns the checked settings of ``apnpql train`` with a preset and options.

  Raises:
    ConfigError: A setting is unknown or invalid.
  """
  return _options_of(argv).config


def _options_of(argv: Sequence[str]) -> Train:
  """Returns the checked options of a run; equal options mean the same run."""
  named = Train(preset=argv[0], task_file=user_files.task_file(argv))
  base = Train(config=base_config(named))
  args = parse(Train, "train", argv, default=base)
  config = with_shortcuts(args)
  validate(config)
  return dataclasses.replace(
    args, preset="", backend=None, obs=None, algorithm=None, config=config
  )


def _open(args: Sweep, stack: contextlib.ExitStack) -> Manifest:
  """Returns the sweep to continue, or a new one."""
  if args.resume is not None:
    if args.presets or args.grid or args.train or args.out or args.seeds != 1:
      raise ConfigError(
        "--resume names the sweep itself; give only --jobs, --launcher, --slurm"
      )
    return load_manifest(args.resume)
  if not args.presets:
    names = ", ".join(files.preset_names())
    raise ConfigError(
      f"sweep needs a preset, before the options of train; choose from {names}"
    )
  plan = make_plan(args.presets, args.grid, seeds=args.seeds, options=args.train)
  check_plan(plan)
  folder = args.out or find_equal(_ROOT, plan)
  if folder is None:
    stems = (Path(preset).stem for preset in args.presets)
    name = f"{'-'.join(stems)}-sweep"
    folder = stack.enter_context(run_folder.new_run_dir(name, _ROOT))
  manifest = open_folder(folder, plan)
  check_begun(manifest)
  return manifest


def check_begun(manifest: Manifest) -> None:
  """Checks that runs which have begun have the settings that they would begin with.

  Raises:
    ConfigError: The preset of a run has changed.
  """
  for entry in manifest.runs:
    run_dir = manifest.run_dir(entry)
    if not (run_dir / run_folder.CONFIG_FILE).is_file():
      continue
    began = run_folder.load_run_config(run_dir)
    if diff := differences(began, config_of(entry.argv)):
      raise ConfigError(
        f"{run_dir} began with other settings: {files.format_diff(diff)}; continue "
        f"with those: apnpql sweep --resume {manifest.folder}; or choose another "
        "--out, or remove the run to train it again"
      )


def check_plan(plan: Sequence[Planned]) -> None:
  """Checks the options of all runs of a plan.

  Raises:
    ConfigError: The options of a run are invalid, or two runs are the same.
  """
  names: dict[Train, str] = {}
  for run in plan:
    name = names.setdefault(_checked(run), run.name)
    if name != run.name:
      raise ConfigError(f"{name} and {run.name} are the same run; leave one out")


def _checked(run: Planned) -> Train:
  """Returns the options of a run; raises ``ConfigError`` that names it."""
  fixed = {"--run", "--resume", "--overwrite", "--json", "--coordinator"}
  if found := fixed & {word.partition("=")[0] for word in run.argv}:
    raise ConfigError(f"leave out {', '.join(sorted(found))}; the sweep sets it itself")
  try:
    options = _options_of(run.argv)
    check_sinks(options.config.sinks)
  except UserError as error:
    raise ConfigError(f"{run.name}: {error}") from None
  return options


def launch_of(args: Sweep, stored: Launch) -> Launch:
  """Returns how to start runs: as the options say, else as the sweep stores it.

  A different launcher keeps none of the stored settings.

  Raises:
    ConfigError: The launcher has no such settings.
  """
  from apnpql_jax.sweeps.slurm import parse_settings

  if args.launcher not in (None, stored.launcher):
    stored = Launch(args.launcher)
  if args.slurm and stored.launcher == "local":
    raise ConfigError("--slurm needs --launcher slurm")
  settings = {**stored.slurm, **parse_settings(args.slurm)}
  return Launch(stored.launcher, settings, args.jobs or stored.jobs)


def _launcher(manifest: Manifest) -> Launcher:
  """Returns the launcher of a sweep."""
  from apnpql_jax.sweeps.local import LocalLauncher
  from apnpql_jax.sweeps.slurm import ALL_AT_ONCE, SlurmLauncher

  launch = manifest.launch
  if launch.launcher == "local":
    return LocalLauncher(launch.jobs or 1)
  return SlurmLauncher(
    manifest.folder / "submitit",
    jobs=launch.jobs or ALL_AT_ONCE,
    settings=launch.slurm,
    cluster="slurm" if launch.launcher == "slurm" else "local",
  )
