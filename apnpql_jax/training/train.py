"""Training loop on the host: iterates, reports, evaluates, saves and stops cleanly.

It keeps no state; everything needed to resume is in ``TrainState``.
"""

from __future__ import annotations

from concurrent import futures
import contextlib
import functools
from pathlib import Path
import signal
import threading
from typing import Any, NamedTuple

import jax
from jax.sharding import Mesh

from apnpql_jax import devices, errors
from apnpql_jax.agents import table_one
from apnpql_jax.agents.learner import Agent, make_agent
from apnpql_jax.config import codec
from apnpql_jax.config.checks import PROCESS_BYTES
from apnpql_jax.config.ranges import check_sizes
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.console import print_line
from apnpql_jax.data import demonstrations, replay
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.errors import ConfigError, RunStopped
from apnpql_jax.runs import (
  abandoned_tasks,
  checkpoint_reader,
  leaves,
  provenance,
  run_folder,
)
from apnpql_jax.runs.checkpoint_writer import CheckpointWriter
from apnpql_jax.runs.metrics import MetricWriter
from apnpql_jax.runs.progress import TrainProgress
from apnpql_jax.runs.signals import Signals
from apnpql_jax.runs.sinks import check_sinks, make_sinks
from apnpql_jax.tasks import make_task, task_names
from apnpql_jax.training import expert, initial_weights, skipped_updates
from apnpql_jax.training.expert import ExpertReplayMaker, collect_expert
from apnpql_jax.training.iteration import Iteration, compile_iteration
from apnpql_jax.training.reporter import Reporter
from apnpql_jax.training.resume import (
  disk_bytes,
  restore_run,
  set_aside,
  to_items,
  to_rings,
)
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


def train(
  config: TrainConfig,
  run_dir: Path | str,
  *,
  resume: bool = False,
  overwrite: bool = False,
  init_from: Path | str | None = None,
  mesh: Mesh | None = None,
  handle_signals: bool = False,
) -> dict[str, Any]:
  """Trains to ``config.total_steps`` or until a signal, then saves.

  Args:
    config: Settings of the run.
    run_dir: The run folder.
    resume: Resume from the newest readable checkpoint in ``run_dir``.
    overwrite: Replace the run in ``run_dir`` as soon as the new one can start.
    init_from: ``RUN``, ``RUN:STEP`` or ``RUN:best``: another run with whose weights
      this one starts. Optimizers and replay start empty.
    mesh: Devices to train on; the default device if None.
    handle_signals: Save and stop at SIGINT, SIGTERM or SIGHUP. A second signal, or one
      before there is anything to save, ends the process at once. Works in the main
      thread only. By default, Ctrl-C raises ``KeyboardInterrupt`` as usual.

  Returns:
    The run folder, steps, updates and the last evaluation.

  Raises:
    UserError: The run cannot start; nothing was written.
    RunStopped: The run was saved after a signal, or it cannot continue and its
      checkpoints are unchanged.
  """
  run_dir = Path(run_dir)
  _check(config, run_dir, mesh, resume, overwrite, handle_signals)
  if init_from is not None and resume:
    raise ConfigError("a resumed run has weights; leave out init_from")
  origin = None if init_from is None else initial_weights.find(init_from, config)
  hint = f"to continue: --resume {run_dir}"
  signals = Signals(
    f"stopped before the first iteration; {hint if resume else 'nothing is saved'}"
  )
  handled = signals if handle_signals else contextlib.nullcontext()
  with handled, abandoned_tasks.silenced():
    reserved = run_folder.reserve(run_dir) if devices.is_primary() else None
    with reserved or contextlib.nullcontext():
      start = _start(config, run_dir, mesh, origin, resume=resume, overwrite=overwrite)
    _print_line(f"run folder {start.path}; compiling, which can take minutes")
    if (done := int(start.state.env_steps)) >= config.total_steps:
      _print_line(f"nothing to train: step {done:,} of {config.total_steps:,} is done")
    try:
      state, evaluation = _run(config, start, signals)
    except OSError as error:  # The disk is full or gone.
      raise RunStopped(f"{error}; {hint}", errors.FAILED) from error
  if int(state.env_steps) < config.total_steps:
    # Another process may have received the signal.
    number = signals.caught[0] if signals.caught else signal.SIGTERM
    raise RunStopped(
      f"saved at step {int(state.env_steps):,}; {hint}", errors.INTERRUPTED + number
    )
  return {
    "run": str(start.path),
    "env_steps": int(state.env_steps),
    "updates": int(state.learner.step),
    **evaluation,
  }


def _check(
  config: TrainConfig,
  run_dir: Path,
  mesh: Mesh | None,
  resume: bool,
  overwrite: bool,
  handle_signals: bool,
) -> None:
  """Raises ``UserError`` if the run cannot start; see ``train`` for the arguments."""
  devices.start()
  run_folder.check_start(
    run_dir,
    config,
    resume=resume,
    overwrite=overwrite,
    tasks=task_names(),
    algorithms=table_one.epsilon_bounds(),
    memory_bytes=devices.available_memory(),
    devices=mesh.size if mesh else 1,
  )
  if not resume:
    table_one.check_effects(config)
    check_sizes(config.env.randomization)
  check_sinks(config.sinks)
  if handle_signals and threading.current_thread() is not threading.main_thread():
    raise ConfigError("handle_signals=True works in the main thread only")
  devices.barrier()  # All have checked the folder before the first one writes to it.


def _run(
  config: TrainConfig, start: Start, signals: Signals
) -> tuple[TrainState, dict[str, Any]]:
  """Opens the outputs and trains; returns the state and the last evaluation."""
  path, resume_step = start.path, start.resume_step
  reporter: Reporter | None = None  # Only in the first process.
  with contextlib.ExitStack() as stack:
    if devices.is_primary():
      stack.enter_context(run_folder.lock(path))
      if resume_step is not None and (aside := set_aside(path, resume_step)):
        print_line(f"later checkpoints and a copy of the metrics were moved to {aside}")
      if resume_step is not None and (
        changed := run_folder.change(path, config, step=resume_step)
      ):
        print_line(f"settings changed at step {resume_step:,}: {changed}")
    devices.barrier()
    if devices.is_primary():
      settings = dict(codec.flatten(config))
      sinks = make_sinks(config.sinks, path, settings, resume_step=resume_step)
      writer = MetricWriter(path, resume_step=resume_step, sinks=sinks)
      stack.enter_context(writer)
      progress = TrainProgress(config.total_steps, eval_every=config.eval_every)
      stack.enter_context(progress)
      env = start.env.on_one_device()
      reporter = Reporter(config, env, start.agent, path, writer, progress)
    rings = to_rings(start.state, chunk=config.rollout_length)
    saver = CheckpointWriter(
      path,
      config,
      keep=config.keep_checkpoints,
      restored=rings if start.on_disk else {},
    )
    stack.enter_context(saver)
    del rings
    iteration = start.iteration.result()
    devices.release_memory()
    devices.barrier()
    state = _loop(config, start, iteration, reporter, saver, signals)
    figures = saver.proceed(wait=True)
    if reporter and figures:
      reporter.writer.write(int(state.env_steps), figures)
  return state, reporter.evaluation if reporter else {}


def _start(
  config: TrainConfig,
  run_dir: Path,
  mesh: Mesh | None,
  origin: tuple[Path, int] | None,
  *,
  resume: bool,
  overwrite: bool,
) -> Start:
  """Builds or restores everything; creates the run folder last."""
  count = mesh.size if mesh else 1
  if resume:
    path = run_folder.open_run(run_dir).path
    for change in provenance.changed_versions(path, devices=count):
      _print_line(f"changed since the run began: {change}")
    if checkpoint_reader.latest_step(run_dir) is not None:
      return _restored(config, run_dir, mesh)
  fill = _expert(config)
  weights = initial_weights.read(run_dir.absolute()) if resume else None
  if origin:
    weights = initial_weights.load(*origin, config, mesh)
    about = weights.origin
    _print_line(f"starting with the weights of {about['run']}, step {about['step']:,}")
  env, agent, iteration, _ = _build(config, run_dir, mesh, resumed=False)
  _print_line("filling the expert replay")
  state = initial_state(config, env, agent, fill)
  state = initial_weights.put(weights, state) if weights else state
  devices.release_memory()
  if state.expert_replay is not None:
    solved, ended = map(int, replay.episodes(state.expert_replay))
    _print_line(f"expert replay: {solved} of {ended} episodes solved")
  if resume:
    _print_line("the run has no checkpoint yet and starts from the beginning")
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
    _print_line,
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
    _print_line(warning)
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
  _print_line(f"expert replay: {slots} slots from {demos.instants} instants of {path}")
  return functools.partial(expert.replay_from_demonstrations, demos)


def _loop(
  config: TrainConfig,
  start: Start,
  iteration: Iteration,
  reporter: Reporter | None,
  saver: CheckpointWriter,
  signals: Signals,
) -> TrainState:
  """Iterates to the last step; evaluates and saves at multiples of the intervals."""
  state, stop = start.state, False
  step = int(state.env_steps)
  while step < config.total_steps and not stop:
    before = step
    state, metrics = iteration(state)
    step = int(state.env_steps)
    # Before the report: from then on there is something to save.
    signals.finish_first(
      "finishing this iteration, then saving",
      f"stopped at once; to continue: --resume {start.path}",
    )
    rings = to_rings(state, chunk=config.rollout_length)
    metrics = {**metrics, **saver.proceed(rings)}
    if reporter:
      reporter.iteration(step, int(state.learner.step), metrics)
    skipped_updates.check(config, state, start.path)
    done = step >= config.total_steps
    rate = None
    # Check for signals first, so that saving does not wait for an evaluation. The last
    # evaluation always runs, because no resume would make up for it.
    stop = devices.any_process(signals.caught)
    if done or not stop and _passed(before, step, config.eval_every):
      rate = reporter.evaluate(step, state, last=done) if reporter else None
      stop = devices.any_process(signals.caught)
    last = done or stop
    whole = _passed(before, step, config.save_replay_every or config.checkpoint_every)
    if last or whole or _passed(before, step, config.checkpoint_every):
      items = to_items(state, whole=last or whole or saver.empty)
      rings = rings if "replay" in items else {}
      saver.save(step, items, rings=rings, success_rate=rate)
      devices.release_memory()
  return state


def _print_line(line: str) -> None:
  if devices.is_primary():
    print_line(line)


def _passed(before: int, now: int, every: int) -> bool:
  return now // every > before // every
