"""AP-NPQL in plain PyTorch: the same networks, candidates, losses and optimizers.

A side of compare.py: eager mode, float32, all cores or the GPU, as most learners in
PyTorch run. As in this project, features are computed once per observation, and the
first layer of Z is split. Distributions and convolutions are those of the library.
Limits are plain clips, and the entropy of the prior is the mean of its components.
"""

from __future__ import annotations

from collections.abc import Mapping
import copy
import dataclasses
import math
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.distributions import Bernoulli, Categorical, MultivariateNormal
import torch.nn.functional as F

from apnpql_jax.config import AgentConfig
from apnpql_jax.presets import load_preset
from benchmarks.peers import sides

JOINTS, PRIMITIVES = 6, 3
BELOW = JOINTS * (JOINTS - 1) // 2
SHARPNESS, POSITION_SCALE = 4.0, 5.0
"""Scales of keypoints and of the tool's position, as in our encoder."""
IMAGES = {"global": (72, 96), "wrist": (36, 64)}

Tensor = torch.Tensor
Batch = dict[str, Tensor]


class Camera(nn.Module):
  """Two convolutions; returns the projection of their map, and their keypoints."""

  def __init__(self, config: AgentConfig, size: tuple[int, int], kept: str):
    super().__init__()
    first, second = config.patch_channels, config.conv_channels
    height, width = (8 * math.ceil(side / 8) for side in size)
    self.padding = (0, width - size[1], 0, height - size[0])
    self.first = nn.Conv2d(3, first, 4, stride=4)
    kernel = 3 if config.conv_overlap else 2
    self.second = nn.Conv2d(first, second, kernel, stride=2, padding=kernel // 3)
    cells = height * width // 64
    self.project = None
    if kept != "keypoints":
      self.project = nn.Linear(cells * second, config.feature_dim, bias=False)
    self.points = 0 if kept == "map" else 2 * (first + second)

  def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
    """Maps u8[B, 3, H, W] to f32[B, feature_dim], zero without a map, and points."""
    patches = self.first(F.pad(image.float() / 255.0, self.padding))
    x = self.second(F.relu(patches))
    seen, points = x.new_zeros(()), x.new_zeros(len(x), 0)
    if self.project is not None:
      seen = self.project(F.relu(x).flatten(1))
    if self.points:
      points = torch.cat([keypoints(patches), keypoints(x)], -1)
    return seen, points


class Encoder(nn.Module):
  """The encoder: observation -> phi."""

  def __init__(self, config: AgentConfig):
    super().__init__()
    kept = {"global": config.global_features, "wrist": config.wrist_features}
    cameras = {name: Camera(config, size, kept[name]) for name, size in IMAGES.items()}
    self.cameras = nn.ModuleDict(cameras)
    points = sum(camera.points for camera in cameras.values())
    self.state = nn.Linear(36 + points, config.feature_dim)
    self.from_state = nn.Linear(config.feature_dim, config.feature_dim)
    self.norm = nn.LayerNorm(config.feature_dim)

  def forward(self, batch: Batch, time: str) -> Tensor:
    """Returns phi, f32[B, feature_dim]."""
    robot = batch[f"robot_{time}"].unflatten(-1, (3, 7))
    newest, changes = robot[:, -1], 7.0 * (robot[:, 1:] - robot[:, :-1])
    joints = newest[:, :JOINTS]
    state = [newest, joints.sin(), joints.cos(), changes.flatten(1)]
    state.append(POSITION_SCALE * batch[f"tool_{time}"])
    seen = [camera(batch[f"{name}_{time}"]) for name, camera in self.cameras.items()]
    maps, points = zip(*seen, strict=True)
    x = self.from_state(F.relu(self.state(torch.cat([*state, *points], -1))))
    return F.relu(self.norm(x + sum(maps)))


class ValueHead(nn.Module):
  """The value head Z: (phi, S actions) -> logits of the atoms."""

  def __init__(self, config: AgentConfig):
    super().__init__()
    width = config.hidden[0]
    self.phi = nn.Linear(config.feature_dim, width)
    self.action = nn.Linear(JOINTS + 1, width, bias=False)
    self.rest = mlp([*config.hidden, config.num_atoms])

  def forward(self, phi: Tensor, actions: Tensor) -> Tensor:
    """Maps f32[B, n], f32[S, B, 7] to f32[S, B, atoms]."""
    command = torch.cat([actions[..., :-1], 2.0 * actions[..., -1:] - 1.0], -1)
    return self.rest(F.relu(self.phi(phi) + self.action(command)))


class Prior:
  """A mixture of Gaussians, each with a gripper command."""

  def __init__(self, raw: Tensor, primitives: Tensor, config: AgentConfig):
    """Reads raw outputs f32[B, 3, 23] and primitives f32[B, 3, 7]."""
    log_std, below, weight, close = raw.split([JOINTS, BELOW, 1, 1], -1)
    log_std = log_std + math.log(config.initial_std)
    log_std = log_std.clamp(math.log(config.min_std), math.log(config.max_std))
    rows, columns = torch.tril_indices(JOINTS, JOINTS, -1)
    tril = torch.eye(JOINTS, device=raw.device).repeat(*raw.shape[:-1], 1, 1)
    tril[..., rows, columns] = below.clamp(-1.0, 1.0)
    tril = log_std.exp()[..., None] * F.normalize(tril, dim=-1)
    surest = math.log((1.0 - config.min_prob) / config.min_prob)
    self.logits = F.log_softmax(weight[..., 0].clamp(-surest, surest), -1)
    mean = primitives[..., :-1].clamp(-1.0, 1.0)
    self.arm = MultivariateNormal(mean, scale_tril=tril)
    odds = (primitives[..., -1] + close[..., 0]).clamp(-surest, surest)
    self.gripper = Bernoulli(logits=odds)

  def sample(self, count: int) -> Tensor:
    """Draws f32[S, B, 7]."""
    arm, close = self.arm.sample((count,)), self.gripper.sample((count,))
    draws = torch.cat([arm, close[..., None]], -1)
    component = Categorical(logits=self.logits).sample((count,))
    index = component[..., None, None].expand(*component.shape, 1, JOINTS + 1)
    return draws.gather(-2, index)[..., 0, :]

  def log_prob(self, actions: Tensor) -> Tensor:
    """Returns log densities f32[S, B] of actions f32[S, B, 7]."""
    arm = self.arm.log_prob(actions[..., None, :-1])
    gripper = self.gripper.log_prob(actions[..., -1:])
    return torch.logsumexp(self.logits + arm + gripper, -1)

  def entropy(self) -> Tensor:
    """Returns the mean entropy of the components, f32[B]."""
    each = self.arm.entropy() + self.gripper.entropy()
    return (self.logits.exp() * each).sum(-1)


class Networks(nn.Module):
  """The encoder and the heads."""

  def __init__(self, config: AgentConfig):
    super().__init__()
    if config.algorithm != "ap_npql":
      raise ValueError("only ap_npql is written in PyTorch")
    self.config = config
    widths = [config.feature_dim, *config.hidden]
    self.encoder = Encoder(config)
    self.ap = mlp([*widths, PRIMITIVES * (JOINTS + 1)])
    self.bp = mlp([*widths, PRIMITIVES * (JOINTS + BELOW + 2)])
    self.z = ValueHead(config)
    self.alpha = mlp([*widths, 1])

  def temperature(self, phi: Tensor) -> Tensor:
    """Returns alpha, f32[B]."""
    offset = math.log(math.expm1(self.config.initial_alpha))
    raw = self.alpha(phi.detach())[..., 0]
    return F.softplus(raw + offset) + self.config.min_alpha

  def primitives(self, phi: Tensor) -> Tensor:
    """Returns the predicted primitives, f32[B, 3, 7]."""
    return self.ap(phi).unflatten(-1, (PRIMITIVES, JOINTS + 1))

  def prior(self, phi: Tensor) -> Prior:
    """Returns b at the states; its gradient reaches ``bp`` alone."""
    raw = self.bp(phi.detach()).unflatten(-1, (PRIMITIVES, -1))
    return Prior(raw, self.primitives(phi).detach(), self.config)

  @torch.no_grad()
  def improved(self, phi: Tensor, count: int, atoms: Tensor) -> tuple[Tensor, ...]:
    """Returns candidates of q, their return distributions, values and weights."""
    samples = self.prior(phi).sample(count)
    probs = F.softmax(self.z(phi, samples.clamp(-1.0, 1.0)), -1)
    values = probs @ atoms
    weights = F.softmax(values / self.temperature(phi), 0)
    return samples, probs, values, weights


class Learner:
  """Algorithm 1: one update per call of ``update``."""

  def __init__(self, config: AgentConfig, device: str):
    self.config = config
    self.online = Networks(config).to(device)
    self.target = copy.deepcopy(self.online).requires_grad_(False)
    self.nu = torch.zeros((), device=device, requires_grad=True)
    span = (config.v_min, config.v_max, config.num_atoms)
    self.atoms = torch.linspace(*span, device=device)
    net = self.online
    groups = {
      "e": [*net.encoder.parameters(), *net.ap.parameters(), *net.z.parameters()],
      "m": [*net.bp.parameters()],
      "alpha": [*net.alpha.parameters()],
      "nu": [self.nu],
    }
    self.optimizers = [
      torch.optim.Adam(group, getattr(config, f"learning_rate_{name}"))
      for name, group in groups.items()
    ]

  def update(self, batch: Batch) -> float:
    """Takes one update and returns the sum of the losses."""
    config, net = self.config, self.online
    goal = self._target(batch)
    phi = net.encoder(batch, "tm1")
    logits = net.z(phi, batch["action"][None])[0]
    samples, _, values, weights = net.improved(phi, config.policy_samples, self.atoms)
    prior, alpha = net.prior(phi), net.temperature(phi)
    log_mean = torch.logsumexp(values / alpha, 0) - math.log(config.policy_samples)
    entropy = prior.entropy()
    loss = (
      config.lambda_ap * ap_loss(net.primitives(phi), batch["primitives"], config)
      - (goal * F.log_softmax(logits, -1)).sum(-1).mean()
      - (weights * prior.log_prob(samples)).sum(0).mean()
      - (self.nu.detach() * entropy).mean()
      + (alpha * (config.epsilon + log_mean)).mean()
      + self.nu * (entropy.detach() - config.epsilon_nu).mean()
    )
    for optimizer in self.optimizers:
      optimizer.zero_grad()
    loss.backward()
    for optimizer in self.optimizers:
      parameters = optimizer.param_groups[0]["params"]
      nn.utils.clip_grad_norm_(parameters, config.max_grad_norm)
      optimizer.step()
    with torch.no_grad():
      self.nu.clamp_(min=0.0)
      for old, new in zip(self.target.parameters(), net.parameters(), strict=True):
        old.lerp_(new, config.target_rate)
    return loss.item()

  @torch.no_grad()
  def _target(self, batch: Batch) -> Tensor:
    """Returns the projected distributional target, f32[B, atoms]."""
    phi = self.target.encoder(batch, "t")
    count = self.config.target_samples
    _, probs, _, weights = self.target.improved(phi, count, self.atoms)
    probs = (weights[..., None] * probs).sum(0)
    low, high = self.config.v_min, self.config.v_max
    moved = batch["reward"][:, None] + batch["discount"][:, None] * self.atoms
    place = (moved.clamp(low, high) - low) / (high - low) * (len(self.atoms) - 1)
    lower = place.floor().clamp(max=len(self.atoms) - 2)
    share = place - lower
    index = lower.long()
    goal = torch.zeros_like(probs).scatter_add_(-1, index, probs * (1.0 - share))
    return goal.scatter_add_(-1, index + 1, probs * share)


def keypoints(scores: Tensor) -> Tensor:
  """Returns the soft-argmax of each channel in [-1, 1]; f32[B, C, H, W] -> [B, 2 C]."""
  height, width = scores.shape[-2:]
  share = F.softmax(SHARPNESS * scores.flatten(2), -1).unflatten(-1, (height, width))
  half = [(torch.arange(n, device=scores.device) + 0.5) / n for n in (height, width)]
  rows, columns = (2 * places - 1 for places in half)
  return torch.stack([share.sum(-1) @ rows, share.sum(-2) @ columns], -1).flatten(1)


def ap_loss(predicted: Tensor, label: Tensor, config: AgentConfig) -> Tensor:
  """Returns the behavior cloning loss of the primitives."""
  delta = config.ap_delta
  huber = F.huber_loss(predicted[..., :-1], label[..., :-1], delta=delta) / delta
  command = F.binary_cross_entropy_with_logits(predicted[..., -1], label[..., -1])
  return huber + command


def mlp(widths: list[int]) -> nn.Sequential:
  """Returns linear layers with relu between them."""
  layers: list[nn.Module] = []
  for before, after in zip(widths, widths[1:], strict=False):
    layers += [nn.Linear(before, after), nn.ReLU()]
  return nn.Sequential(*layers[:-1])


def random_batch(count: int, device: str) -> Batch:
  """Draws noise in the shapes of a batch."""
  rng = np.random.default_rng(0)
  batch: dict[str, np.ndarray] = {
    "action": rng.uniform(-1, 1, (count, 7)),
    "reward": rng.integers(0, 2, count),
    "discount": np.full(count, 0.97),
    "primitives": rng.uniform(0, 1, (count, PRIMITIVES, 7)),
  }
  for time in ("tm1", "t"):
    batch[f"robot_{time}"] = rng.normal(size=(count, 21))
    batch[f"tool_{time}"] = rng.normal(size=(count, 3))
    for name, size in IMAGES.items():
      batch[f"{name}_{time}"] = rng.integers(0, 256, (count, 3, *size), np.uint8)
  return {
    name: torch.as_tensor(x if x.dtype == np.uint8 else x.astype(np.float32)).to(device)
    for name, x in batch.items()
  }


def build(settings: Mapping[str, Any]) -> sides.Built:
  """Builds the learner of a preset."""
  device = "cuda" if torch.cuda.is_available() else "cpu"
  count = settings["candidates"]
  config = dataclasses.replace(
    load_preset(settings["preset"]).agent, target_samples=count, policy_samples=count
  )
  learner, batch = Learner(config, device), random_batch(settings["batch"], device)
  threads = torch.get_num_threads()
  about = {"version": torch.__version__, "device": device, "threads": threads}
  return {"updates": sides.rate_of(lambda: learner.update(batch), 1)}, about
