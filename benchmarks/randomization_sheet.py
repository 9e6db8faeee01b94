"""Contact sheet of randomised worlds: docs/images/randomization.png.

  python benchmarks/randomization_sheet.py

A row for each task; a tile is the global image over that of the wrist camera, after the
expert has played for a while. Any setting of the worlds can be given as to `apnpql
train`, such as --env.randomization.color 0.3.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)
import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
import tyro

from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.env import make_env
from apnpql_jax.tasks import task_names
from apnpql_jax.training.rollout import expert_policy, rollout

OUT = Path(__file__).resolve().parents[1] / "docs" / "images" / "randomization.png"
PERIODS = 12
GAP = 4
"""White pixels between tiles."""


@dataclasses.dataclass(frozen=True)
class Sheet:
  """Draws randomised worlds of all tasks."""

  worlds: int = 6
  """Worlds of each task."""

  out: Path = OUT
  """File to write."""

  env: EnvConfig = EnvConfig(
    backend="native",
    global_size=(144, 192),
    wrist_size=(72, 128),
    shadows=True,
    randomize=True,
  )
  """Of the worlds; the task is not used."""


def main() -> None:
  """Command line; see the module's docstring."""
  sheet = tyro.cli(Sheet, description=(__doc__ or "").splitlines()[0])
  rows = [draw(sheet, task, number) for number, task in enumerate(task_names())]
  sheet.out.parent.mkdir(parents=True, exist_ok=True)
  iio.imwrite(sheet.out, np.concatenate(rows))


def draw(sheet: Sheet, task: str, number: int) -> np.ndarray:
  """u8[H, W, 3]: a row of tiles."""
  env = make_env(dataclasses.replace(sheet.env, task=task, worlds=sheet.worlds))
  policy = expert_policy(env, noise=0.0)
  play = jax.jit(lambda state, key: rollout(env, policy, state, key, length=PERIODS)[0])
  rows = number * sheet.worlds + jnp.arange(sheet.worlds)
  observation = play(env.reset(rows), jax.random.key(0)).timestep.observation
  tiles = zip(observation.global_image, observation.wrist_image, strict=True)
  return np.concatenate([_tile(*map(np.asarray, pair)) for pair in tiles], axis=1)


def _tile(overview: np.ndarray, wrist: np.ndarray) -> np.ndarray:
  """Both images in the middle of a column, with a white margin."""
  width = GAP + max(overview.shape[1], wrist.shape[1])
  columns = []
  for image in (overview, wrist):
    free = width - image.shape[1]
    margin = ((GAP // 2, GAP // 2), (free // 2, free - free // 2), (0, 0))
    columns.append(np.pad(image, margin, constant_values=255))
  return np.concatenate(columns)


if __name__ == "__main__":
  main()
