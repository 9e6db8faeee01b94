"""The tasks in Gymnasium's registry, from the import of this package on.

    import apnpql_jax.gym
    env = gymnasium.make("apnpql/PushPlate-v0", obs="state")

Gymnasium can do the import itself: ``make("apnpql_jax.gym:apnpql/PushPlate-v0")``.
Imports neither JAX nor MuJoCo; ``envs`` has the environments.
"""

from __future__ import annotations

import gymnasium

from apnpql_jax.config import files


def env_id(task: str) -> str:
  """Returns the name of a task in the registry, such as ``apnpql/PushPlate-v0``."""
  return f"apnpql/{task.title().replace('_', '')}-v0"


for _task in files.preset_tasks():
  gymnasium.register(
    env_id(_task),
    entry_point="apnpql_jax.gym.envs:ManipulationEnv",
    vector_entry_point="apnpql_jax.gym.envs:ManipulationVectorEnv",
    kwargs={"task": _task},
  )
