"""Every task and its scripted expert: table, picture and video of docs/tasks.md.

  python benchmarks/tasks.py --episodes 512            # hours on two cores, for MJX
  python benchmarks/tasks.py --backends native --tasks flip_cup

Writes results/tasks/<task>-<backend>.json beside this file, whatever was there for
other tasks and backends stays, and from all of them the table in docs/tasks.md; also
docs/tasks/<task>.png and .mp4.
"""

from __future__ import annotations

import argparse
import json
import time

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)
import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
import tables

from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.contact_report import contact_report
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.primitives.reset_bank import load_bank
from apnpql_jax.tasks import make_task, task_names
from apnpql_jax.training.evaluate import evaluate_expert
from apnpql_jax.training.rollout import FILMED, expert_policy, make_player
from apnpql_jax.training.video import film, record_episodes

RESULTS = tables.RESULTS / "tasks"
DOC = tables.ROOT / "docs" / "tasks.md"
INSTANTS = 4
"""Instants of an episode in a picture."""
MARGIN = 6
"""White pixels around each."""
EXPERTS_HEAD = (
  "task",
  "backend",
  "solved",
  "rate (95 %)",
  "periods",
  "pairs",
  "contact slots",
  "rows",
  "physics steps/s",
)
BANKS_HEAD = (
  "bank of resets",
  "rows",
  "draws rejected",
  "residual of mink",
  "built in",
  "loaded in",
)


def main() -> None:
  """Command line; see the module's docstring."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("--tasks", nargs="+", choices=task_names(), default=task_names())
  parser.add_argument(
    "--backends", nargs="+", choices=["native", "mjx"], default=["native", "mjx"]
  )
  parser.add_argument("--episodes", type=int, default=512)
  parser.add_argument("--seed", type=int, default=0)
  args = parser.parse_args()
  # Speeds first: episodes take so long that something else will run beside them.
  reports = {}
  for name in args.tasks:
    reports[name] = contact_report(make_task(name), backends=args.backends)
    print(name, reports[name], flush=True)
  for name, report in reports.items():
    for backend in args.backends:
      config = EnvConfig(task=name, backend=backend, obs="state")
      measured = measure(config, report, episodes=args.episodes, seed=args.seed)
      tables.store(f"tasks/{name}-{backend}", measured)
      print(
        name, backend, measured["successes"], "of", measured["episodes"], flush=True
      )
    show(make_env(EnvConfig(task=name, backend="native", obs="state")))
  write_table()


def measure(
  config: EnvConfig, contacts: dict[str, float], *, episodes: int, seed: int
) -> dict:
  """What the table says of one task on one engine, and what it was measured with."""
  figures = evaluate_expert(config, episodes=episodes, seed=seed, noise=0.0)
  built = make_task(config.task)
  began = time.perf_counter()
  bank, report = load_bank(built, config.bank_rows)
  load_seconds = time.perf_counter() - began
  return {
    **figures,
    "contacts": contacts,
    "bank": {"rows": bank.rows, "load_seconds": load_seconds, **vars(report)},
    **tables.machine(),
  }


def show(env: Env) -> None:
  """The expert's picture and video."""
  play = make_player(env, lambda _: expert_policy(env, noise=0.0))
  played = play(None, env.bank_split + jnp.arange(FILMED), jax.random.key(0))
  folder = tables.ROOT / "docs" / "tasks"
  record_episodes(env, played, folder / f"{env.task.name}.mp4")
  episode = film(env, played)[0]
  chosen = np.linspace(0, len(episode) - 1, INSTANTS).round().astype(int)
  around = (0, 0), (MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0)
  framed = np.pad(episode[chosen], around, constant_values=255)
  rows = [np.concatenate(list(pair), axis=1) for pair in np.split(framed, 2)]
  iio.imwrite(folder / f"{env.task.name}.png", np.concatenate(rows))


def write_table() -> None:
  """Puts the tables of all results at hand between the marks in docs/tasks.md."""
  results = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("*.json"))]
  banks = {result["task"]: result["bank"] for result in results}
  tables.put("experts", tables.table(EXPERTS_HEAD, map(expert_row, results)), DOC)
  tables.put(
    "banks", tables.table(BANKS_HEAD, map(bank_row, banks, banks.values())), DOC
  )


def expert_row(result: dict) -> list[object]:
  """How the expert did and what the scene costs, on one engine."""
  low, high = result["ci95"]
  contacts = result["contacts"]
  return [
    result["task"],
    result["backend"],
    f"{result['successes']} of {result['episodes']}",
    f"{100 * result['success_rate']:.1f} % ({100 * low:.1f} to {100 * high:.1f})",
    result["mean_length"],
    *(contacts[key] for key in ("pairs", "contacts", "constraint_rows")),
    contacts[result["backend"] + "_steps_per_s"],
  ]


def bank_row(task: str, bank: dict) -> list[object]:
  """How the reset states came about."""
  rejected = bank["rejected_restless"] + bank["rejected_unreachable"]
  return [
    task,
    f"{bank['rows']:,}",
    f"{rejected} of {bank['drawn']:,}",
    f"{1e3 * bank['max_position_residual']:.2f} mm, "
    f"{np.degrees(bank['max_rotation_residual']):.3f} degrees",
    f"{bank['seconds']:.0f} s",
    f"{bank['load_seconds']:.2f} s",
  ]


if __name__ == "__main__":
  main()
