"""Start of a run: all that the training loop needs, built or restored."""

from __future__ import annotations

from concurrent import futures
import functools
from pathlib import Path
from typing import NamedTuple

import jax
from jax.sharding import Mesh

from apnpql_jax import devices
from apnpql_jax.agents import table_one
from apnpql_jax.agents.learner import Agent, make_agent
from apnpql_jax.config.checks import PROCESS_BYTES
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.console import print_line
from apnpql_jax.data import demonstrations, replay
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.runs import checkpoint_reader, leaves, provenance, run_folder
from apnpql_jax.tasks import make_task
from apnpql_jax.training import expert, initial_weights
from apnpql_jax.training.expert import ExpertReplayMaker, collect_expert
from apnpql_jax.training.iteration import Iteration, compile_iteration
from apnpql_jax.training.resume import disk_bytes, restore_run
from apnpql_jax.training.state import (
  TrainState,
  example_state,
  initial_expert,
  initial_state,
)


class Start(NamedTuple):
  """A run ready to train."""

  env: Env
  agent: Agent
  iteration: futures.Future[Iteration]  # compiled
  path: Path  # of the run folder, absolute
  state: TrainState
  resume_step: int | None  # None for a new run
  on_disk: bool = False  # the replays are what the newest checkpoints have


def prepare(
  config: TrainConfig,
  run_dir: Path,
  mesh: Mesh | None,
  init_from: Path | str | None,
  *,
  resume: bool,
  overwrite: bool,
) -> Start:
  """Builds or restores everything; creates the run folder last.

  Arguments and errors are those of ``train``.
  """
  count = mesh.size if mesh else 1
  if resume:
    path = run_folder.open_run(run_dir).path
    for change in provenance.changed_versions(path, devices=count):
      print_once(f"changed since the run began: {change}")
    if checkpoint_reader.latest_step(run_dir) is not None:
      return _restored(config, run_dir, mesh)
  fill = _expert(config)
  weights = initial_weights.read(run_dir.absolute()) if resume else None
  if init_from is not None:
    weights = initial_weights.load(init_from, config, mesh)
    about = weights.origin
    print_once(f"starting with the weights of {about['run']}, step {about['step']:,}")
  env, agent, iteration, _ = _build(config, run_dir, mesh, resumed=False)
  print_once("filling the expert replay")
  state = initial_state(config, env, agent, fill)
  state = initial_weights.put(weights, state) if weights else state
  devices.release_memory()
  if state.expert_replay is not None:
    solved, ended = map(int, replay.episodes(state.expert_replay))
    print_once(f"expert replay: {solved} of {ended} episodes solved")
  if resume:
    print_once("the run has no checkpoint yet and starts from the beginning")
  else:
    devices.run_on_primary(
      lambda: run_folder.create(
        run_dir,
        config,
        overwrite=overwrite,
        devices=count,
        origin=weights.origin if weights else None,
        write_more=weights.write if weights else None,
      )
    )
  path = run_folder.open_run(run_dir).path
  return Start(env, agent, iteration, path, state, 0 if resume else None)


def _restored(config: TrainConfig, run_dir: Path, mesh: Mesh | None) -> Start:
  """Builds everything and reads the newest readable checkpoint."""
  checkpoint_reader.restore(run_dir, None, {}, config=config)  # Fails early.
  env, agent, iteration, example = _build(config, run_dir, mesh, resumed=True)
  state, intact = restore_run(
    config,
    run_dir,
    example,
    print_once,
    refill=lambda: initial_expert(config, env, _expert(config)),
  )
  step = int(state.env_steps)
  return Start(env, agent, iteration, run_dir.absolute(), state, step, intact)


def _build(
  config: TrainConfig, run_dir: Path, mesh: Mesh | None, *, resumed: bool
) -> tuple[Env, Agent, futures.Future[Iteration], TrainState]:
  """Returns worlds, agent, iteration and the state's shapes; checks what they take."""
  agent = make_agent(config.agent)  # Before the worlds, which can take minutes.
  env = make_env(
    config.env,
    mesh,
    lstm_instants=config.agent.lstm_instants,
    label_expert=table_one.imitates(config.agent),
  )
  example = example_state(config, env, agent)
  devices.check_memory(needed_memory(example), "the training")
  if warning := run_folder.check_disk(run_dir, *disk_bytes(config, example, resumed)):
    print_once(warning)
  # Compile while the state is being made or read, which also compiles: XLA keeps a
  # second core busy that way.
  background = futures.ThreadPoolExecutor(1)
  iteration = background.submit(compile_iteration, config, env, agent, example)
  background.shutdown(wait=False)
  return env, agent, iteration, example


def needed_memory(example: TrainState) -> int:
  """Returns the bytes that a training takes on each device, checkpoints included."""
  return leaves.nbytes(example) + PROCESS_BYTES // jax.local_device_count()


def _expert(config: TrainConfig) -> ExpertReplayMaker:
  """Returns how to fill the expert replay; reads the demonstrations, if any."""
  if not config.replay.demonstrations:
    return collect_expert
  path, task = Path(config.replay.demonstrations), make_task(config.env.task)
  allow = config.replay.allow_unsolved
  demos = demonstrations.load(path, task, config.env, allow_unsolved=allow)
  slots = config.replay.expert_steps
  print_once(f"expert replay: {slots} slots from {demos.instants} instants of {path}")
  return functools.partial(expert.replay_from_demonstrations, demos)


def print_once(line: str) -> None:
  """Prints a line in the first of several processes."""
  if devices.is_primary():
    print_line(line)
