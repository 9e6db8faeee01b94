"""How few solver iterations and contacts the tasks can bear: the sweeps behind mjcf.

  python benchmarks/solver.py --episodes 64           # half an hour on two cores
  python benchmarks/solver.py --tasks flip_cup --settings 20x20 10x10 10x10x16

A setting is ITERATIONSxLS_ITERATIONS, or that and xMAX_CONTACT_POINTS (of MJX, of each
condim), which is the scene's if left out. For each, the scripted expert plays held-out
episodes on one engine, and the scene's speed is measured. Adds to results/solver.json
beside this file, in place of what was there for the same task, engine and setting.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)

from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.contact_report import contact_report
from apnpql_jax.envs.env import Env
from apnpql_jax.primitives.reset_bank import load_bank
from apnpql_jax.tasks import make_task, task_names
from apnpql_jax.training.evaluate import play_held_out
from apnpql_jax.training.rollout import expert_policy, make_player

RESULT = Path(__file__).resolve().parent / "results" / "solver.json"
SETTINGS = ["20x20", "10x10", "5x10", "5x5", "3x10", "10x10x999", "10x10x16", "10x10x8"]


def main() -> None:
  """Command line; see the module's docstring."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("--tasks", nargs="+", choices=task_names(), default=task_names())
  parser.add_argument("--backend", choices=["native", "mjx"], default="mjx")
  parser.add_argument("--settings", nargs="+", default=SETTINGS)
  parser.add_argument("--episodes", type=int, default=64)
  args = parser.parse_args()
  RESULT.parent.mkdir(exist_ok=True)
  results = json.loads(RESULT.read_text()) if RESULT.exists() else {}
  for task in args.tasks:
    for setting in args.settings:
      figures = measure(task, args.backend, setting, args.episodes)
      name = f"{task} {args.backend} {setting}"
      print(name, figures, flush=True)
      results[name] = figures
      RESULT.write_text(json.dumps(results, indent=2, sort_keys=True) + "\n")


def measure(name: str, backend: str, setting: str, episodes: int) -> dict[str, float]:
  """The expert's successes and the physics steps per second under one setting."""
  task = make_task(name)
  config = EnvConfig(task=name, backend=backend, obs="state")
  bank, _ = load_bank(task, config.bank_rows)  # As shipped: the same resets for all.
  model = task.scene.model
  iterations, ls_iterations, *contacts = map(int, setting.split("x"))
  model.opt.iterations = iterations
  model.opt.ls_iterations = ls_iterations
  model.numeric("mjx_ls_iterations").data[:] = ls_iterations
  if contacts:
    model.numeric("max_contact_points").data[:] = contacts
  # Otherwise C MuJoCo would be called as it was first set up for this scene.
  task.scene = dataclasses.replace(task.scene, fingerprint=setting)
  env = Env(config, task, bank)
  play = make_player(env, lambda _: expert_policy(env, noise=0.0))
  played = play_held_out(env, play, None, episodes=episodes, seed=0)
  report = contact_report(task, backends=(backend,))
  return {
    "episodes": episodes,
    "successes": int(played.success.sum()),
    "mean_length": float(played.length.mean()),
    "steps_per_s": report[f"{backend}_steps_per_s"],
  }


if __name__ == "__main__":
  main()
