"""Contact sheet of the worlds of ``apnpql transfer``: docs/images/transfer.png.

  python -m benchmarks.quality.transfer_sheet

Six worlds of stack_box after twelve periods of the expert, the global image above that
of the wrist camera. From the top, in MuJoCo: rays, OpenGL with plain looks, OpenGL with
the draws of the randomizer, OpenGL with unseen looks. In Bullet: TinyRenderer with
plain and with unseen looks.
"""

from collections.abc import Collection
import dataclasses
from typing import Any

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax import runtime
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.training.rollout import expert_policy, rollout
from apnpql_jax.transfer import looks
from apnpql_jax.transfer.bullet_worlds import BulletWorlds
from apnpql_jax.transfer.evaluation import make_draw
from apnpql_jax.transfer.opengl_renderer import OpenGLRenderer
from apnpql_jax.transfer.tiny_renderer import TinyRenderer
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
  env = make_env(config)
  state = played(env)
  seen: Any = state.timestep.observation
  rows = [joined(seen.global_image, seen.wrist_image)]
  rows.append(drawn(env, state, OpenGLRenderer, unseen=()))
  randomized = make_env(dataclasses.replace(config, randomize=True))
  rows.append(drawn(randomized, played(randomized), OpenGLRenderer, unseen=()))
  rows.append(drawn(env, state, OpenGLRenderer, unseen=looks.PARTS))
  with BulletWorlds(env, latency_s=0.03, admittance=False) as worlds:
    state, act = env.reset(jnp.asarray(ROWS)), jax.jit(env.expert_action)
    for _ in range(PERIODS):
      state = env.observe(worlds.advance(state, act(state), np.ones(WORLDS, bool)))
  rows += [
    drawn(env, state, TinyRenderer, unseen=unseen) for unseen in ((), looks.PARTS)
  ]
  return rows


def played(env: Env) -> EnvState:
  """Returns the worlds after the expert has played for a while."""
  policy = expert_policy(env, noise=0.0)
  play = jax.jit(lambda s, k: rollout(env, policy, s, k, length=PERIODS)[0])
  return play(env.reset(jnp.asarray(ROWS)), jax.random.key(0))


def drawn(
  env: Env,
  state: EnvState,
  renderer: type[OpenGLRenderer | TinyRenderer],
  *,
  unseen: Collection[str],
) -> np.ndarray:
  """Returns a row of tiles by a renderer."""
  with renderer(env.task.scene, env.config, unseen=unseen) as opened:
    draw = make_draw(env, opened)
    return joined(*draw(state.physics, ROWS, np.ones(WORLDS, bool), PERIODS))


def joined(overviews: jax.Array, wrists: jax.Array) -> np.ndarray:
  """Returns a row of tiles, one per world."""
  pairs = zip(np.asarray(overviews), np.asarray(wrists), strict=True)
  return np.concatenate([tile(*pair) for pair in pairs], axis=1)


if __name__ == "__main__":
  main()
