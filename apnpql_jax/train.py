"""The host loop around the jitted iteration: report, evaluate, save, stop cleanly.

Everything needed to go on is in ``TrainState``; nothing here is.
"""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
import sys
from typing import Any

import jax

from apnpql_jax import (
  checkpoint,
  codec,
  demonstrations,
  faults,
  leaves,
  memory,
  resuming,
  run_folder,
  runs,
)
from apnpql_jax.agents.learner import Agent, make_agent
from apnpql_jax.checkpoint_writer import CheckpointWriter
from apnpql_jax.config import TrainConfig
from apnpql_jax.env import Env, make_env
from apnpql_jax.extra_sinks import check_sinks, make_sinks
from apnpql_jax.iteration import (
  ExpertReplay,
  TrainState,
  collect_expert,
  empty_expert,
  initial_state,
  make_iteration,
)
from apnpql_jax.metrics import MetricWriter
from apnpql_jax.progress import TrainProgress
from apnpql_jax.reporter import Reporter
from apnpql_jax.run_folder import RunFolder
from apnpql_jax.runs import RunStopped
from apnpql_jax.signals import Signals


@dataclasses.dataclass(frozen=True)
class Start:
  """A run about to go on."""

  env: Env
  agent: Agent
  folder: RunFolder
  state: TrainState
  resume_step: int | None
  """Step it goes on from; None if it is new."""


def train(
  config: TrainConfig, run_dir: Path, *, resume: bool = False, overwrite: bool = False
) -> dict[str, Any]:
  """Trains to ``config.total_steps``, or until a signal, then saves.

  Args:
    config: everything that decides the run.
    run_dir: the run folder.
    resume: go on from the newest checkpoint of ``run_dir`` that is whole.
    overwrite: replace the run that ``run_dir`` holds, once the new one can start.

  Returns:
    the run folder, steps, updates and the last evaluation.

  Raises:
    ConfigError: before anything is written.
    RunStopped: SIGINT or SIGTERM came, and the state is saved; or the run cannot go
      on, and its checkpoints are as they were.
  """
  to_go_on = f"to go on: --resume {run_dir}"
  with Signals(
    "stopped before the first iteration was done; "
    + (to_go_on if resume else "nothing is saved")
  ) as signals:
    start = _start(config, run_dir, resume=resume, overwrite=overwrite)
    _say(f"run folder {start.folder.path}; compiling, which can take minutes")
    try:
      state, evaluation = _run(config, start, signals)
    except OSError as error:  # The disk is full or gone.
      raise RunStopped(f"{error}; {to_go_on}", runs.FAILED) from error
  if signals.caught and int(state.env_steps) < config.total_steps:
    raise RunStopped(
      f"saved at step {int(state.env_steps):,}; {to_go_on}",
      runs.INTERRUPTED + signals.caught[0],
    )
  return {
    "run": str(start.folder.path),
    "env_steps": int(state.env_steps),
    "updates": int(state.learner.step),
    **evaluation,
  }


def _run(
  config: TrainConfig, start: Start, signals: Signals
) -> tuple[TrainState, dict[str, Any]]:
  """Opens what is written to, and trains; returns the last evaluation too."""
  path, resume_step = start.folder.path, start.resume_step
  if resume_step is not None and (aside := resuming.set_aside(path, resume_step)):
    _say(f"later checkpoints, and the metrics until then, are now in {aside}")
  sinks = make_sinks(config.sinks, path, dict(codec.flatten(config)))
  with (
    MetricWriter(path, resume_step=resume_step, sinks=sinks) as writer,
    CheckpointWriter(path, config, keep=config.keep_checkpoints) as saver,
    TrainProgress(config.total_steps) as progress,
  ):
    env, agent = start.env, start.agent
    reporter = Reporter(config, env, agent, start.folder, writer, progress)
    iteration = make_iteration(config, env, agent)
    state = _loop(config, iteration, start.state, reporter, saver, signals)
    if figures := saver.finished(wait=True):
      writer.write(int(state.env_steps), figures)
  return state, reporter.evaluation


def _start(
  config: TrainConfig, run_dir: Path, *, resume: bool, overwrite: bool
) -> Start:
  """Builds or restores everything; makes the folder last."""
  # What Orbax logs of a save that fails, tracebacks of each thread, is said by us.
  logging.getLogger("absl").setLevel(logging.CRITICAL)
  check_sinks(config.sinks)
  if resume:
    folder = run_folder.open_run(run_dir)
    for change in run_folder.changed_versions(folder):
      _say(f"not as when the run began: {change}")
  saved = resume and checkpoint.latest_step(run_dir) is not None
  if saved:
    checkpoint.check(run_dir, None, config=config)
  env, agent = make_env(config.env), make_agent(config.agent)
  example = jax.eval_shape(lambda: initial_state(config, env, agent, empty_expert))
  memory.check_memory(leaves.nbytes(example), "the training state")
  if saved:
    state = resuming.restore(config, run_dir, example, _say)
    return Start(env, agent, folder, state, int(state.env_steps))
  state = initial_state(config, env, agent, _expert(config, env))
  if resume:
    _say("it was stopped before its first checkpoint, and begins again")
    return Start(env, agent, folder, state, 0)
  folder = run_folder.create(run_dir, config, overwrite=overwrite)
  return Start(env, agent, folder, state, None)


def _expert(config: TrainConfig, env: Env) -> ExpertReplay:
  """How the expert's replay is filled: from a file, or by the scripted expert."""
  if not config.replay.demonstrations:
    _say("collecting the expert's replay")
    return collect_expert
  path = Path(config.replay.demonstrations)
  demos = demonstrations.load(path, env)
  _say(f"{demos.instants} instants of {path} for {config.replay.expert_steps} slots")
  return lambda config, env, _: demonstrations.make_replay(demos, config, env)


def _loop(config, iteration, state, reporter, saver, signals) -> TrainState:
  """Iterates to the last step; evaluates and saves whenever a multiple is passed."""
  step = int(state.env_steps)
  while step < config.total_steps and not signals.caught:
    before = step
    state, metrics = iteration(state)
    step = int(state.env_steps)
    reporter.iteration(step, int(state.learner.step), metrics | saver.finished())
    signals.finish_first(f"stopped at once; to go on: --resume {reporter.folder.path}")
    faults.check(config, state, reporter.folder)
    done = step >= config.total_steps
    rate = None
    # Who sends a signal may not wait for an evaluation before the state is safe.
    if not signals.caught and (done or _passed(before, step, config.eval_every)):
      rate = reporter.evaluate(step, state, last=done)
    last = done or bool(signals.caught)
    whole = _passed(before, step, config.save_replay_every or config.checkpoint_every)
    if last or whole or _passed(before, step, config.checkpoint_every):
      items = resuming.to_items(state, whole=last or whole or saver.empty)
      saver.save(step, items, success_rate=rate)
  return state


def _say(text: str) -> None:
  print(text, file=sys.stderr, flush=True)


def _passed(before: int, now: int, every: int) -> bool:
  return now // every > before // every
