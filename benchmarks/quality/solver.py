"""Solver iterations and contacts that the tasks need: the sweeps behind the scenes.

  python -m benchmarks.quality.solver --episodes 64       # half an hour on two cores
  python -m benchmarks.quality.solver --tasks flip_cup --settings 20x20 10x10 10x10x16

A setting is ITERATIONSxLS_ITERATIONS, or that and xMAX_CONTACT_POINTS (of MJX, of each
condim); the scene's own limit applies otherwise. For each setting the scripted expert
plays held-out episodes on one engine, and the speed of the scene is measured. Results
are added to results/solver.json and replace those of the same task, engine and setting.
"""

import argparse
import dataclasses
import json

from apnpql_jax import runtime
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.env import Env
from apnpql_jax.primitives.reset_bank import load_bank
from apnpql_jax.tasks import make_task, task_names
from apnpql_jax.tasks.contact_report import contact_report
from apnpql_jax.training.evaluate import play_held_out
from apnpql_jax.training.rollout import expert_policy, make_player
from benchmarks.common import settings, store

SETTINGS = ["20x20", "10x10", "5x10", "5x5", "3x10", "10x10x999", "10x10x16", "10x10x8"]


def main() -> None:
  parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
  parser.add_argument("--tasks", nargs="+", choices=task_names(), default=task_names())
  parser.add_argument("--backend", choices=settings.ENGINES, default="mjx")
  parser.add_argument("--settings", nargs="+", default=SETTINGS)
  parser.add_argument("--episodes", type=int, default=64)
  args = parser.parse_args()
  runtime.configure()
  path = store.RESULTS / "solver.json"
  results = json.loads(path.read_text()) if path.exists() else {}
  for task in args.tasks:
    for setting in args.settings:
      name = f"{task} {args.backend} {setting}"
      results[name] = measure(task, args.backend, setting, args.episodes)
      print(name, results[name], flush=True)
      store.write(path, dict(sorted(results.items())))


def measure(name: str, backend: str, setting: str, episodes: int) -> dict[str, float]:
  """Returns the expert's successes and the physics steps per second."""
  task = make_task(name)
  config = EnvConfig(task=name, backend=backend, obs="state")
  bank, _ = load_bank(task, config.bank_rows)  # The same resets for all settings.
  model = task.scene.model
  iterations, ls_iterations, *contacts = map(int, setting.split("x"))
  model.opt.iterations, model.opt.ls_iterations = iterations, ls_iterations
  model.numeric("mjx_ls_iterations").data[:] = ls_iterations
  if contacts:
    model.numeric("max_contact_points").data[:] = contacts
  # A new fingerprint, because C MuJoCo is set up once for each.
  fingerprint = f"{name} {setting}"
  task.scene = dataclasses.replace(task.scene, fingerprint=fingerprint)
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
