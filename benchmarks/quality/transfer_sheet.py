"""Contact sheet of the worlds of ``apnpql transfer``: docs/images/transfer.png.

  python -m benchmarks.quality.transfer_sheet

Six worlds of stack_box after twelve periods of the expert, the global image above that
of the wrist camera. From the top: rays, OpenGL with plain looks, OpenGL with the draws
of the randomizer, OpenGL with unseen looks.
"""

import dataclasses
from typing import Any

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax import runtime
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.env import make_env
from apnpql_jax.training.rollout import expert_policy, rollout
from apnpql_jax.transfer.opengl import OpenGL
from apnpql_jax.transfer.transfer import make_draw
from benchmarks.common import store
from benchmarks.quality.randomization_sheet import PERIODS, WORLDS, tile

OUT = store.ROOT / "docs" / "images" / "transfer.png"
SIZES: dict[str, Any] = {"global_size": (144, 192), "wrist_size": (72, 128)}
ROWS = np.arange(WORLDS)


def main() -> None:
  runtime.configure()
  config = EnvConfig(
    "stack_box", worlds=WORLDS, backend="native", bank_rows=256, **SIZES
  )
  iio.imwrite(OUT, np.concatenate(list(sheet(config))))


def sheet(config: EnvConfig) -> list[np.ndarray]:
  """Returns the rows of tiles, u8[H, W, 3] each."""
  rows = []
  for randomize in (False, True):
    env = make_env(dataclasses.replace(config, randomize=randomize))
    policy = expert_policy(env, noise=0.0)
    play = jax.jit(lambda s, k: rollout(env, policy, s, k, length=PERIODS)[0])  # noqa: B023
    state = play(env.reset(jnp.asarray(ROWS)), jax.random.key(0))
    if not randomize:
      seen = state.timestep.observation
      rows.append(joined(seen.global_image, seen.wrist_image))
    for unseen in (False,) if randomize else (False, True):
      with OpenGL(env.task.scene, config, unseen=unseen) as gl:
        images = make_draw(env, gl)(state.physics, ROWS, np.ones(WORLDS, bool), PERIODS)
        rows.append(joined(*images))
  return [*rows[:2], rows[3], rows[2]]


def joined(overviews: jax.Array, wrists: jax.Array) -> np.ndarray:
  """Returns a row of tiles, one per world."""
  pairs = zip(np.asarray(overviews), np.asarray(wrists), strict=True)
  return np.concatenate([tile(*pair) for pair in pairs], axis=1)


if __name__ == "__main__":
  main()
