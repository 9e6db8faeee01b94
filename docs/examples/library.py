"""Acts with a fresh agent, then trains a tiny run and evaluates it."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp

import apnpql_jax as apnpql


def main(run: Path) -> None:
  """Acts, trains and evaluates; the run is written to the folder ``run``."""
  apnpql.configure()  # First: JAX reads these settings when it starts.
  preset = apnpql.load_preset("push_plate")
  config = replace(
    preset,
    env=replace(preset.env, obs="state", worlds=4, bank_rows=256),
    replay=replace(preset.replay, capacity=256, expert_steps=256, batch_size=8),
    total_steps=32,
    updates_per_iteration=2,
    eval_episodes=4,
    video=False,
  )
  env, agent = apnpql.make_env(config.env), apnpql.make_agent(config.agent)
  state = env.reset(jnp.arange(4))  # One world per row of the bank of reset states.
  learner = agent.init(jax.random.key(0), state.observation)
  act, step = jax.jit(agent.act), jax.jit(env.step)
  for key in jax.random.split(jax.random.key(1), 10):
    action, _ = act(learner.params, state.observation, key)  # f32[4, 7]
    state = step(state, action, key)
  print("rewards:", state.timestep.reward)
  print(apnpql.train(config, run, overwrite=True))
  print(apnpql.evaluate(run, episodes=4, seed=7))


if __name__ == "__main__":
  main(Path("runs/library"))
