"""Training loop on the host: iterates, reports, evaluates, saves and stops cleanly.

It keeps no state; everything needed to resume is in ``TrainState``.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
import signal
import threading
from typing import Any

from jax.sharding import Mesh

from apnpql_jax import devices, errors
from apnpql_jax.agents import table_one
from apnpql_jax.config import codec
from apnpql_jax.config.ranges import check_sizes
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.console import print_line
from apnpql_jax.errors import ConfigError, RunStopped
from apnpql_jax.runs import abandoned_tasks, run_folder
from apnpql_jax.runs.checkpoint_writer import CheckpointWriter
from apnpql_jax.runs.metrics import MetricWriter
from apnpql_jax.runs.progress import TrainProgress
from apnpql_jax.runs.signals import Signals
from apnpql_jax.runs.sinks import check_sinks, make_sinks
from apnpql_jax.tasks import task_names
from apnpql_jax.training import initial_weights, skipped_updates
from apnpql_jax.training.iteration import Iteration
from apnpql_jax.training.reporter import Reporter
from apnpql_jax.training.resume import set_aside, to_items, to_rings
from apnpql_jax.training.start import Start, prepare, print_once
from apnpql_jax.training.state import TrainState


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
  if init_from is not None:
    if resume:
      raise ConfigError("a resumed run has weights; leave out init_from")
    initial_weights.check(init_from, config)
  hint = f"to continue: --resume {run_dir}"
  signals = Signals(
    f"stopped before the first iteration; {hint if resume else 'nothing is saved'}"
  )
  handled = signals if handle_signals else contextlib.nullcontext()
  with handled, abandoned_tasks.silenced():
    reserved = run_folder.reserve(run_dir) if devices.is_primary() else None
    with reserved or contextlib.nullcontext():
      start = prepare(
        config, run_dir, mesh, init_from, resume=resume, overwrite=overwrite
      )
    print_once(f"run folder {start.path}; compiling, which can take minutes")
    if (done := int(start.state.env_steps)) >= config.total_steps:
      print_once(f"nothing to train: step {done:,} of {config.total_steps:,} is done")
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


def _passed(before: int, now: int, every: int) -> bool:
  return now // every > before // every
