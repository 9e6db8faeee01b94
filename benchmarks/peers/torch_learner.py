"""AP-NPQL in plain PyTorch: the same networks, candidates, losses and optimizers.

A side of compare.py: float32, all cores or the GPU, in eager mode, as most learners in
PyTorch run, or with losses under ``torch.compile``. As in this project, features are
computed once per observation, and the first layer of Z is split. Distributions and
convolutions are those of the library. Limits are plain clips, and the entropy of the
prior is the mean of its components.
"""

from collections.abc import Iterator
import copy
import itertools
import math

import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Bernoulli, Categorical, MultivariateNormal
import torch.nn.functional as F

from apnpql_jax.config.files import load_preset
from apnpql_jax.config.schema import AgentConfig
from benchmarks.common.settings import with_candidates
from benchmarks.peers import sides

JOINTS, PRIMITIVES, ACTION = 6, 3, 7
BELOW = JOINTS * (JOINTS - 1) // 2
SHARPNESS, STEP_SCALE, POSITION_SCALE = 4.0, 7.0, 5.0
"""Scales of our encoder: of keypoints, changes of joints, and the tool's position."""
IMAGES = {"global": (72, 96), "wrist": (36, 64)}

Batch = dict[str, Tensor]


class Camera(nn.Module):
  """Two convolutions, with a projection of their map and keypoints as configured."""

  def __init__(self, config: AgentConfig, size: tuple[int, int], kept: str):
    super().__init__()
    first, second = config.patch_channels, config.conv_channels
    height, width = (8 * math.ceil(side / 8) for side in size)
    self.padding = (0, width - size[1], 0, height - size[0])
    self.first = nn.Conv2d(3, first, 4, stride=4)
    kernel = 3 if config.conv_overlap else 2
    self.second = nn.Conv2d(first, second, kernel, stride=2, padding=kernel // 3)
    self.project, cells = None, height * width // 64
    if kept != "keypoints":
      self.project = nn.Linear(cells * second, config.feature_dim, bias=False)
    self.points = 0 if kept == "map" else 2 * (first + second)

  def forward(self, image: Tensor) -> tuple[Tensor | float, list[Tensor]]:
    """Maps u8[B, 3, H, W] to f32[B, feature_dim] and keypoints f32[B, points]."""
    patches = self.first(F.pad(image.float() / 255.0, self.padding))
    x = self.second(F.relu(patches))
    seen = self.project(F.relu(x).flatten(1)) if self.project else 0.0
    return seen, [keypoints(patches), keypoints(x)] if self.points else []


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
    newest, changes = robot[:, -1], STEP_SCALE * (robot[:, 1:] - robot[:, :-1])
    joints, tool = newest[:, :JOINTS], POSITION_SCALE * batch[f"tool_{time}"]
    state = [newest, joints.sin(), joints.cos(), changes.flatten(1), tool]
    seen = [camera(batch[f"{name}_{time}"]) for name, camera in self.cameras.items()]
    maps, points = zip(*seen, strict=True)
    x = self.state(torch.cat([*state, *itertools.chain(*points)], -1))
    return F.relu(self.norm(self.from_state(F.relu(x)) + sum(maps)))


class ValueHead(nn.Module):
  """The value head Z: (phi, S actions) -> logits of the atoms."""

  def __init__(self, config: AgentConfig):
    super().__init__()
    self.phi = nn.Linear(config.feature_dim, config.hidden[0])
    self.action = nn.Linear(ACTION, config.hidden[0], bias=False)
    self.rest = mlp(*config.hidden, config.num_atoms)

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
    index = component[..., None, None].expand(*component.shape, 1, ACTION)
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
    widths = (config.feature_dim, *config.hidden)
    self.encoder, self.z = Encoder(config), ValueHead(config)
    self.ap = mlp(*widths, PRIMITIVES * ACTION)
    self.bp = mlp(*widths, PRIMITIVES * (JOINTS + BELOW + 2))
    self.alpha = mlp(*widths, 1)
    atoms = torch.linspace(config.v_min, config.v_max, config.num_atoms)
    self.register_buffer("atoms", atoms)

  def temperature(self, phi: Tensor) -> Tensor:
    """Returns alpha, f32[B]."""
    raw = self.alpha(phi.detach())[..., 0]
    initial = self.config.initial_alpha
    offset = initial + math.log(-math.expm1(-initial))
    return F.softplus(raw + offset) + self.config.min_alpha

  def primitives(self, phi: Tensor) -> Tensor:
    """Returns the predicted primitives, f32[B, 3, 7]."""
    return self.ap(phi).unflatten(-1, (PRIMITIVES, ACTION))

  def prior(self, phi: Tensor) -> Prior:
    """Returns b at the states; its gradient reaches ``bp`` alone."""
    raw = self.bp(phi.detach()).unflatten(-1, (PRIMITIVES, -1))
    return Prior(raw, self.primitives(phi).detach(), self.config)

  @torch.no_grad()
  def improved(self, phi: Tensor, count: int) -> tuple[Tensor, ...]:
    """Returns candidates of q, their return distributions, values and weights."""
    samples = self.prior(phi).sample(count)
    probs = F.softmax(self.z(phi, samples.clamp(-1.0, 1.0)), -1)
    values = probs @ self.atoms
    return samples, probs, values, F.softmax(values / self.temperature(phi), 0)


class Learner:
  """Algorithm 1: one update per call of ``update``."""

  def __init__(self, config: AgentConfig, device: str, *, compiled: bool):
    """Builds the learner; ``compiled``: ``torch.compile`` makes its losses faster."""
    self.config, self.online = config, Networks(config).to(device)
    self._loss = torch.compile(self._sum) if compiled else self._sum
    self.target = copy.deepcopy(self.online).requires_grad_(False)
    self.nu = torch.zeros((), device=device, requires_grad=True)
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
    loss = self._loss(batch)
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

  def _sum(self, batch: Batch) -> Tensor:
    return torch.stack(list(self._losses(batch))).sum()

  def _losses(self, batch: Batch) -> Iterator[Tensor]:
    config, net = self.config, self.online
    phi = net.encoder(batch, "tm1")
    predicted, label = net.primitives(phi), batch["primitives"]
    arm = (predicted[..., :-1], label[..., :-1])
    close = (predicted[..., -1], label[..., -1])
    yield config.lambda_ap * F.huber_loss(*arm, delta=config.ap_delta) / config.ap_delta
    yield config.lambda_ap * F.binary_cross_entropy_with_logits(*close)
    logits = net.z(phi, batch["action"][None])[0]
    yield -(self._target(batch) * F.log_softmax(logits, -1)).sum(-1).mean()
    samples, _, values, weights = net.improved(phi, config.policy_samples)
    prior, alpha = net.prior(phi), net.temperature(phi)
    entropy = prior.entropy()
    yield -(weights * prior.log_prob(samples)).sum(0).mean()
    yield -(self.nu.detach() * entropy).mean()
    yield self.nu * (entropy.detach() - config.epsilon_nu).mean()
    log_mean = torch.logsumexp(values / alpha, 0) - math.log(config.policy_samples)
    yield (alpha * (config.epsilon + log_mean)).mean()

  @torch.no_grad()
  def _target(self, batch: Batch) -> Tensor:
    """Returns the projected distributional target, f32[B, atoms]."""
    config, net = self.config, self.target
    phi = net.encoder(batch, "t")
    _, probs, _, weights = net.improved(phi, config.target_samples)
    probs = (weights[..., None] * probs).sum(0)
    moved = batch["reward"][:, None] + batch["discount"][:, None] * net.atoms
    low, high, steps = config.v_min, config.v_max, config.num_atoms - 1
    place = (moved.clamp(low, high) - low) / (high - low) * steps
    lower = place.floor().clamp(max=steps - 1)
    share, index = place - lower, lower.long()
    goal = torch.zeros_like(probs).scatter_add_(-1, index, probs * (1.0 - share))
    return goal.scatter_add_(-1, index + 1, probs * share)


def keypoints(scores: Tensor) -> Tensor:
  """Returns the soft-argmax of each channel in [-1, 1]; f32[B, C, H, W] -> [B, 2 C]."""
  size = scores.shape[-2:]
  share = F.softmax(SHARPNESS * scores.flatten(2), -1).unflatten(-1, size)
  rows, columns = ((2 * torch.arange(n).to(share.device) + 1) / n - 1 for n in size)
  return torch.stack([share.sum(-1) @ rows, share.sum(-2) @ columns], -1).flatten(1)


def mlp(*widths: int) -> nn.Sequential:
  """Returns linear layers with relu between them."""
  layers: list[nn.Module] = []
  for before, after in itertools.pairwise(widths):
    layers += [nn.Linear(before, after), nn.ReLU()]
  return nn.Sequential(*layers[:-1])


def random_batch(count: int, device: str) -> Batch:
  """Draws noise in the shapes of a batch."""
  rng = np.random.default_rng(0)
  shapes: dict[str, tuple[int, ...]] = {"action": (ACTION,), "reward": ()}
  shapes |= {"discount": (), "primitives": (PRIMITIVES, ACTION)}
  batch: Batch = {}
  for time in ("tm1", "t"):
    shapes |= {f"robot_{time}": (21,), f"tool_{time}": (3,)}
    for name, size in IMAGES.items():
      image = rng.integers(0, 256, (count, 3, *size), np.uint8)
      batch[f"{name}_{time}"] = torch.as_tensor(image, device=device)
  for name, shape in shapes.items():
    batch[name] = torch.rand((count, *shape), device=device)
  return batch


def build(settings: sides.Settings) -> sides.Built:
  """Builds the learner of a preset."""
  device = "cuda" if torch.cuda.is_available() else "cpu"
  config = with_candidates(load_preset(settings["preset"]), settings["candidates"])
  learner = Learner(config.agent, device, compiled=settings["compiled"])
  batch = random_batch(settings["batch"], device)
  threads = torch.get_num_threads()
  about = {"version": torch.__version__, "device": device, "threads": threads}
  return {"updates": sides.rate_of(lambda: learner.update(batch), 1)}, about
