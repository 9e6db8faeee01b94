"""The agent: pure functions to act and to learn (paper Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import functools
from typing import Any

from flax import struct
import jax
import jax.numpy as jnp
from jaxtyping import Float, Int, PRNGKeyArray
import optax

from apnpql_jax.agents import losses
from apnpql_jax.agents.acting import choose_action
from apnpql_jax.agents.augmentation import augment
from apnpql_jax.agents.columns.candidates import Candidates
from apnpql_jax.agents.columns.policy_evaluation import PolicyEvaluation
from apnpql_jax.agents.columns.policy_update import Improvement
from apnpql_jax.agents.explanation import Explanation, explain
from apnpql_jax.agents.networks import Heads, Networks, Params, make_networks
from apnpql_jax.agents.table_one import Algorithm, algorithm_of, epsilon_bounds
from apnpql_jax.config.checks import check_agent
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.dists import boltzmann
from apnpql_jax.dists.action import ActionDistribution
from apnpql_jax.types import Array, Metrics, Observation, Transition

FINAL_RATE = 0.1
"""Share of a learning rate that is left after ``agent.decay_updates``."""


class LearnerState(struct.PyTreeNode):
  """Complete state of the learner."""

  params: Params
  """Parameters, one entry per group that the algorithm has."""

  target_params: Params
  """Moving average of ``params``; these act."""

  nu: Float[Array, ""]
  """Multiplier >= 0 of the entropy floor."""

  opt_state: Any
  """State of one Adam per learning rate."""

  step: Int[Array, ""]
  """Number of updates done."""


@dataclasses.dataclass(frozen=True)
class Agent:
  """Pure functions of one configuration; all can be jitted, scanned and sharded."""

  networks: Networks
  """The networks, without parameters."""

  policy_evaluation: PolicyEvaluation
  """How the algorithm represents and learns values."""

  init: Callable[[PRNGKeyArray, Observation], LearnerState]
  """(key, example observation with a batch axis) -> state before learning."""

  act: Callable[..., tuple[Array, Metrics]]
  """(params, observation [B], key, *, acting="policy") -> actions f32[B, 7], info.

  ``acting`` names a rule, see ``acting.choose_action``. ``info`` holds f32[B] each: the
  action's ``log_prob``, which Retrace needs, and for diagnosis its ``q``, the
  candidates' ``q_max`` and ``ess``, and ``alpha``.
  """

  update: Callable[
    [LearnerState, Transition, PRNGKeyArray], tuple[LearnerState, Metrics]
  ]
  """(state, transitions [B], key) -> state after one update, metrics f32[]."""

  explain: Callable[..., Explanation]
  """As ``act``, but returns what led to the action, see ``Explanation``."""


def make_agent(config: AgentConfig) -> Agent:
  """Builds the agent that ``config`` describes.

  Raises:
    ConfigError: A setting is invalid; the message names it.
  """
  check_agent(config, algorithms=epsilon_bounds())
  algorithm = algorithm_of(config)
  groups = algorithm.groups(config)
  evaluation = algorithm.policy_evaluation(config)
  networks = make_networks(
    config, groups, evaluation.head(config.hidden), evaluation.value
  )
  optimizer = make_optimizer(config, groups)
  loss = functools.partial(total_loss, networks, algorithm, evaluation)

  @jax.jit  # Operation by operation, it would take longer.
  def init(key: PRNGKeyArray, observation: Observation) -> LearnerState:
    params, nu = networks.init(key, observation), jnp.zeros(())
    target_params = jax.tree.map(jnp.copy, params)
    opt_state = optimizer.init({**params, "nu": nu})
    return LearnerState(params, target_params, nu, opt_state, jnp.zeros((), jnp.int32))

  def act(
    params: Params,
    observation: Observation,
    key: PRNGKeyArray,
    *,
    acting: str = "policy",
  ) -> tuple[Array, Metrics]:
    heads = networks.at(params, observation)
    return choose_action(algorithm, heads, key, acting=acting)

  def explained(
    params: Params,
    observation: Observation,
    key: PRNGKeyArray,
    *,
    acting: str = "policy",
  ) -> Explanation:
    heads = networks.at(params, observation)
    return explain(algorithm, heads, key, acting=acting)

  def update(
    state: LearnerState, batch: Transition, key: PRNGKeyArray
  ) -> tuple[LearnerState, Metrics]:
    key_t, key_tm1, key_image = jax.random.split(key, 3)
    if config.image_shift or config.color_jitter:
      batch = augment(
        key_image,
        batch,
        shift=config.image_shift,
        jitter=config.color_jitter,
        together=config.lstm_instants > 0,
      )
    # Take one gradient of all losses, with targets from the target network.
    target = bellman_target(
      networks, algorithm, evaluation, state.target_params, batch, key_t
    )
    trained = {**state.params, "nu": state.nu}
    grads, metrics = jax.grad(loss, has_aux=True)(
      trained, state.target_params, batch, target, key_tm1
    )
    after = apply_gradients(optimizer, state, trained, grads, config.target_rate)
    metrics |= {f"grad_norm/{k}": optax.tree.norm(grads[k]) for k in groups}
    return after, metrics | {"prior/nu": after.nu}

  return Agent(networks, evaluation, init, act, update, explained)


def make_optimizer(
  config: AgentConfig, groups: tuple[str, ...]
) -> optax.GradientTransformation:
  """Builds an Adam with a clipped global norm for each step of Algorithm 1."""

  def adam(learning_rate: optax.ScalarOrSchedule) -> optax.GradientTransformation:
    clip = optax.clip_by_global_norm(config.max_grad_norm)
    return optax.chain(clip, optax.adam(learning_rate))

  decay = config.decay_updates
  cosine = optax.cosine_decay_schedule(1.0, max(decay, 1), FINAL_RATE)

  def e_rate(count: Any) -> Any:
    return config.learning_rate_e * cosine(count)

  def m_rate(count: Any) -> Any:
    rate = config.learning_rate_m * (cosine(count) if decay else 1.0)
    return jnp.where(count < config.m_step_delay, 0.0, rate)

  # A constant rate needs no counter in the state of the optimizer.
  first = e_rate if decay else config.learning_rate_e

  rates = {
    "e_step": first,
    "m_step": m_rate,
    "policy": first,
    "alpha": config.learning_rate_alpha,
    "nu": config.learning_rate_nu,
  }
  step = {"encoder": "e_step", "ap": "e_step", "z": "e_step", "bp": "m_step"}
  labels = {group: step.get(group, group) for group in (*groups, "nu")}
  return optax.partition({k: adam(rates[k]) for k in labels.values()}, labels)


@jax.named_scope("apply_gradients")
def apply_gradients(
  optimizer: optax.GradientTransformation,
  state: LearnerState,
  trained: Params,
  grads: Params,
  target_rate: float,
) -> LearnerState:
  """Steps all optimizers and moves the target network toward the new parameters.

  ``trained`` and ``grads`` are the parameter groups and nu, which stays nonnegative.
  """
  steps, opt_state = optimizer.update(grads, state.opt_state, trained)
  params = jax.tree.map(jnp.add, trained, steps)
  nu = jnp.maximum(params.pop("nu"), 0.0)
  target_params = jax.tree.map(
    lambda new, old: old + target_rate * (new - old), params, state.target_params
  )
  return LearnerState(params, target_params, nu, opt_state, state.step + 1)


@jax.named_scope("bellman_target")
def bellman_target(
  networks: Networks,
  algorithm: Algorithm,
  evaluation: PolicyEvaluation,
  target_params: Params,
  batch: Transition,
  key: PRNGKeyArray,
) -> Float[Array, " B *n"]:
  """Computes the target of the values with the target network (Eq. 8, Sec. V-B)."""

  def policy_at(observation: Observation) -> tuple[Heads, Candidates]:
    heads = networks.at(target_params, observation)
    prior = algorithm.regularizer(heads, heads)
    samples = networks.config.target_samples
    return heads, algorithm.policy(heads, prior, key, num_samples=samples)

  return evaluation.target(policy_at, batch)


@jax.named_scope("total_loss")
def total_loss(
  networks: Networks,
  algorithm: Algorithm,
  evaluation: PolicyEvaluation,
  trained: Params,
  target_params: Params,
  batch: Transition,
  target: Float[Array, " B *n"],
  key: PRNGKeyArray,
) -> tuple[Float[Array, ""], Metrics]:
  """Sums the losses of Algorithm 1; each trains only its own parameters."""
  config = networks.config
  # Evaluate the networks at s_tm1. Rows whose regularizer does not read the target
  # network's heads do not pay for them: XLA drops what nothing uses.
  heads = networks.at(trained, batch.observation_tm1)
  target_heads = networks.at(target_params, batch.observation_tm1)
  predicted, label = heads.primitives(), batch.primitives_tm1
  outputs = heads.z(batch.action_tm1[None])[0]
  # Improve the policy, and compute the losses of all columns of Table I.
  prior = algorithm.regularizer(heads, target_heads)
  improved = algorithm.policy_update(heads, prior, key)
  candidates, nu = improved.candidates, trained["nu"]
  terms = {
    "loss/ap": losses.ap_loss(predicted, label, delta=config.ap_delta),
    "loss/q": evaluation.loss(outputs, target),
    **improved.losses,
    **algorithm.regularizer_update(heads, prior, candidates, batch, key, nu),
  }
  # Average them over the real transitions of the batch, and add up.
  means = {k: losses.weighted_mean(v, batch.weight) for k, v in terms.items()}
  scale = {"loss/ap": config.lambda_ap}
  total = jnp.sum(jnp.stack([scale.get(k, 1.0) * x for k, x in means.items()]))
  extra = {"q/data": evaluation.value(outputs), "q/target": evaluation.expected(target)}
  return total, means | _diagnostics(heads, predicted, prior, improved, extra, batch)


def _diagnostics(
  heads: Heads,
  predicted: Float[Array, " B 3 7"],
  prior: ActionDistribution,
  improved: Improvement,
  extra: Metrics,
  batch: Transition,
) -> Metrics:
  """Returns means, extremes and percentiles over the batch, which train nothing.

  ``extra`` holds further numbers per state, f32[B] each, by name.
  """
  q_values, label = improved.candidates.q_values, batch.primitives_tm1
  velocity_error = jnp.abs(predicted - label)[..., :-1]
  wrong_gripper = (predicted[..., -1] > 0) != (label[..., -1] > 0)
  per_state = extra | {
    "ap/error": jnp.mean(velocity_error, axis=(-2, -1)),  # rad/s
    "ap/gripper_error": jnp.mean(wrong_gripper, axis=-1),  # share of wrong commands
    "npql/kl_over_eps": improved.kl / heads.config.epsilon,
    "npql/ess": boltzmann.effective_sample_size(improved.weights),
    "npql/alpha_mean": heads.alpha(),
    "npql/max_weight": jnp.max(improved.weights, axis=0),
    "prior/entropy": prior.entropy_bound(),
    "policy/entropy": improved.entropy,
    "q/mean": jnp.mean(q_values, axis=0),
  }
  metrics = {k: losses.weighted_mean(v, batch.weight) for k, v in per_state.items()}
  metrics["q/min"], metrics["q/max"] = jnp.min(q_values), jnp.max(q_values)
  highest = functools.partial(jnp.quantile, q=0.95)
  metrics["npql/kl_over_eps_p95"] = highest(per_state["npql/kl_over_eps"])
  metrics["npql/alpha_p95"] = highest(per_state["npql/alpha_mean"])
  return metrics
