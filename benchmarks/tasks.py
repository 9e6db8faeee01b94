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
import os
from pathlib import Path

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)
import imageio.v3 as iio
import jax
import mujoco
import numpy as np

from apnpql_jax.config import EnvConfig
from apnpql_jax.contact_report import contact_report
from apnpql_jax.env import Env, make_env
from apnpql_jax.evaluate import evaluate_expert
from apnpql_jax.primitives.bank import load_bank
from apnpql_jax.recording import film, record_episodes
from apnpql_jax.rollout import expert_policy
from apnpql_jax.tasks import make_task, task_names

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "tasks"
DOC = ROOT / "docs" / "tasks.md"
INSTANTS = 4
"""Instants of an episode in a picture."""


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
  RESULTS.mkdir(parents=True, exist_ok=True)
  for task in args.tasks:
    for backend in args.backends:
      measured = measure(task, backend, episodes=args.episodes, seed=args.seed)
      path = RESULTS / f"{task}-{backend}.json"
      path.write_text(json.dumps(measured, indent=2) + "\n")
      print(path.name, measured["successes"], "of", measured["episodes"], flush=True)
    show(make_env(EnvConfig(task=task, backend="native", obs="state")))
  write_table()


def measure(task: str, backend: str, *, episodes: int, seed: int) -> dict:
  """What the table says of one task on one engine, and what it was measured with."""
  config = EnvConfig(task=task, backend=backend, obs="state")
  figures = evaluate_expert(config, episodes=episodes, seed=seed, noise=0.0)
  built = make_task(task)
  bank, report = load_bank(built, config.bank_rows)
  return {
    **figures,
    "contacts": contact_report(built, backends=(backend,)),
    "bank": {"rows": bank.rows, **vars(report)},
    "device": jax.devices()[0].device_kind,
    "cores": len(os.sched_getaffinity(0)),
    "versions": {module.__name__: module.__version__ for module in (jax, mujoco)},
  }


def show(env: Env) -> None:
  """The expert's picture and video."""
  policy = expert_policy(env, noise=0.0)
  folder = ROOT / "docs" / "tasks"
  record_episodes(env, policy, folder / f"{env.task.name}.mp4")
  episode = film(env, policy, view_size=(288, 384))[0]
  chosen = np.linspace(0, len(episode) - 1, INSTANTS).round().astype(int)
  rows = [np.concatenate(list(episode[pair]), axis=1) for pair in chosen.reshape(2, -1)]
  iio.imwrite(folder / f"{env.task.name}.png", np.concatenate(rows))


def write_table() -> None:
  """Puts the table of all results at hand between the marks in docs/tasks.md."""
  head = (
    "| task | backend | solved | rate (95 %) | periods | physics steps/s | pairs "
    "| contact slots | rows | draws rejected |"
  )
  lines = [head, "|---" * 10 + "|"]
  for path in sorted(RESULTS.glob("*.json")):
    r = json.loads(path.read_text())
    low, high = r["ci95"]
    contacts, bank = r["contacts"], r["bank"]
    rejected = bank["rejected_restless"] + bank["rejected_unreachable"]
    lines.append(
      f"| {r['task']} | {r['backend']} | {r['successes']} of {r['episodes']} "
      f"| {100 * r['success_rate']:.1f} % ({100 * low:.1f} to {100 * high:.1f}) "
      f"| {r['mean_length']:.1f} | {contacts[r['backend'] + '_steps_per_s']:,.0f} "
      f"| {contacts['pairs']} | {contacts['contacts']} | {contacts['constraint_rows']} "
      f"| {rejected} of {bank['drawn']} |"
    )
  text = DOC.read_text()
  before, _, rest = text.partition("<!-- table -->")
  _, _, after = rest.partition("<!-- end -->")
  table = "\n".join(lines)
  DOC.write_text(f"{before}<!-- table -->\n{table}\n<!-- end -->{after}")


if __name__ == "__main__":
  main()
