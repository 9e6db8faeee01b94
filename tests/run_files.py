"""Run folders with made-up results, for tests of what reads them."""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import json
from pathlib import Path
from typing import Any

from apnpql_jax.config.files import config_to_json
from apnpql_jax.config.schema import TrainConfig

EPISODES = 50


def make_run(
  folder: Path,
  rates: Sequence[float],
  *,
  seed: int = 0,
  task: str = "push_plate",
  every: int = 1000,
  minutes: float = 1.0,
  finished: bool = True,
  agent: dict[str, Any] | None = None,
  **settings: Any,
) -> Path:
  """Makes a run that was evaluated every so many steps and minutes."""
  config = TrainConfig(seed=seed, total_steps=every * max(1, len(rates)), **settings)
  config = dataclasses.replace(
    config,
    env=dataclasses.replace(config.env, task=task),
    agent=dataclasses.replace(config.agent, **(agent or {})),
  )
  folder.mkdir(parents=True)
  (folder / "config.json").write_text(config_to_json(config))
  (folder / "versions.json").write_text(json.dumps({"git": {"commit": "abcdef012345"}}))
  rows = []
  for index, rate in enumerate(rates, start=1):
    row = {"step": index * every, "time/wall_s": 60 * minutes * index}
    rows += [{**row, "loss/q": 1.0}]
    rows += [{**row, "eval/success_rate": rate, "eval/episodes": EPISODES}]
  text = "".join(json.dumps(row) + "\n" for row in rows)
  (folder / "metrics.jsonl").write_text(text)
  if finished:
    (folder / "checkpoints" / str(config.total_steps)).mkdir(parents=True)
  return folder
