"""Diagnosis of a trained agent: where its episodes fail, and what limits them.

The scripted expert defines the stages: an instant belongs to the stage "object", "goal"
or "neutral" if the expert would follow that primitive there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flax import struct
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
import numpy as np

from apnpql_jax.agents.learner import Agent
from apnpql_jax.agents.table_one import algorithm_of
from apnpql_jax.config.checks import ACTING
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.envs.env import Env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.errors import check_name
from apnpql_jax.primitives import reset_bank
from apnpql_jax.training import evaluate
from apnpql_jax.training.rollout import agent_policy, make_player
from apnpql_jax.types import ARM_DOF, PRIMITIVES, Array

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
BINS = 5
"""Number of groups of instants, by Q, in which Q is compared to the returns."""


class Instants(struct.PyTreeNode):
  """All instants of one episode per world."""

  active: Array  # bool[time, worlds]: an action follows
  solved: Array  # bool[time, worlds]: the instant ends the episode with success
  stage: Array  # i32[time, worlds]: index into ``PRIMITIVES``
  error: Array  # f32[time, worlds, 3]: mean error of each predicted primitive, rad/s
  gripper: Array  # bool[time, worlds, 3]: the predicted gripper command is wrong
  against: Array  # bool[time, worlds]: the action's command is not that of the expert
  kl: Array  # f32[time, worlds]: KL(q, b), or KL(pi, b) with a reverse KL; nats
  alpha: Array  # f32[time, worlds]
  q: Array  # f32[time, worlds]: of the chosen action


Recorder = Callable[[Any, Array, PRNGKeyArray], Instants]
"""(parameters, bank rows i32[worlds], key) -> instants."""


def diagnose(
  run_dir: Path | str,
  *,
  episodes: int = 64,
  seed: int = 0,
  backend: str | None = None,
  step: int | None = None,
  acting: str | None = None,
  bank_seed: int = reset_bank.SEED,
) -> dict[str, Any]:
  """Plays held-out episodes with a checkpoint of a run and reports what limits them.

  The arguments and errors are those of ``evaluate``. All figures but ``solved`` are of
  episodes that ``acting`` plays.

  Returns:
    acting: The rule that was played.
    solved: Episodes solved by each acting rule, see ``agents/acting.py``.
    failures: Failed episodes by their last stage. In "object after goal" the hand has
      lost the object, or still holds it at the goal.
    stages: For each stage, the share of instants, the error of each primitive (rad/s),
      the share of wrong gripper commands of the primitive in use, and the share of
      actions whose command is not the expert's. If only the latter is high, Q and the
      M-step overrule the primitives.
    kl_over_epsilon, alpha: Quantiles over instants.
    calibration: In groups of instants of equal size, the mean Q of the actions and the
      mean return, which is zero in failed episodes.
  """
  evaluate.check_count(episodes, seed)
  if acting is not None:
    check_name("acting", acting, ACTING)
  config, env, agent, params, step = evaluate.load_trained(
    run_dir, backend=backend, step=step, bank_seed=bank_seed, held_out=episodes
  )
  solved = {}
  for name in ACTING:
    play = make_player(env, lambda p, rule=name: agent_policy(agent, p, acting=rule))
    played = evaluate.play_held_out(env, play, params, episodes=episodes, seed=seed)
    solved[name] = int(played.success.sum())
  acting = acting or config.eval_acting
  record = make_recorder(env, agent, config.agent, acting=acting)
  batches = [
    jax.device_get(record(params, rows, key))
    for rows, key in evaluate.held_out_batches(env, episodes=episodes, seed=seed)
  ]
  instants = jax.tree.map(lambda *x: np.concatenate(x, axis=1)[:, :episodes], *batches)
  return {
    "task": config.env.task,
    "algorithm": config.agent.algorithm,
    "checkpoint_step": step,
    "episodes": episodes,
    "acting": acting,
    "solved": solved,
    **summarize(instants, config.agent),
  }


def make_recorder(
  env: Env, agent: Agent, config: AgentConfig, *, acting: str = "policy"
) -> Recorder:
  """Returns a jitted function that plays one episode per row by an acting rule."""
  algorithm = algorithm_of(config)

  def at(params: Any, state: EnvState, key: PRNGKeyArray) -> tuple[Array, Instants]:
    act_key, kl_key = jax.random.split(key)
    heads = agent.networks.at(params, state.observation)
    action, info = agent.act(params, state.observation, act_key, acting=acting)
    prior = algorithm.regularizer(heads, heads)
    predicted, label = heads.primitives(), state.timestep.primitives
    # The last component is a logit in the prediction and a command in the label.
    wrong = (predicted[..., ARM_DOF] > 0.0) != (label[..., ARM_DOF] > 0.5)
    command = env.expert_action(state)[..., ARM_DOF]
    return action, Instants(
      active=~state.timestep.last,
      solved=state.timestep.terminated,
      stage=expert_stage(env, state),
      error=_arm_error(predicted, label),
      gripper=wrong,
      against=action[..., ARM_DOF] != command,
      kl=algorithm.policy_update(heads, prior, kl_key).kl,
      alpha=info["alpha"],
      q=info["q"],
    )

  @jax.jit
  def record(params: Any, rows: Array, key: PRNGKeyArray) -> Instants:
    def period(
      carry: tuple[EnvState, Array], key: PRNGKeyArray
    ) -> tuple[tuple[EnvState, Array], Instants]:
      state, running = carry
      act_key, env_key = jax.random.split(key)
      running &= state.faults == 0  # What follows is another episode.
      action, now = at(params, state, act_key)
      now = now.replace(active=running & now.active, solved=running & now.solved)
      return (env.step(state, action, env_key), now.active), now

    start = env.reset(rows), jnp.ones(rows.shape[0], bool)
    keys = jax.random.split(key, env.config.episode_steps + 1)
    return jax.lax.scan(period, start, keys)[1]

  return record


def expert_stage(env: Env, state: EnvState) -> Array:
  """Returns the index of the primitive that the expert would follow, i32[worlds]."""
  followed = env.expert_action(state)[:, None]
  return jnp.argmin(_arm_error(env.moving_primitives(state), followed), axis=-1)


def _arm_error(a: Array, b: Array) -> Array:
  """Returns the mean difference of joint velocities f32[..., 3], rad/s."""
  return jnp.mean(jnp.abs(a - b)[..., :ARM_DOF], axis=-1)


def summarize(instants: Instants, config: AgentConfig) -> dict[str, Any]:
  """Returns the parts of ``diagnose`` that come from the instants, NumPy arrays."""
  active, q = instants.active, instants.q[instants.active]
  solved, stages = instants.solved.any(axis=0), {}
  for index, name in enumerate(PRIMITIVES):
    here = active & (instants.stage == index)
    if here.any():
      errors = zip(PRIMITIVES, instants.error[here].mean(axis=0), strict=True)
      stages[name] = {"share": float(here.sum() / active.sum())}
      stages[name] |= {f"{primitive}_error": float(x) for primitive, x in errors}
      stages[name]["wrong_gripper"] = float(instants.gripper[here][:, index].mean())
      stages[name]["against_expert"] = float(instants.against[here].mean())
  # Control periods until the reward, which comes with the last action.
  wait = active.sum(axis=0) - 1 - np.arange(len(active))[:, None]
  returns = np.where(solved, config.gamma ** np.maximum(wait, 0), 0.0)[active]
  groups = np.array_split(np.argsort(q), BINS)
  return {
    "failures": dict(
      Counter(
        end_of(instants.stage[active[:, world], world])
        for world in np.flatnonzero(~solved)
      )
    ),
    "stages": stages,
    "kl_over_epsilon": _quantiles(instants.kl[active] / config.epsilon),
    "alpha": _quantiles(instants.alpha[active]),
    "calibration": {
      "q": [float(q[group].mean()) for group in groups],
      "return": [float(returns[group].mean()) for group in groups],
    },
  }


def end_of(stages: Array | np.ndarray) -> str:
  """Names the last stage of an episode, and the farthest one if that is another.

  ``stages`` i32[time] are those of its instants.
  """
  last, farthest = PRIMITIVES[stages[-1]], PRIMITIVES[stages.max()]
  return last if last == farthest else f"{last} after {farthest}"


def _quantiles(x: Array | np.ndarray) -> dict[str, float]:
  return {f"{q:.0%}": float(np.quantile(x, q)) for q in QUANTILES}
