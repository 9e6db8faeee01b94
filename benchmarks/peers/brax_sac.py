"""Brax's soft actor-critic on the same images.

A side of compare.py. Brax's own training loop takes only vectors, so the update is
built from its public losses, optimizer steps and vision networks, in the order of that
loop, with the convolutions and widths of this project. Policy and critics each have an
encoder, because its networks cannot share one. It draws one action, no candidates.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import brax
from brax.training import distribution, gradients, networks, types
from brax.training.agents.sac import losses
from brax.training.agents.sac.networks import SACNetworks
from flax import linen as nn
import jax
import jax.numpy as jnp
import optax

from apnpql_jax.agents.encoder import robot_inputs
from apnpql_jax.config import AgentConfig, TrainConfig
from apnpql_jax.presets import load_preset
from apnpql_jax.types import ACTION_DIM, Array, Observation
from benchmarks.common import noise
from benchmarks.common.settings import with_batch
from benchmarks.peers import sides

LEARNING_RATE, TAU = 3e-4, 0.005


class Critic(nn.Module):
  """Twin Q on a vision network."""

  config: AgentConfig

  @nn.compact
  def __call__(self, observation: dict[str, Array], action: Array) -> Array:
    """Returns both values, f32[B, 2]."""
    seen = vision(self.config, [self.config.feature_dim])(floats(observation))
    x = jnp.concatenate([nn.relu(seen), action], axis=-1)
    twins = [networks.MLP([*self.config.hidden, 1])(x) for _ in range(2)]
    return jnp.concatenate(twins, axis=-1)


class Policy(nn.Module):
  """The policy's distribution on a vision network."""

  config: AgentConfig
  outputs: int

  @nn.compact
  def __call__(self, observation: dict[str, Array]) -> Array:
    """Returns the parameters of the distribution, f32[B, outputs]."""
    widths = [self.config.feature_dim, *self.config.hidden, self.outputs]
    return vision(self.config, widths)(floats(observation))


def vision(config: AgentConfig, widths: list[int]) -> networks.VisionMLP:
  """Returns Brax's convolutions and dense layers in the sizes of our encoder."""
  return networks.VisionMLP(
    layer_sizes=widths,
    state_obs_key="state",
    cnn_output_channels=(config.patch_channels, config.conv_channels),
    cnn_kernel_size=(4, 3 if config.conv_overlap else 2),
    cnn_stride=(4, 2),
    cnn_global_pool="none",
  )


def floats(observation: dict[str, Array]) -> dict[str, Array]:
  """Converts images to numbers in [0, 1]."""
  return {k: x / 255.0 if x.ndim > 2 else x for k, x in observation.items()}


def make_networks(config: AgentConfig, batch: types.Transition) -> SACNetworks:
  """Returns the networks in the form that Brax's losses call."""
  actions = distribution.NormalTanhDistribution(event_size=ACTION_DIM)
  policy, critic = Policy(config, actions.param_size), Critic(config)
  return SACNetworks(
    policy_network=networks.FeedForwardNetwork(
      init=lambda key: policy.init(key, batch.observation),
      apply=lambda _, params, observation: policy.apply(params, observation),
    ),
    q_network=networks.FeedForwardNetwork(
      init=lambda key: critic.init(key, batch.observation, batch.action),
      apply=lambda _, params, *inputs: critic.apply(params, *inputs),
    ),
    parametric_action_distribution=actions,
  )


def make_update(config: AgentConfig, batch: types.Transition) -> tuple[Any, Any]:
  """Returns the initial state, and (state, key) -> the state after one update."""
  nets, gamma = make_networks(config, batch), config.gamma
  optimizer = optax.adam(LEARNING_RATE)
  alpha_step, critic_step, actor_step = (
    gradients.gradient_update_fn(loss, optimizer, pmap_axis_name=None)
    for loss in losses.make_losses(nets, 1.0, gamma, action_size=ACTION_DIM)
  )
  keys = jax.random.split(jax.random.key(0))
  critic, actor = nets.q_network.init(keys[0]), nets.policy_network.init(keys[1])
  trained = (jnp.zeros(()), critic, actor)

  @jax.jit
  def update(state: Any, key: Array) -> Any:
    (log_alpha, critic, actor), slow, (opt_a, opt_c, opt_p) = state
    k1, k2, k3 = jax.random.split(key, 3)
    inputs = (log_alpha, actor, None, batch, k1)
    _, new_alpha, opt_a = alpha_step(*inputs, optimizer_state=opt_a)
    alpha = jnp.exp(log_alpha)
    inputs = (critic, actor, None, slow, alpha, batch, k2)
    _, new_critic, opt_c = critic_step(*inputs, optimizer_state=opt_c)
    inputs = (actor, None, critic, alpha, batch, k3)
    _, new_actor, opt_p = actor_step(*inputs, optimizer_state=opt_p)
    slow = jax.tree.map(lambda old, new: old + TAU * (new - old), slow, new_critic)
    return (new_alpha, new_critic, new_actor), slow, (opt_a, opt_c, opt_p)

  return (trained, critic, [optimizer.init(x) for x in trained]), update


def make_batch(config: TrainConfig) -> types.Transition:
  """Draws noise in the shapes of a batch."""
  batch = noise.transitions(config)

  def observation(seen: Observation) -> dict[str, Any]:
    assert seen.tool is not None
    state = jnp.concatenate([robot_inputs(seen.robot), seen.tool], axis=-1)
    images = {"pixels/global": seen.global_image, "pixels/wrist": seen.wrist_image}
    return {"state": state, **images}

  return types.Transition(
    observation=observation(batch.observation_tm1),
    action=batch.action_tm1,
    reward=batch.reward_t,
    discount=jnp.ones_like(batch.discount_t),
    next_observation=observation(batch.observation_t),
    extras={"state_extras": {"truncation": jnp.zeros_like(batch.reward_t)}},
  )


def build(settings: Mapping[str, Any]) -> sides.Built:
  """Builds the learner; one update per call, as Brax does by default."""
  config = with_batch(load_preset(settings["preset"]), settings["batch"])
  state, update = make_update(config.agent, make_batch(config))

  def step(state: Any, call: int) -> Any:
    return jax.block_until_ready(update(state, jax.random.key(call)))

  about = {"version": brax.__version__, "backend": jax.default_backend()}
  return {"updates": sides.rate_of(sides.carried(step, state), 1)}, about
