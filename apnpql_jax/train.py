"""The host loop around the jitted iteration: report, evaluate, save, stop cleanly.

Everything needed to go on is in ``TrainState``; nothing here is.
"""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import dataclasses
import logging
from pathlib import Path
import signal
import sys
from typing import Any

import jax
import jax.numpy as jnp

from apnpql_jax import (
  checkpoint,
  codec,
  demonstrations,
  faults,
  leaves,
  memory,
  replay,
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
  start = _start(config, run_dir, resume=resume, overwrite=overwrite)
  _say(f"run folder {start.folder.path}; compiling, which takes a minute or two")
  try:
    state, evaluation, caught = _run(config, start)
  except OSError as error:  # The disk is full or gone.
    raise RunStopped(f"{error}; {_how_to_go_on(run_dir)}", runs.FAILED) from error
  if caught and int(state.env_steps) < config.total_steps:
    raise RunStopped(
      f"saved at step {int(state.env_steps):,}; {_how_to_go_on(run_dir)}",
      runs.INTERRUPTED + caught[0],
    )
  return {
    "run": str(start.folder.path),
    "env_steps": int(state.env_steps),
    "updates": int(state.learner.step),
    **evaluation,
  }


def _run(
  config: TrainConfig, start: Start
) -> tuple[TrainState, dict[str, Any], list[int]]:
  """Opens what is written to, and trains; the last evaluation and signals caught."""
  path, resume_step = start.folder.path, start.resume_step
  sinks = make_sinks(config.sinks, path, dict(codec.flatten(config)))
  with (
    MetricWriter(path, resume_step=resume_step, sinks=sinks) as writer,
    CheckpointWriter(
      path, config, keep=config.keep_checkpoints, resume_step=resume_step
    ) as saver,
    TrainProgress(config.total_steps) as progress,
    caught_signals() as caught,
  ):
    env, agent = start.env, start.agent
    reporter = Reporter(config, env, agent, start.folder, writer, progress)
    iteration = make_iteration(config, env, agent)
    state = _loop(config, iteration, start.state, reporter, saver, caught)
    if figures := saver.finished(wait=True):
      writer.write(int(state.env_steps), figures)
  return state, reporter.evaluation, caught


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
    state = _restore(config, run_dir, example)
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


def _loop(config, iteration, state, reporter, saver, caught) -> TrainState:
  """Iterates to the last step; evaluates and saves whenever a multiple is passed."""
  step = int(state.env_steps)
  while step < config.total_steps and not caught:
    before = step
    state, metrics = iteration(state)
    step = int(state.env_steps)
    reporter.iteration(step, int(state.learner.step), metrics | saver.finished())
    faults.check(config, state, reporter.folder)
    done = step >= config.total_steps
    rate = None
    # Who sends a signal may not wait for an evaluation before the state is safe.
    if not caught and (done or _passed(before, step, config.eval_every)):
      rate = reporter.evaluate(step, state, last=done)
    last = done or bool(caught)
    whole = _passed(before, step, config.save_replay_every or config.checkpoint_every)
    if last or whole or _passed(before, step, config.checkpoint_every):
      items = _to_items(state, whole=last or whole or saver.empty)
      saver.save(step, items, success_rate=rate)
  return state


def _to_items(state: TrainState, *, whole: bool) -> dict[str, Any]:
  """The parts of a checkpoint; the replay, by far the largest, only if ``whole``."""
  rest = {name: getattr(state, name) for name in ("env", "key", "env_steps", "faults")}
  items: dict[str, Any] = {"learner": state.learner, "rest": rest}
  if whole:
    items["replay"] = {"agent": state.replay, "expert": state.expert_replay}
  return items


def _restore(config: TrainConfig, run_dir: Path, example: TrainState) -> TrainState:
  """The newest state that can be read; undoes ``_to_items``."""
  found = checkpoint.restore(
    run_dir, None, _to_items(example, whole=True), config=config
  )
  for line in found.damaged:
    _say(line)
  if found.damaged:
    _say(f"going on from the checkpoint before, {found.step}")
  ring = found.items["replay"]["agent"]
  if found.steps["replay"] < found.step:
    _say(f"its replay is that of step {found.steps['replay']:,}")
    # What comes next does not follow on its newest slots.
    ring = replay.exclude(ring, jnp.ones(config.env.worlds, jnp.int32))
  return TrainState(
    learner=found.items["learner"],
    replay=ring,
    expert_replay=found.items["replay"]["expert"],
    **found.items["rest"],
  )


@contextlib.contextmanager
def caught_signals() -> Generator[list[int]]:
  """Collects SIGINT and SIGTERM instead of dying of them.

  The iteration under way is finished and saved; a second signal acts as usual.
  """
  caught: list[int] = []
  previous: dict[int, Any] = {}

  def handler(number: int, _frame: Any) -> None:
    caught.append(number)
    for each, old in previous.items():
      signal.signal(each, old)

  for each in (signal.SIGINT, signal.SIGTERM):
    previous[each] = signal.signal(each, handler)
  try:
    yield caught
  finally:
    for each, old in previous.items():
      signal.signal(each, old)


def _how_to_go_on(run_dir: Path) -> str:
  return f"to go on: --resume {run_dir}"


def _say(text: str) -> None:
  print(text, file=sys.stderr, flush=True)


def _passed(before: int, now: int, every: int) -> bool:
  return now // every > before // every
