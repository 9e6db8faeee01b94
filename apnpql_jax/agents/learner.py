"""The AP-NPQL agent: pure functions to act and to learn (paper Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from typing import Any

from flax import struct
import jax
import jax.numpy as jnp
import optax

from apnpql_jax.agents import objectives
from apnpql_jax.agents.algorithms import ALGORITHMS, Algorithm, get_algorithm
from apnpql_jax.agents.networks import GROUPS, Networks, Params, make_networks
from apnpql_jax.config import AgentConfig, TrainConfig, validate
from apnpql_jax.dists import boltzmann, categorical, gmm
from apnpql_jax.types import Array, Metrics, Observation, Transition


class LearnerState(struct.PyTreeNode):
  """All that the learner needs to go on."""

  params: Params  # one entry per name in GROUPS
  target_params: Params  # slow average of params
  nu: Array  # f32[] >= 0: multiplier of the entropy floor
  opt_state: Any  # of one Adam per learning rate
  step: Array  # i32[]: updates done


@dataclasses.dataclass(frozen=True)
class Agent:
  """Pure functions of one configuration; all can be jitted, scanned and sharded."""

  networks: Networks

  init: Callable[[Array, Observation], LearnerState]
  """(key, example observation with a batch axis) -> state before learning."""

  act: Callable[[Params, Observation, Array, bool], tuple[Array, Metrics]]
  """(params, observation [B], key, greedy) -> actions f32[B, 7], info f32[B] each.

  Candidates come from the prior; one is drawn in proportion to exp(Q / alpha), or,
  if greedy (a Python bool), the best is taken."""

  update: Callable[[LearnerState, Transition, Array], tuple[LearnerState, Metrics]]
  """(state, transitions [B], key) -> state after one update, metrics f32[]."""


def make_agent(config: AgentConfig) -> Agent:
  """Builds the agent that ``config`` describes.

  Raises:
    ConfigError: unknown algorithm, or settings that cannot work, such as a KL limit
      that the samples can never reach.
  """
  validate(TrainConfig(agent=config), algorithms=tuple(ALGORITHMS))
  networks = make_networks(config)
  algorithm = get_algorithm(config.algorithm)
  optimiser = make_optimiser(config)

  def init(key: Array, observation: Observation) -> LearnerState:
    params = networks.init(key, observation)
    nu = jnp.zeros(())
    return LearnerState(
      params=params,
      target_params=jax.tree.map(jnp.copy, params),
      nu=nu,
      opt_state=optimiser.init({**params, "nu": nu}),
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
    target = bellman_target(networks, algorithm, state.target_params, batch, key_t)
    trained = {**state.params, "nu": state.nu}
    grads, metrics = jax.grad(total_loss, argnums=2, has_aux=True)(
      networks, algorithm, trained, batch, target, key_tm1
    )
    steps, opt_state = optimiser.update(grads, state.opt_state, trained)
    params = jax.tree.map(jnp.add, trained, steps)
    nu = jnp.maximum(params.pop("nu"), 0.0)
    metrics |= {f"grad_norm/{k}": optax.tree.norm(grads[k]) for k in GROUPS}
    metrics["prior/nu"] = nu
    target_params = jax.tree.map(
      lambda new, old: old + config.target_rate * (new - old),
      params,
      state.target_params,
    )
    return LearnerState(params, target_params, nu, opt_state, state.step + 1), metrics

  return Agent(networks, init, act, update)


def make_optimiser(config: AgentConfig) -> optax.GradientTransformation:
  """Adam with a clipped global norm for each step of Algorithm 1, by group."""

  def adam(learning_rate: optax.ScalarOrSchedule) -> optax.GradientTransformation:
    return optax.chain(
      optax.clip_by_global_norm(config.max_grad_norm), optax.adam(learning_rate)
    )

  def m_rate(count: Any) -> Any:
    return jnp.where(count < config.m_step_delay, 0.0, config.learning_rate_m)

  return optax.partition(
    {
      "e_step": adam(config.learning_rate_e),
      "m_step": adam(m_rate),
      "alpha": adam(config.learning_rate_alpha),
      "nu": adam(config.learning_rate_nu),
    },
    {
      "encoder": "e_step",
      "ap": "e_step",
      "z": "e_step",
      "bp": "m_step",
      "alpha": "alpha",
      "nu": "nu",
    },
  )


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
  phi = networks.features(params, observation)
  candidates = algorithm.policy(
    networks,
    params,
    phi,
    algorithm.regulariser(networks, params, phi),
    key_candidates,
    num_samples=networks.config.policy_samples,
  )
  q_values, alpha = candidates.q_values, candidates.alpha
  if greedy:
    chosen = jnp.argmax(q_values, axis=0)
  else:
    chosen = boltzmann.pick(key_pick, q_values, alpha)
  actions = jnp.take_along_axis(candidates.actions, chosen[None, :, None], axis=0)[0]
  info = {
    "q": jnp.take_along_axis(q_values, chosen[None], axis=0)[0],
    "q_max": jnp.max(q_values, axis=0),
    "alpha": alpha,
    "ess": boltzmann.effective_sample_size(candidates.weights),
  }
  return actions, info


def bellman_target(
  networks: Networks,
  algorithm: Algorithm,
  target_params: Params,
  batch: Transition,
  key: Array,
) -> Array:
  """Target distribution f32[B, n] from the target network at s_t (paper Eq. 8)."""
  phi_t = networks.features(target_params, batch.observation_t)
  candidates_t = algorithm.policy(
    networks,
    target_params,
    phi_t,
    algorithm.regulariser(networks, target_params, phi_t),
    key,
    num_samples=networks.config.target_samples,
  )
  return algorithm.policy_evaluation(
    candidates_t.logits,
    candidates_t.weights,
    batch.reward_t,
    batch.discount_t,
    networks.atoms,
  )


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
  trained: Params,
  batch: Transition,
  target: Array,
  key: Array,
) -> tuple[Array, Metrics]:
  """Sum of the losses of Algorithm 1; each reaches only its own parameters."""
  config = networks.config
  phi = networks.features(trained, batch.observation_tm1)
  predicted = networks.primitives(trained, phi)
  logits = networks.q_logits(trained, phi, batch.action_tm1[None])[0]
  prior = algorithm.regulariser(networks, trained, phi)
  candidates = algorithm.policy(
    networks, trained, phi, prior, key, num_samples=config.policy_samples
  )
  q_values, weights = candidates.q_values, candidates.weights
  entropy = gmm.entropy_bound(prior)
  per_state = {
    "loss/ap": objectives.ap_loss(
      predicted, batch.primitives_tm1, delta=config.ap_delta
    ),
    "loss/q": objectives.q_loss(logits, target),
    "loss/alpha": objectives.alpha_loss(
      q_values, networks.alpha(trained, phi), epsilon=config.epsilon
    ),
    "loss/m": algorithm.regulariser_update(
      prior, candidates.samples, weights, trained["nu"]
    ),
    "loss/nu": objectives.nu_loss(trained["nu"], entropy, epsilon_nu=config.epsilon_nu),
    **_ap_errors(predicted, batch.primitives_tm1),
    "npql/kl_over_eps": boltzmann.kl_to_prior(weights) / config.epsilon,
    "npql/ess": boltzmann.effective_sample_size(weights),
    "npql/alpha_mean": candidates.alpha,
    "npql/max_weight": jnp.max(weights, axis=0),
    "prior/entropy": entropy,
    "q/mean": jnp.mean(q_values, axis=0),
    "q/data": categorical.mean(jax.nn.softmax(logits), networks.atoms),
    "q/target": categorical.mean(target, networks.atoms),
  }
  metrics = {k: objectives.weighted_mean(v, batch.weight) for k, v in per_state.items()}
  total = config.lambda_ap * metrics["loss/ap"] + sum(
    metrics[k] for k in ("loss/q", "loss/alpha", "loss/m", "loss/nu")
  )
  metrics["q/min"], metrics["q/max"] = jnp.min(q_values), jnp.max(q_values)
  return total, metrics
