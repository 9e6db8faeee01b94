"""Contact sheet of randomized worlds: docs/images/randomization.png.

  python -m benchmarks.quality.randomization_sheet

Each task has a row. A tile is the global image above that of the wrist camera, after
the expert has played for a while.
"""

from typing import Any

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax import runtime
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.env import make_env
from apnpql_jax.tasks import task_names
from apnpql_jax.training.rollout import expert_policy, rollout
from benchmarks.common import store

OUT = store.ROOT / "docs" / "images" / "randomization.png"
LOOKS: dict[str, Any] = {"global_size": (144, 192), "wrist_size": (72, 128)}
LOOKS |= {"randomize": True, "backend": "native"}
WORLDS, PERIODS, GAP = 6, 12, 4
"""Worlds of a task, periods that the expert plays, white pixels between tiles."""


def main() -> None:
  runtime.configure()
  rows = [draw(task, number) for number, task in enumerate(task_names())]
  iio.imwrite(OUT, np.concatenate(rows))


def draw(task: str, number: int) -> np.ndarray:
  """Returns a row of tiles, u8[H, W, 3]."""
  env = make_env(EnvConfig(task=task, worlds=WORLDS, **LOOKS))
  policy = expert_policy(env, noise=0.0)
  play = jax.jit(lambda state, key: rollout(env, policy, state, key, length=PERIODS)[0])
  rows = number * WORLDS + jnp.arange(WORLDS)
  observation = play(env.reset(rows), jax.random.key(0)).timestep.observation
  tiles = zip(observation.global_image, observation.wrist_image, strict=True)
  return np.concatenate([tile(*map(np.asarray, pair)) for pair in tiles], axis=1)


def tile(*images: np.ndarray) -> np.ndarray:
  """Centers images in a column with a white margin."""
  width, rows = GAP + max(image.shape[1] for image in images), []
  for image in images:
    free = width - image.shape[1]
    margin = ((GAP // 2, GAP // 2), (free // 2, free - free // 2), (0, 0))
    rows.append(np.pad(image, margin, constant_values=255))
  return np.concatenate(rows)


if __name__ == "__main__":
  main()
