"""Environment steps per second, without and with the policy, and what they consist of.

  python benchmarks/env_steps.py --quick
  python benchmarks/env_steps.py --store --backends native --tasks push_plate

A step is one control period of 0.15 s of one world, with its images. "env" acts at
random; "env_policy" is the rollout of training, with an untrained agent of the task's
preset. ``--json`` prints one JSON object and nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
import functools
import sys
from typing import Any

import timing  # isort: skip  (before JAX: sets threads and cache)
import jax
import jax.numpy as jnp
import parts
import settings

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.errors import ConfigError
from apnpql_jax.training.rollout import Policy, agent_policy, rollout


def main() -> None:
  """Command line; see the module's docstring."""
  parser = timing.parser(__doc__)
  settings.add_flags(parser)
  args = timing.parse(parser)
  timing.publish("env_steps", args, measure_all(args))


def measure_all(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
  """Figures of every setting for which the memory suffices, one after the other."""
  for names, config in settings.chosen(args):
    try:
      yield names | measure(config, args.repeats)
    except ConfigError as error:
      print(f"{names}: {error}", file=sys.stderr)


def measure(config: TrainConfig, repeats: int) -> dict[str, Any]:
  """Figures of one setting."""
  env = make_env(config.env, instants=config.agent.lstm_instants)
  agent = make_agent(config.agent)
  worlds, length = config.env.worlds, config.rollout_length
  state = env.reset(jnp.arange(worlds) % env.bank_split)
  params = jax.jit(agent.init)(jax.random.key(0), state.observation).params
  policies: dict[str, Callable[[Any], Policy]] = {
    "env": lambda params: parts.random_policy,
    "env_policy": functools.partial(agent_policy, agent, greedy=False),
  }
  players = {}
  for name, policy in policies.items():
    players[name] = player(env, policy, params, state, length=length)
    run, _ = players[name]
    for _ in range(parts.PLAYED):
      run()
    state, _ = run.carry
  period = parts.prepare(env, agent, params, state)
  floors = {name: part.floor_s / worlds for name, part in period.items()}
  whole = {
    "env": sum(floors.values()) - floors["networks"],
    "env_policy": sum(floors.values()),
  }
  rollouts = {
    name: timing.Ready(run, whole[name], length * worlds, compile_s)
    for name, (run, compile_s) in players.items()
  }
  ready = rollouts | period
  measured = timing.measure(list(ready.values()), repeats=repeats)
  times = dict(zip(ready, measured, strict=True))
  figures: dict[str, Any] = {
    name: run.figures("step", times[name]) for name, run in rollouts.items()
  }
  found = {
    name: parts.Part(times[name].seconds, part.floor_s) for name, part in period.items()
  }
  period_s = worlds * times["env_policy"].seconds
  return figures | {"parts": parts.shares(period_s, found)}


def player(
  env: Env,
  policy: Callable[[Any], Policy],
  params: Any,
  state: EnvState,
  *,
  length: int,
) -> tuple[timing.Carried, float]:
  """Rollouts from ``state`` on, and the seconds of compilation; carries the state."""

  def go_on(carry: Any, params: Any) -> Any:
    state, key = carry
    key, play_key = jax.random.split(key)
    state, slots = rollout(env, policy(params), state, play_key, length=length)
    return (state, key), slots

  carry = (state, jax.random.key(0))
  run, compile_s = timing.compiled(jax.jit(go_on), carry, params)
  return timing.Carried(lambda carry: run(carry, params), carry), compile_s


if __name__ == "__main__":
  main()
