"""Contact sheet of randomized worlds: docs/images/randomization.png.

  python -m benchmarks.quality.randomization_sheet

Each task has a row. A tile is the global image above that of the wrist camera, after
the expert has played for a while. Settings of the worlds are those of `apnpql train`,
such as --env.randomization.color 0.3.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
import tyro

from apnpql_jax import runtime
from apnpql_jax.config import EnvConfig
from apnpql_jax.env import make_env
from apnpql_jax.rollout import expert_policy, rollout
from apnpql_jax.tasks import task_names
from benchmarks.common import store

PERIODS, GAP = 12, 4
"""Control periods that the expert plays, and white pixels between tiles."""


@dataclasses.dataclass(frozen=True)
class Sheet:
  """Settings of the contact sheet."""

  worlds: int = 6
  """Worlds of each task."""

  out: Path = store.ROOT / "docs" / "images" / "randomization.png"
  """File to write."""

  env: EnvConfig = EnvConfig(
    backend="native", global_size=(144, 192), wrist_size=(72, 128), shadows=True
  )
  """Settings of the worlds, which are randomized; the task is not used."""


def main() -> None:
  """Runs the command line; see the module's docstring."""
  runtime.configure()
  sheet = tyro.cli(Sheet, description=(__doc__ or "").splitlines()[0])
  rows = [draw(sheet, task, number) for number, task in enumerate(task_names())]
  iio.imwrite(sheet.out, np.concatenate(rows))


def draw(sheet: Sheet, task: str, number: int) -> np.ndarray:
  """Returns a row of tiles, u8[H, W, 3]."""
  changes = {"task": task, "worlds": sheet.worlds, "randomize": True}
  env = make_env(dataclasses.replace(sheet.env, **changes))
  policy = expert_policy(env, noise=0.0)
  play = jax.jit(lambda state, key: rollout(env, policy, state, key, length=PERIODS)[0])
  rows = number * sheet.worlds + jnp.arange(sheet.worlds)
  observation = play(env.reset(rows), jax.random.key(0)).timestep.observation
  tiles = zip(observation.global_image, observation.wrist_image, strict=True)
  return np.concatenate([_tile(*map(np.asarray, pair)) for pair in tiles], axis=1)


def _tile(*images: np.ndarray) -> np.ndarray:
  """Centers images in a column with a white margin."""
  width, rows = GAP + max(image.shape[1] for image in images), []
  for image in images:
    free = width - image.shape[1]
    margin = ((GAP // 2, GAP // 2), (free // 2, free - free // 2), (0, 0))
    rows.append(np.pad(image, margin, constant_values=255))
  return np.concatenate(rows)


if __name__ == "__main__":
  main()
