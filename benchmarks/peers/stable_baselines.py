"""Minutes to 80 % of push_plate from states: Stable-Baselines3's SAC and this project.

  python -m benchmarks.peers.stable_baselines --store

Both see the same observations, have as many transitions of the scripted expert, and
play the same held-out episodes. SAC is that of ``apnpql_jax.gym.sac``, in worlds that
one program steps. Ours is the preset. Minutes count from the start of learning, with
evaluations, and with the compilation that imports and the expert's play do not cover.
"""

import argparse
from collections.abc import Iterator
import dataclasses
from pathlib import Path
import tempfile
import time
from typing import Any

from apnpql_jax import runtime, testing
from apnpql_jax.config.files import load_preset
from apnpql_jax.training.train import train
from benchmarks.common import command, settings

TASK, SOLVED = "push_plate", 0.8
EVAL_EVERY = 2_560
_RATE = "eval/success_rate"


def main() -> None:
  parser = command.parser(__doc__)
  flag = parser.add_argument
  flag("--rows", nargs="+", choices=ROWS, default=list(ROWS))
  flag("--worlds", type=int, default=16, help="that SAC steps at once")
  flag("--updates", type=int, default=8, help="of SAC after each step of the worlds")
  flag("--minutes", type=float, default=30.0, help="after which SAC is stopped")
  flag("--episodes", type=int, default=64, help="of an evaluation")
  flag("--seed", type=int, default=0)
  args = command.parse(parser)
  if args.quick:
    args.worlds, args.minutes, args.episodes = 2, 0.05, 2
  sizes = {name: getattr(args, name) for name in ("worlds", "updates", "episodes")}
  command.publish("stable_baselines", args, measure_all(args), task=TASK, **sizes)


def measure_all(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
  """Yields the curve of each row."""
  for name in args.rows:
    curve = ROWS[name](args)
    solved = [point["minutes"] for point in curve if point["success_rate"] >= SOLVED]
    yield {"row": name, "minutes_to_80": min(solved, default=None), "curve": curve}


def sac(args: argparse.Namespace) -> list[dict[str, float]]:
  """Trains SAC until it has solved 80 % or its time is over."""
  from stable_baselines3.common.callbacks import BaseCallback

  from apnpql_jax.gym.sac import held_out_worlds, make_sac, success_rate

  held_out = held_out_worlds(TASK, args.episodes)
  learner = make_sac(TASK, worlds=args.worlds, updates=args.updates, seed=args.seed)
  curve: list[dict[str, float]] = []

  class Evaluations(BaseCallback):
    """Evaluations as often as ours, until the goal or the end of the time."""

    def _on_training_start(self) -> None:
      self.began = time.monotonic()

    def _on_step(self) -> bool:
      if self.num_timesteps // EVAL_EVERY > len(curve):
        rate = success_rate(learner, held_out)
        minutes = (time.monotonic() - self.began) / 60
        point = {"steps": self.num_timesteps, "minutes": minutes, "success_rate": rate}
        curve.append(point)
        print(point, flush=True)
        if rate >= SOLVED:
          return False
      return time.monotonic() - self.began < 60 * args.minutes

  learner.learn(10**9, callback=Evaluations())
  return curve


def ours(args: argparse.Namespace) -> list[dict[str, float]]:
  """Trains the preset from states."""
  config = testing.TINY
  if not args.quick:
    config = settings.changed(load_preset(TASK), "env", obs="state")
  episodes, never = args.episodes, 10**9
  config = dataclasses.replace(
    config, seed=args.seed, video=False, eval_every=EVAL_EVERY
  )
  config = dataclasses.replace(config, eval_episodes=episodes, checkpoint_every=never)
  with tempfile.TemporaryDirectory() as folder:
    run = Path(folder) / "run"
    train(config, run)
    rows = testing.rows(run)
  names = {"step": "steps", "time/wall_s": "minutes", _RATE: "success_rate"}
  curve = [
    {new: row[old] for old, new in names.items()} for row in rows if _RATE in row
  ]
  return [point | {"minutes": point["minutes"] / 60} for point in curve]


ROWS = {"sac": sac, "apnpql": ours}

if __name__ == "__main__":
  runtime.configure()
  main()
