"""The agent: pure functions to act and to learn (paper Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from typing import Any

from flax import struct
import jax
import jax.numpy as jnp
import optax

from apnpql_jax.agents import losses
from apnpql_jax.agents.augmentation import augment
from apnpql_jax.agents.columns.candidates import Candidates
from apnpql_jax.agents.columns.policy_evaluation import Evaluation
from apnpql_jax.agents.heads import Heads, Networks, Params
from apnpql_jax.agents.networks import make_networks
from apnpql_jax.agents.table_one import Algorithm, algorithm_of, epsilon_bounds
from apnpql_jax.config.checks import validate
from apnpql_jax.config.schema import AgentConfig, TrainConfig
from apnpql_jax.dists import boltzmann
from apnpql_jax.types import Array, Metrics, Observation, Transition


class LearnerState(struct.PyTreeNode):
  """All that the learner needs to go on."""

  params: Params  # one entry per group that the algorithm has
  target_params: Params  # slow average of params, which also is what acts
  nu: Array  # f32[] >= 0: multiplier of the entropy floor
  opt_state: Any  # of one Adam per learning rate
  step: Array  # i32[]: updates done


@dataclasses.dataclass(frozen=True)
class Agent:
  """Pure functions of one configuration; all can be jitted, scanned and sharded."""

  networks: Networks
  evaluation: Evaluation

  init: Callable[[Array, Observation], LearnerState]
  """(key, example observation with a batch axis) -> state before learning."""

  act: Callable[[Params, Observation, Array, bool], tuple[Array, Metrics]]
  """(params, observation [B], key, greedy) -> actions f32[B, 7], info f32[B] each.

  The policy's candidates are drawn, and one is picked by its weights. If greedy (a
  Python bool) it is the one of highest value, or the mean of a parametric policy. Info
  has the action's log_prob, which Retrace needs, and for a look at a policy its q,
  q_max and ess of the candidates, and alpha."""

  update: Callable[[LearnerState, Transition, Array], tuple[LearnerState, Metrics]]
  """(state, transitions [B], key) -> state after one update, metrics f32[]."""


def make_agent(config: AgentConfig) -> Agent:
  """Builds the agent that ``config`` describes.

  Raises:
    ConfigError: unknown algorithm, or settings that cannot work, such as a KL limit
      that the samples can never reach.
  """
  validate(TrainConfig(agent=config), algorithms=epsilon_bounds())
  algorithm = algorithm_of(config)
  groups = algorithm.groups(config)
  evaluation = algorithm.policy_evaluation(config)
  networks = make_networks(config, groups, evaluation)
  optimizer = make_optimizer(config, groups)

  def init(key: Array, observation: Observation) -> LearnerState:
    params = networks.init(key, observation)
    nu = jnp.zeros(())
    return LearnerState(
      params=params,
      target_params=jax.tree.map(jnp.copy, params),
      nu=nu,
      opt_state=optimizer.init({**params, "nu": nu}),
      step=jnp.zeros((), jnp.int32),
    )

  def act(
    params: Params, observation: Observation, key: Array, greedy: bool = False
  ) -> tuple[Array, Metrics]:
    return _act(networks, algorithm, params, observation, key, greedy=greedy)

  def update(
    state: LearnerState, batch: Transition, key: Array
  ) -> tuple[LearnerState, Metrics]:
    key_t, key_tm1 = jax.random.split(key)
    if config.image_shift or config.color_jitter:
      batch = augment(
        jax.random.fold_in(key, 1),
        batch,
        shift=config.image_shift,
        jitter=config.color_jitter,
        together=config.lstm_instants > 0,
      )
    target = bellman_target(
      networks, algorithm, evaluation, state.target_params, batch, key_t
    )
    trained = {**state.params, "nu": state.nu}
    grads, metrics = jax.grad(total_loss, argnums=3, has_aux=True)(
      networks,
      algorithm,
      evaluation,
      trained,
      state.target_params,
      batch,
      target,
      key_tm1,
    )
    steps, opt_state = optimizer.update(grads, state.opt_state, trained)
    params = jax.tree.map(jnp.add, trained, steps)
    nu = jnp.maximum(params.pop("nu"), 0.0)
    metrics |= {f"grad_norm/{k}": optax.tree.norm(grads[k]) for k in groups}
    metrics["prior/nu"] = nu
    target_params = jax.tree.map(
      lambda new, old: old + config.target_rate * (new - old),
      params,
      state.target_params,
    )
    return LearnerState(params, target_params, nu, opt_state, state.step + 1), metrics

  return Agent(networks, evaluation, init, act, update)


def make_optimizer(
  config: AgentConfig, groups: tuple[str, ...]
) -> optax.GradientTransformation:
  """Adam with a clipped global norm for each step of Algorithm 1, by group.

  A parametric policy has one of its own, at the rate of the E-step that it belongs to.
  """

  def adam(learning_rate: optax.ScalarOrSchedule) -> optax.GradientTransformation:
    return optax.chain(
      optax.clip_by_global_norm(config.max_grad_norm), optax.adam(learning_rate)
    )

  def m_rate(count: Any) -> Any:
    return jnp.where(count < config.m_step_delay, 0.0, config.learning_rate_m)

  rates = {
    "e_step": config.learning_rate_e,
    "m_step": m_rate,
    "policy": config.learning_rate_e,
    "alpha": config.learning_rate_alpha,
    "nu": config.learning_rate_nu,
  }
  step = {"encoder": "e_step", "ap": "e_step", "z": "e_step", "bp": "m_step"}
  labels = {group: step.get(group, group) for group in (*groups, "nu")}
  return optax.partition({k: adam(rates[k]) for k in labels.values()}, labels)


def _act(
  networks: Networks,
  algorithm: Algorithm,
  params: Params,
  observation: Observation,
  key: Array,
  *,
  greedy: bool,
) -> tuple[Array, Metrics]:
  """Samples candidates and picks one (paper Sec. III-B)."""
  key_candidates, key_pick = jax.random.split(key)
  heads = networks.at(params, observation)
  candidates = _candidates(
    algorithm, heads, key_candidates, heads.config.policy_samples, greedy=greedy
  )
  q_values, weights = candidates.q_values, candidates.weights
  chosen = boltzmann.pick(key_pick, weights)
  actions = jnp.take_along_axis(candidates.actions, chosen[None, :, None], axis=0)
  q = jnp.take_along_axis(q_values, chosen[None], axis=0)
  info = {
    "q": q[0],
    "q_max": jnp.max(q_values, axis=0),
    "alpha": heads.alpha(),
    "ess": boltzmann.effective_sample_size(weights),
    "log_prob": candidates.log_prob(actions, q)[0],
  }
  return actions[0], info


def bellman_target(
  networks: Networks,
  algorithm: Algorithm,
  evaluation: Evaluation,
  target_params: Params,
  batch: Transition,
  key: Array,
) -> Array:
  """Target of the values, by the target network (paper Eq. 8, Sec. V-B)."""

  def look(observation: Observation) -> tuple[Heads, Candidates]:
    heads = networks.at(target_params, observation)
    return heads, _candidates(algorithm, heads, key, heads.config.target_samples)

  return evaluation.target(look, batch)


def _candidates(
  algorithm: Algorithm,
  heads: Heads,
  key: Array,
  num_samples: int,
  *,
  greedy: bool = False,
) -> Candidates:
  """The policy of these heads, which are their own past if the regularizer asks."""
  prior = algorithm.regularizer(heads, heads)
  return algorithm.policy(heads, prior, key, num_samples=num_samples, greedy=greedy)


def _ap_errors(predicted: Array, label: Array) -> Metrics:
  """Mean error of the primitives' velocities, rad/s, and share of wrong gripper
  commands, f32[*b] each."""
  velocity = jnp.abs(predicted - label)[..., :-1]
  wrong = (predicted[..., -1] > 0) != (label[..., -1] > 0)
  return {
    "ap/error": jnp.mean(velocity, axis=(-2, -1)),
    "ap/gripper_error": jnp.mean(wrong, axis=-1),
  }


def total_loss(
  networks: Networks,
  algorithm: Algorithm,
  evaluation: Evaluation,
  trained: Params,
  target_params: Params,
  batch: Transition,
  target: Array,
  key: Array,
) -> tuple[Array, Metrics]:
  """Sum of the losses of Algorithm 1; each reaches only its own parameters."""
  config = networks.config
  heads = networks.at(trained, batch.observation_tm1)
  slow = networks.at(target_params, batch.observation_tm1)
  predicted = heads.primitives()
  outputs = heads.z(batch.action_tm1[None])[0]
  prior = algorithm.regularizer(heads, slow)
  improved = algorithm.policy_update(heads, prior, key)
  candidates = improved.candidates
  q_values, weights = candidates.q_values, improved.weights
  terms = {
    "loss/ap": losses.ap_loss(predicted, batch.primitives_tm1, delta=config.ap_delta),
    "loss/q": evaluation.loss(outputs, target),
    **improved.losses,
    **algorithm.regularizer_update(heads, prior, candidates, batch, key, trained["nu"]),
  }
  per_state = terms | {
    **_ap_errors(predicted, batch.primitives_tm1),
    "npql/kl_over_eps": improved.kl / config.epsilon,
    "npql/ess": boltzmann.effective_sample_size(weights),
    "npql/alpha_mean": heads.alpha(),
    "npql/max_weight": jnp.max(weights, axis=0),
    "prior/entropy": prior.entropy_bound(),
    "policy/entropy": improved.entropy,
    "q/mean": jnp.mean(q_values, axis=0),
    "q/data": evaluation.value(outputs),
    "q/target": evaluation.expected(target),
  }
  metrics = {k: losses.weighted_mean(v, batch.weight) for k, v in per_state.items()}
  scale = {"loss/ap": config.lambda_ap}
  total = jnp.sum(jnp.stack([scale.get(k, 1.0) * metrics[k] for k in terms]))
  metrics["q/min"], metrics["q/max"] = jnp.min(q_values), jnp.max(q_values)
  return total, metrics
