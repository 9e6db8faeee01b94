"""The losses, one number per state, without networks or parameters.

``*b`` are any batch axes, S candidate actions come first. What a loss must not
train is stopped here or in ``Heads``, so that the gradients of a sum of all
losses fall apart into the groups that the paper's Algorithm 1 names.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax

from apnpql_jax.dists import boltzmann, categorical
from apnpql_jax.dists.action import ActionDistribution
from apnpql_jax.types import Array


def weighted_mean(losses: Array, weight: Array) -> Array:
  """Mean of f32[*b] losses under f32[*b] weights >= 0; zero if all weights are."""
  return jnp.sum(weight * losses) / jnp.maximum(jnp.sum(weight), 1e-6)


def ap_loss(predicted: Array, label: Array, *, delta: float) -> Array:
  """Behavior cloning of the action primitives, L^ap (paper Eq. 10).

  Velocities by a Huber loss: quadratic below ``delta`` (rad/s), where the arm closes in
  on its target, and linear above, where labels of distant targets saturate. Gripper
  commands by cross-entropy.

  Args:
    predicted: f32[*b, 3, 7], velocities in rad/s and the logit of closing.
    label: f32[*b, 3, 7], velocities in rad/s and the command in {0, 1}.
    delta: width of the quadratic part, rad/s.

  Returns:
    f32[*b], mean over primitives and joints in units of ``delta``, plus the mean
    cross-entropy over primitives in nats.
  """
  velocity, close = predicted[..., :-1], predicted[..., -1]
  huber = optax.losses.huber_loss(velocity, label[..., :-1], delta=delta) / delta
  entropy = optax.losses.sigmoid_binary_cross_entropy(close, label[..., -1])
  return jnp.mean(huber, axis=(-2, -1)) + jnp.mean(entropy, axis=-1)


def value_target(
  logits_t: Array, weights_t: Array, reward_t: Array, discount_t: Array, atoms: Array
) -> Array:
  """Distributional N-step target E_{a ~ q}[z-bar] (paper Eq. 8, right side).

  The expectation over candidates comes before the projection, which is linear.

  Args:
    logits_t: f32[S, *b, n] target network's Z(s_t, a_i).
    weights_t: f32[S, *b] importance weights of the candidates.
    reward_t: f32[*b] discounted sum of N rewards.
    discount_t: f32[*b] gamma^N, zero where the episode terminated.
    atoms: f32[n] support.

  Returns:
    f32[*b, n] probabilities, without gradient.
  """
  probs_t = jnp.sum(weights_t[..., None] * jax.nn.softmax(logits_t), axis=0)
  target = categorical.project(probs_t, reward_t, discount_t, atoms)
  return jax.lax.stop_gradient(target)


def q_loss(logits_tm1: Array, target: Array) -> Array:
  """Cross-entropy of Z(s_tm1, a_tm1) to the target, L^Q (paper Eq. 8).

  Args:
    logits_tm1: f32[*b, n].
    target: f32[*b, n] probabilities.

  Returns:
    f32[*b].
  """
  return categorical.cross_entropy(target, logits_tm1)


def retrace_target(
  reward_t: Array, discount_t: Array, value_t: Array, q_t: Array, trace_t: Array
) -> Array:
  """Retrace return of (s_0, a_0) over a window of N instants (Munos 2016, Eq. 4).

  Instants t = 1..N stand on the last axis. G_{t-1} = r_t + gamma_t (V(s_t) +
  c_t (G_t - Q(s_t, a_t))), where G_N = Q(s_N, a_N); Q(s_0, a_0) cancels.

  Args:
    reward_t: f32[*b, N] received on arriving at t.
    discount_t: f32[*b, N] gamma, zero where the episode terminated on arriving at t.
    value_t: f32[*b, N] E_pi[Q(s_t, .)].
    q_t: f32[*b, N] Q(s_t, a_t).
    trace_t: f32[*b, N] c_t = min(1, pi / mu), zero where the episode ended at t.

  Returns:
    f32[*b], without gradient.
  """
  target = q_t[..., -1]  # Nothing is known beyond the window: no correction there.
  for t in reversed(range(reward_t.shape[-1])):
    beyond = trace_t[..., t] * (target - q_t[..., t])
    target = reward_t[..., t] + discount_t[..., t] * (value_t[..., t] + beyond)
  return jax.lax.stop_gradient(target)


def alpha_loss(q_tm1: Array, alpha_tm1: Array, *, epsilon: float) -> Array:
  """Dual of the KL limit, to be minimized over alpha(s) (paper Eq. 7).

  Args:
    q_tm1: f32[S, *b] values of candidates drawn from the prior; not trained.
    alpha_tm1: f32[*b].
    epsilon: limit of KL(q || b) in nats.

  Returns:
    f32[*b].
  """
  q_tm1 = jax.lax.stop_gradient(q_tm1)
  return boltzmann.dual(q_tm1, alpha_tm1, epsilon=epsilon)


def kl_dual(kl: Array, alpha_tm1: Array, *, epsilon: float) -> Array:
  """Dual of KL(pi || b) <= epsilon for a parametric policy, over alpha(s).

  Its slope in alpha is that of Eq. 7, epsilon - KL, with the KL of pi for that of q.

  Args:
    kl: f32[*b] nats; not trained.
    alpha_tm1: f32[*b].
    epsilon: limit in nats.

  Returns:
    f32[*b].
  """
  return alpha_tm1 * (epsilon - jax.lax.stop_gradient(kl))


def weighted_nll(
  distribution: ActionDistribution, samples: Array, weights: Array
) -> Array:
  """-sum_i w_i log p(a_i): KL from the weighted samples to p, up to a constant.

  Args:
    distribution: p, what is trained.
    samples: f32[S, *b, 7] unclipped; not trained.
    weights: f32[S, *b]; not trained.

  Returns:
    f32[*b].
  """
  samples, weights = jax.lax.stop_gradient((samples, weights))
  return -jnp.sum(weights * distribution.log_prob(samples), axis=0)


def m_step_loss(
  prior: ActionDistribution, samples: Array, weights: Array, nu: Array
) -> Array:
  """Fits the prior to q and keeps it broad, L^M (paper Eq. 9).

  -sum_i w_i log b(a_i) - nu H(b): the first term is KL(q || b) up to a constant.
  The paper prints + nu H(b) but introduces the term for exploration, so entropy is
  rewarded. H is a lower bound, which makes the floor a safe one.

  Args:
    prior: b_theta(. | s_tm1) with gradients to theta^bp.
    samples: f32[S, *b, 7] unclipped actions.
    weights: f32[S, *b] of q, or of another policy, on them.
    nu: f32[] multiplier >= 0.

  Returns:
    f32[*b].
  """
  nll = weighted_nll(prior, samples, weights)
  return nll - jax.lax.stop_gradient(nu) * prior.entropy_bound()


def nu_loss(nu: Array, entropy: Array, *, epsilon_nu: float) -> Array:
  """Dual of the entropy floor, nu (H(b) - epsilon_nu) (text below paper Eq. 9).

  Minimized over nu >= 0: nu grows while the entropy is below its floor.

  Args:
    nu: f32[].
    entropy: f32[*b] entropy of the prior in nats; not trained.
    epsilon_nu: the floor in nats.

  Returns:
    f32[*b].
  """
  return nu * (jax.lax.stop_gradient(entropy) - epsilon_nu)
