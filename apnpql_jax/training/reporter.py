"""Reports of a run while it trains: metrics, progress, evaluations, curve and video."""

from __future__ import annotations

from pathlib import Path
import time
from typing import Any

import jax

from apnpql_jax import devices
from apnpql_jax.agents.learner import Agent
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.console import reporting
from apnpql_jax.envs.env import Env
from apnpql_jax.reports.figure import plot_curve
from apnpql_jax.runs.metrics import MetricWriter, read_evaluations
from apnpql_jax.runs.progress import TrainProgress
from apnpql_jax.training.evaluate import figures_of, play_held_out
from apnpql_jax.training.rollout import agent_policy, make_player
from apnpql_jax.training.state import TrainState
from apnpql_jax.training.video import record_episodes

EVAL_SEED = 1
"""Seed of evaluations during training, which all play the same held-out episodes."""


class Reporter:
  """Writer and display of a run; only the first process has one."""

  def __init__(
    self,
    config: TrainConfig,
    env: Env,
    agent: Agent,
    run_dir: Path,
    writer: MetricWriter,
    progress: TrainProgress,
  ):
    """Builds the player of evaluations without compiling it."""
    self._config, self._env, self._run_dir = config, env, run_dir
    self.writer, self._progress = writer, progress
    self._play = make_player(
      env, lambda params: agent_policy(agent, params, acting=config.eval_acting)
    )
    self._lap = time.monotonic()
    self.evaluation: dict[str, Any] = {}

  def iteration(self, step: int, updates: int, metrics: dict[str, Any]) -> None:
    """Writes the metrics of one iteration; blocks until they are computed."""
    metrics = jax.device_get(metrics)
    now = time.monotonic()
    seconds, self._lap = now - self._lap, now
    config = self._config
    steps = config.rollout_length * config.env.worlds
    metrics["time/sps_e2e"] = steps / seconds
    metrics["time/updates_per_s"] = config.updates_per_iteration / seconds
    self.writer.write(step, metrics)
    self._progress.update(step, updates=updates)

  def evaluate(self, step: int, state: TrainState, *, last: bool) -> float:
    """Plays held-out episodes; writes metrics, the curve and, at the end, a video."""
    with self._progress.evaluation():
      rate = self._evaluate(step, state, last)
    self._progress.update(step, updates=int(state.learner.step), success_rate=rate)
    self._lap = time.monotonic()
    return rate

  def _evaluate(self, step: int, state: TrainState, last: bool) -> float:
    began = time.monotonic()
    config, run_dir = self._config, self._run_dir
    params = devices.local(state.learner.target_params)
    played = play_held_out(
      self._env, self._play, params, episodes=config.eval_episodes, seed=EVAL_SEED
    )
    self.evaluation = figures = figures_of(played)
    row = {f"eval/{name}": value for name, value in figures.items() if name != "ci95"}
    row["eval/ci95_low"], row["eval/ci95_high"] = figures["ci95"]
    self.writer.write(step, row | {"eval/wall_s": time.monotonic() - began})
    with reporting("draw the curve"):
      rows = read_evaluations(run_dir)
      plot_curve(rows, run_dir / "curve.png", title=config.env.task)
    if config.video and last:
      with reporting("write the video"):
        record_episodes(self._env, played, run_dir / "videos" / f"step_{step:08d}.mp4")
    rate = figures["success_rate"]
    self._progress.message(
      f"step {step:,}: {figures['successes']} of {figures['episodes']} held-out "
      f"episodes solved ({100 * rate:.0f} %)"
    )
    return rate
