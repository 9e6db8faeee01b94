"""Brax's soft actor-critic on the same images: its losses, optimisers and vision nets.

A side of peers.py. Brax's own training loop takes vectors only, so the update is put
together from its public parts in the order in which that loop does it, with its vision
network of the same convolutions and widths. Policy and critics each have an encoder,
as its networks know no shared one, and there is one action instead of candidates.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)
from brax.training import distribution, gradients, networks, types
from brax.training.agents.sac import losses
from brax.training.agents.sac.networks import SACNetworks
from flax import linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import sides

from apnpql_jax.config.files import load_preset
from apnpql_jax.config.schema import AgentConfig

ACTION_DIM = 7
IMAGES = {"pixels/global": (72, 96), "pixels/wrist": (36, 64)}
TAU = 0.005

Array = jax.Array


class Critic(nn.Module):
  """Twin Q on a vision network: (observation, action) -> f32[B, 2]."""

  config: AgentConfig

  @nn.compact
  def __call__(self, observation: dict[str, Array], action: Array) -> Array:
    seen = vision(self.config, [self.config.feature_dim])(floats(observation))
    x = jnp.concatenate([nn.relu(seen), action], axis=-1)
    twins = [networks.MLP([*self.config.hidden, 1])(x) for _ in range(2)]
    return jnp.concatenate(twins, axis=-1)


class Policy(nn.Module):
  """Observation -> parameters of the policy's distribution."""

  config: AgentConfig
  outputs: int

  @nn.compact
  def __call__(self, observation: dict[str, Array]) -> Array:
    widths = [self.config.feature_dim, *self.config.hidden, self.outputs]
    return vision(self.config, widths)(floats(observation))


def vision(config: AgentConfig, widths: list[int]) -> networks.VisionMLP:
  """Brax's convolutions and dense layers, in the sizes of this project's encoder."""
  return networks.VisionMLP(
    layer_sizes=widths,
    state_obs_key="state",
    cnn_output_channels=(config.patch_channels, config.conv_channels),
    cnn_kernel_size=(4, 3 if config.conv_overlap else 2),
    cnn_stride=(4, 2),
    cnn_global_pool="none",
  )


def floats(observation: dict[str, Array]) -> dict[str, Array]:
  """Images as numbers in [0, 1]."""
  return {k: x / 255.0 if x.ndim > 2 else x for k, x in observation.items()}


def make_networks(config: AgentConfig, batch: types.Transition) -> SACNetworks:
  """The networks in the form that Brax's losses call."""
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
  """The state before learning, and (state, key) -> state after one update."""
  nets = make_networks(config, batch)
  parts = losses.make_losses(
    nets, reward_scaling=1.0, discounting=config.gamma, action_size=ACTION_DIM
  )
  optimisers = [optax.adam(rate) for rate in (3e-4, 3e-4, 3e-4)]
  alpha_step, critic_step, actor_step = (
    gradients.gradient_update_fn(loss, optimiser, pmap_axis_name=None)
    for loss, optimiser in zip(parts, optimisers, strict=True)
  )
  keys = jax.random.split(jax.random.key(0))
  alpha = jnp.zeros(())
  critic, actor = nets.q_network.init(keys[0]), nets.policy_network.init(keys[1])
  trained = (alpha, critic, actor)
  opt = [o.init(x) for o, x in zip(optimisers, trained, strict=True)]

  @jax.jit
  def update(state: Any, key: Array) -> Any:
    (log_alpha, critic, actor), slow, (opt_a, opt_c, opt_p) = state
    keys = jax.random.split(key, 3)
    _, new_alpha, opt_a = alpha_step(
      log_alpha, actor, None, batch, keys[0], optimizer_state=opt_a
    )
    alpha = jnp.exp(log_alpha)
    _, new_critic, opt_c = critic_step(
      critic, actor, None, slow, alpha, batch, keys[1], optimizer_state=opt_c
    )
    _, new_actor, opt_p = actor_step(
      actor, None, critic, alpha, batch, keys[2], optimizer_state=opt_p
    )
    slow = jax.tree.map(lambda old, new: old + TAU * (new - old), slow, new_critic)
    return (new_alpha, new_critic, new_actor), slow, (opt_a, opt_c, opt_p)

  return (trained, critic, opt), update


def random_batch(count: int) -> types.Transition:
  """Noise in the shapes of a batch."""
  rng = np.random.default_rng(0)

  def observation() -> dict[str, Array]:
    images = {k: rng.integers(0, 256, (count, *s, 3)) for k, s in IMAGES.items()}
    seen = {k: jnp.asarray(x, jnp.uint8) for k, x in images.items()}
    return seen | {"state": jnp.asarray(rng.normal(size=(count, 33)), jnp.float32)}

  return types.Transition(
    observation=observation(),
    action=jnp.asarray(rng.uniform(-1, 1, (count, ACTION_DIM)), jnp.float32),
    reward=jnp.asarray(rng.integers(0, 2, count), jnp.float32),
    discount=jnp.ones(count),
    next_observation=observation(),
    extras={"state_extras": {"truncation": jnp.zeros(count)}},
  )


def main(settings: dict[str, Any]) -> None:
  """Serves updates, one per call, as Brax does unless told otherwise."""
  import brax

  config = load_preset(settings["preset"]).agent
  state, update = make_update(config, random_batch(settings["batch"]))
  now = {"state": state, "calls": 0}

  def run() -> None:
    after = update(now["state"], jax.random.key(now["calls"]))
    now.update(state=jax.block_until_ready(after), calls=now["calls"] + 1)

  versions = {"version": brax.__version__, "backend": jax.default_backend()}
  sides.serve({"updates": sides.rate_of(run, 1)}, **versions)


if __name__ == "__main__":
  main(json.loads(sys.argv[1]))
