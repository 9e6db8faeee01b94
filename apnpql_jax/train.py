"""The host loop around the jitted iteration: report, evaluate, save, stop cleanly.

Everything needed to go on is in ``TrainState``; nothing here is.
"""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import functools
import math
from pathlib import Path
import signal
import sys
import time
from typing import Any

import jax

from apnpql_jax import checkpoint, codec, memory, run_folder
from apnpql_jax.agents.learner import Agent, make_agent
from apnpql_jax.config import TrainConfig
from apnpql_jax.env import Env, make_env
from apnpql_jax.evaluate import make_player, play_held_out
from apnpql_jax.extra_sinks import check_sinks, make_sinks
from apnpql_jax.iteration import TrainState, initial_state, make_iteration
from apnpql_jax.metrics import MetricWriter, plot_curve, read_rows
from apnpql_jax.progress import TrainProgress
from apnpql_jax.recording import record_episodes
from apnpql_jax.rollout import agent_policy
from apnpql_jax.run_folder import RunFolder

EVAL_SEED = 1
"""Evaluations during training always play the same held-out episodes."""


def train(
  config: TrainConfig, run_dir: Path, *, resume: bool = False, overwrite: bool = False
) -> dict[str, Any]:
  """Trains to ``config.total_steps``, or until a signal, then saves.

  Args:
    config: everything that decides the run.
    run_dir: the run folder.
    resume: go on from the newest checkpoint of ``run_dir``.
    overwrite: replace the run that ``run_dir`` holds, once the new one can start.

  Returns:
    the run folder, steps, updates and the last evaluation.

  Raises:
    ConfigError: before anything is written.
    KeyboardInterrupt: SIGINT or SIGTERM came; the state is saved.
  """
  check_sinks(config.sinks)
  if resume:
    checkpoint.check(run_dir, None, config=config)
  env, agent = make_env(config.env), make_agent(config.agent)
  build = functools.partial(initial_state, config, env, agent)
  example = jax.eval_shape(build)
  memory.check_memory(_nbytes(example), "the training state")
  if resume:
    folder = run_folder.open_run(run_dir)
    for change in run_folder.changed_versions(folder):
      _say(f"not as when the run began: {change}")
    state = checkpoint.restore(run_dir, None, example, config=config)
  else:
    _say("collecting the expert's replay")
    state = build()
    folder = run_folder.create(run_dir, config, overwrite=overwrite)
  start = int(state.env_steps) if resume else None
  _say(f"run folder {folder.path}; compiling, which takes a minute or two")
  with (
    MetricWriter(
      folder.path,
      resume_step=start,
      sinks=make_sinks(config.sinks, folder.path, dict(codec.flatten(config))),
    ) as writer,
    checkpoint.CheckpointWriter(
      folder.path, config, keep=config.keep_checkpoints, resume_step=start
    ) as saver,
    TrainProgress(config.total_steps) as progress,
    caught_signals() as caught,
  ):
    reporter = _Reporter(config, env, agent, folder, writer, progress)
    state = _loop(
      config, make_iteration(config, env, agent), state, reporter, saver, caught
    )
  if caught:
    _say(f"saved at step {int(state.env_steps):,}; to go on: --resume {run_dir}")
    raise KeyboardInterrupt
  return {
    "run": str(folder.path),
    "env_steps": int(state.env_steps),
    "updates": int(state.learner.step),
    **reporter.evaluation,
  }


def _loop(config, iteration, state, reporter, saver, caught) -> TrainState:
  """Iterates to the last step; evaluates and saves whenever a multiple is passed."""
  step = int(state.env_steps)
  while step < config.total_steps and not caught:
    before = step
    state, metrics = iteration(state)
    step = int(state.env_steps)
    done = step >= config.total_steps
    reporter.iteration(step, int(state.learner.step), metrics)
    rate = None
    if done or _passed(before, step, config.eval_every):
      rate = reporter.evaluate(step, state, last=done)
    if done or caught or _passed(before, step, config.checkpoint_every):
      saver.save(step, state, success_rate=rate)
  return state


class _Reporter:
  """Metrics, progress, evaluation, curve and videos of a run."""

  def __init__(
    self,
    config: TrainConfig,
    env: Env,
    agent: Agent,
    folder: RunFolder,
    writer: MetricWriter,
    progress: TrainProgress,
  ):
    self._config, self._env, self._folder = config, env, folder
    self._writer, self._progress = writer, progress
    self._policy = lambda params: agent_policy(agent, params, greedy=False)
    self._play = make_player(env, self._policy)
    self._lap = time.monotonic()
    self._row: dict[str, Any] = {}
    self.evaluation: dict[str, Any] = {}

  def iteration(self, step: int, updates: int, metrics: dict[str, Any]) -> None:
    """Writes the row of one iteration; blocks until it has been computed."""
    metrics = jax.device_get(metrics)
    now = time.monotonic()
    seconds, self._lap = now - self._lap, now
    config = self._config
    steps = config.rollout_length * config.env.worlds
    metrics["time/sps_e2e"] = steps / seconds
    metrics["time/updates_per_s"] = config.updates_per_iteration / seconds
    self._writer.write(step, metrics)
    self._progress.update(step, updates=updates)

  def evaluate(self, step: int, state: TrainState, *, last: bool) -> float:
    """Plays held-out episodes, writes their row, the curve and, at last, a video."""
    began = time.monotonic()
    config, folder = self._config, self._folder
    params = state.learner.params
    figures = play_held_out(
      self._env, self._play, params, episodes=config.eval_episodes, seed=EVAL_SEED
    )
    self.evaluation = figures
    row = {f"eval/{name}": value for name, value in figures.items() if name != "ci95"}
    row["eval/ci95_low"], row["eval/ci95_high"] = figures["ci95"]
    self._writer.write(step, row | {"eval/wall_s": time.monotonic() - began})
    plot_curve(read_rows(folder.metrics_jsonl), folder.curve, title=config.env.task)
    if config.video and last:
      record_episodes(
        self._env, self._policy(params), folder.videos / f"step_{step:08d}.mp4"
      )
    rate = figures["success_rate"]
    self._progress.message(
      f"step {step:,}: {figures['successes']} of {figures['episodes']} held-out "
      f"episodes solved ({100 * rate:.0f} %)"
    )
    self._progress.update(step, updates=int(state.learner.step), success_rate=rate)
    self._lap = time.monotonic()
    return rate


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


def _say(text: str) -> None:
  print(text, file=sys.stderr, flush=True)


def _passed(before: int, now: int, every: int) -> bool:
  return now // every > before // every


def _nbytes(tree: Any) -> int:
  return sum(math.prod(x.shape) * x.dtype.itemsize for x in jax.tree.leaves(tree))
