"""Scripted experts, scenes and reset banks of all tasks: figures of docs/tasks.md.

  python -m benchmarks.quality.tasks --episodes 512    # hours on two cores, for MJX
  python -m benchmarks.quality.tasks --backends native --tasks flip_cup

Writes results/tasks/<task>-<backend>.json, and from all files there the tables of
docs/tasks.md; also docs/tasks/<task>.png and .mp4.
"""

import argparse
import json
from pathlib import Path
import time

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax import runtime
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.primitives.reset_bank import load_bank
from apnpql_jax.tasks import make_task, task_names
from apnpql_jax.tasks.contact_report import contact_report
from apnpql_jax.training.evaluate import evaluate_expert
from apnpql_jax.training.rollout import FILMED, expert_policy, make_player
from apnpql_jax.training.video import record_episodes, render_episodes
from benchmarks.common import settings, store, tables

RESULTS = store.RESULTS / "tasks"
DOC = store.ROOT / "docs" / "tasks.md"
INSTANTS, MARGIN = 4, 6
"""Instants of an episode in a picture, and white pixels around each."""
EXPERTS = "task|backend|solved|rate (95 %)|periods"
BANKS = "bank of resets|rows|draws rejected|residual of mink|built in|loaded in"


def main() -> None:
  parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
  parser.add_argument("--tasks", nargs="+", choices=task_names(), default=task_names())
  engines = settings.ENGINES
  parser.add_argument("--backends", nargs="+", choices=engines, default=engines)
  parser.add_argument("--episodes", type=int, default=512)
  parser.add_argument("--seed", type=int, default=0)
  args = parser.parse_args()
  runtime.configure()
  # Speeds first: episodes take hours, and the machine will not stay idle.
  engines = args.backends
  reports = {k: contact_report(make_task(k), backends=engines) for k in args.tasks}
  for name, report in reports.items():
    for backend in engines:
      config = EnvConfig(task=name, backend=backend, obs="state")
      measured = measure(config, report, args.episodes, args.seed)
      store.store(f"tasks/{name}-{backend}", measured)
      solved = f"{measured['successes']} of {measured['episodes']}"
      print(name, backend, solved, flush=True)
    show(make_env(EnvConfig(task=name, backend="native", obs="state")))
  write_tables()


def measure(config: EnvConfig, contacts: dict, episodes: int, seed: int) -> dict:
  """Returns the figures of one task on one engine, with the machine."""
  figures = evaluate_expert(config, episodes=episodes, seed=seed, noise=0.0)
  built = make_task(config.task)
  began = time.perf_counter()
  bank, report = load_bank(built, config.bank_rows)
  loaded = {"rows": bank.rows, "load_seconds": time.perf_counter() - began}
  bank_figures = {"bank": loaded | vars(report)}
  return {**figures, "contacts": contacts, **bank_figures, **store.machine()}


def show(env: Env) -> None:
  """Writes the expert's picture and video."""
  play = make_player(env, lambda _: expert_policy(env, noise=0.0))
  played = play(None, env.bank_split + jnp.arange(FILMED), jax.random.key(0))
  folder = store.ROOT / "docs" / "tasks"
  record_episodes(env, played, folder / f"{env.task.name}.mp4")
  episode = render_episodes(env, played)[0]
  chosen = np.linspace(0, len(episode) - 1, INSTANTS).round().astype(int)
  around = (0, 0), (MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0)
  framed = np.pad(episode[chosen], around, constant_values=255)
  rows = [np.concatenate(list(pair), axis=1) for pair in np.split(framed, 2)]
  iio.imwrite(folder / f"{env.task.name}.png", np.concatenate(rows))


def write_tables(doc: Path = DOC) -> None:
  """Writes the tables of all stored results into docs/tasks.md."""
  results = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("*.json"))]
  experts = tables.table(EXPERTS.split("|"), map(expert_row, results))
  tables.put("experts", experts, doc)
  banks = {result["task"]: result["bank"] for result in results}
  rows = map(bank_row, banks, banks.values())
  tables.put("banks", tables.table(BANKS.split("|"), rows), doc)


def expert_row(result: dict) -> list[object]:
  """Returns the expert's success on one engine."""
  rate, low, high = (100 * x for x in (result["success_rate"], *result["ci95"]))
  return [
    *(result["task"], result["backend"]),
    f"{result['successes']} of {result['episodes']}",
    f"{rate:.1f} % ({low:.1f} to {high:.1f})",
    result["mean_length"],
  ]


def bank_row(task: str, bank: dict) -> list[str]:
  """Returns how the reset states of a task were built."""
  rejected = bank["rejected_restless"] + bank["rejected_unreachable"]
  degrees = np.degrees(bank["max_rotation_residual"])
  return [
    task,
    f"{bank['rows']:,}",
    f"{rejected} of {bank['drawn']:,}",
    f"{1e3 * bank['max_position_residual']:.2f} mm, {degrees:.3f} degrees",
    f"{bank['seconds']:.0f} s",
    f"{bank['load_seconds']:.2f} s",
  ]


if __name__ == "__main__":
  main()
