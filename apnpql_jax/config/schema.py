"""Settings of a training run: frozen dataclasses, to and from JSON.

Every field has a docstring because the command line shows it as help. A field that is
``added`` came after the present format of checkpoints: older runs, which lack it, can
still be resumed and evaluated. This module imports neither JAX nor MuJoCo, so that
``apnpql --help`` is instant.
"""

from __future__ import annotations

import dataclasses
import math

from apnpql_jax.config import codec
from apnpql_jax.config.ranges import RandomizationConfig


@dataclasses.dataclass(frozen=True)
class EnvConfig:
  """The world the agent acts in."""

  task: str = "push_plate"
  """Task to solve; `apnpql list` names them."""

  obs: str = "pixels"
  """What the agent sees: pixels (two cameras) or state (points of the objects)."""

  backend: str = "auto"
  """Physics engine: mjx, native (C MuJoCo), or auto (native on CPU, mjx elsewhere)."""

  worlds: int = 32
  """Worlds stepped at once."""

  time_limit_s: float = 14.0
  """Length of an episode in seconds; a time-out truncates."""

  control_period_s: float = 0.15
  """Time between two actions in seconds."""

  bank_rows: int = 2048
  """Reset states kept in the bank of a task (built once, cached on disk)."""

  global_size: tuple[int, int] = codec.added((72, 96))
  """Height and width of the global camera's image in pixels."""

  wrist_size: tuple[int, int] = codec.added((36, 64))
  """Height and width of the wrist camera's image in pixels."""

  shadows: bool = codec.added(False)
  """The hand throws a shadow on the table, which tells its height."""

  randomize: bool = codec.added(False)
  """Every episode has a world of its own, within the ranges of `randomization`."""

  randomization: RandomizationConfig = codec.added(RandomizationConfig())
  """Ranges of domain randomization, in effect with `randomize`."""

  @property
  def episode_steps(self) -> int:
    """Actions in a full episode: whole control periods within the time limit."""
    return int(math.floor(self.time_limit_s / self.control_period_s + 1e-6))


@dataclasses.dataclass(frozen=True)
class AgentConfig:
  """The learner. Defaults are the paper's constants where it gives them."""

  algorithm: str = "ap_npql"
  """Policy-improvement scheme (a row of Table I); `apnpql list` names them."""

  gamma: float = 0.99
  """Discount per control period."""

  n_step: int = 3
  """Rewards summed before the value target bootstraps."""

  learning_rate_e: float = 3e-4
  """Adam rate of the E-step: features, action primitives, value; also of the
  parametric policy, where there is one."""

  learning_rate_m: float = 3e-4
  """Adam rate of the M-step: the parametric prior."""

  learning_rate_alpha: float = 1e-4
  """Adam rate of the temperature alpha (dual of the KL limit)."""

  learning_rate_nu: float = 1e-4
  """Adam rate of the multiplier nu (dual of the entropy floor)."""

  target_rate: float = 0.05
  """Share of the online network mixed into the target network at each update."""

  target_samples: int = 120
  """Candidate actions per state in the value target."""

  policy_samples: int = 100
  """Candidate actions per state when acting and in the alpha and M updates."""

  hidden: tuple[int, ...] = (256, 256)
  """Widths of the hidden layers of each head."""

  num_atoms: int = 51
  """Atoms of the categorical value distribution."""

  v_min: float = 0.0
  """Smallest return the value distribution can express."""

  v_max: float = 1.0
  """Largest return the value distribution can express."""

  epsilon: float = 1.0
  """Limit of the KL from the policy to the prior in nats; below log of the number of
  candidates where these are weighed. With a uniform prior and a reverse KL (sac) it is
  a floor on the entropy of the policy, 4.85 - epsilon."""

  temperature: str = "state"
  """How the limit is kept: an alpha for each state, one shared by all states (the limit
  then holds on average), or fixed at initial_alpha (the limit is not kept)."""

  regularizer: str = codec.renamed("row", formerly="regulariser")
  """What the policy is kept close to: row (as in Table I) or uniform (no prior)."""

  policy_evaluation: str = "row"
  """How values are learnt: row (as in Table I), categorical, td0, retrace or
  clipped_double_q. TD(0) proper has n_step 1."""

  prior_mean: str = "primitives"
  """Means of the prior: primitives (predicted), or learned by the M-step."""

  diagonal_covariance: bool = False
  """Prior and policy move each joint by itself."""

  epsilon_nu: float = 0.0
  """Entropy floor of the prior in nats."""

  lambda_ap: float = 10.0
  """Weight of the behavior-cloning loss of the action primitives."""

  feature_dim: int = 256
  """Size of the shared feature vector phi."""

  max_grad_norm: float = 10.0
  """Gradients are scaled down to this global norm, each optimizer by itself."""

  patch_channels: int = 32
  """Channels of the first convolution (4x4 patches) of each camera."""

  conv_channels: int = 32
  """Channels of the second convolution of each camera."""

  residual_blocks: int = codec.added(0)
  """Residual blocks, two 3x3 convolutions each, after the second convolution of each
  camera; the paper has none. Slow on a CPU."""

  lstm_instants: int = codec.added(0)
  """Instants of an episode, up to the present one, that an LSTM makes phi of (Fig. 2);
  0: no LSTM. The networks then look at so many times the images."""

  global_features: str = codec.added("map")
  """What is kept of the convolutions of the global camera: map (flattened); keypoints
  (where each channel scores highest), which learn from fewer scenes; or both."""

  wrist_features: str = codec.added("map")
  """The same for the camera on the wrist."""

  conv_overlap: bool = True
  """Second convolution 3x3 with stride 2; else 2x2 patches, faster but coarser."""

  image_shift: int = codec.added(0)
  """Images of a batch are moved at random by up to so many pixels along each axis; 0:
  they stay as they are."""

  color_jitter: float = codec.added(0.0)
  """Color channels of the images of a batch are multiplied at random by factors this
  close to 1; 0: they stay as they are."""

  ap_delta: float = 0.1
  """Error in rad/s above which the loss of the action primitives becomes linear."""

  m_step_delay: int = 0
  """Updates before the M-step begins: until the values tell good from bad, the prior
  would only follow their errors, away from the action primitives."""

  min_std: float = 0.05
  """Floor of the prior's standard deviation of each joint, rad/s."""

  initial_std: float = 0.2
  """The prior's standard deviation of each joint before training, rad/s."""

  max_std: float = 0.3
  """Limit of the prior's standard deviation of each joint, rad/s."""

  policy_min_std: float = 0.01
  """Floor of the parametric policy's standard deviation of each joint, rad/s."""

  policy_initial_std: float = 0.3
  """The parametric policy's standard deviation of each joint before training, rad/s."""

  policy_max_std: float = 1.0
  """Limit of the parametric policy's standard deviation of each joint, rad/s."""

  policy_min_prob: float = 0.001
  """Smallest probability of a gripper command in the parametric policy."""

  min_prob: float = 0.05
  """Smallest probability of a gripper command in the prior, and weight of a component
  at its floor while another is at its limit, so that none is ever ruled out."""

  initial_alpha: float = 0.1
  """Temperature before training, on top of min_alpha, in units of return."""

  min_alpha: float = 1e-3
  """Floor of the temperature, in units of return: smaller differences of value are
  taken for noise."""

  initial_value: float = 0.05
  """Expected return before training; low, for sparse reward has little to unlearn."""


@dataclasses.dataclass(frozen=True)
class ReplayConfig:
  """The agent's and the expert's replay."""

  capacity: int = 51_200
  """Slots of the agent replay over all worlds; a slot is one instant of one world."""

  expert_steps: int = 6_400
  """Slots of the expert replay, filled by the scripted expert before training."""

  expert_share: float = 0.25
  """Share of each batch drawn from the expert replay."""

  batch_size: int = 64
  """Transitions per update, both replays together."""

  demonstrations: str = codec.added("")
  """File of demonstrations to fill the expert replay from, in place of the scripted
  expert; docs/demonstrations.md has the format."""

  expert_noise: float = 0.03
  """Standard deviation of the noise on the expert's joint velocities, rad/s. At 0.1 it
  hardly grips anything any more."""


@dataclasses.dataclass(frozen=True)
class TrainConfig:
  """Everything that decides a run, apart from the machine."""

  env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
  """The world the agent acts in."""

  agent: AgentConfig = dataclasses.field(default_factory=AgentConfig)
  """The learner."""

  replay: ReplayConfig = dataclasses.field(default_factory=ReplayConfig)
  """The agent's and the expert's replay."""

  seed: int = 0
  """Seed of every random number of the run."""

  total_steps: int = 200_000
  """Environment steps to train for, summed over worlds."""

  rollout_length: int = 8
  """Control periods each world plays per iteration."""

  updates_per_iteration: int = 16
  """Learner updates per iteration."""

  eval_every: int = 20_000
  """Environment steps between two evaluations."""

  eval_episodes: int = 64
  """Held-out episodes per evaluation."""

  checkpoint_every: int = 20_000
  """Environment steps between two checkpoints."""

  keep_checkpoints: int = 2
  """Newest checkpoints kept on disk."""

  save_replay_every: int = 0
  """Environment steps between two checkpoints that hold the replay too; 0: all do. A
  run resumed from one without goes on with an older replay, so not bit by bit."""

  max_skipped_updates: int = 100
  """Updates in a row that may be skipped, because a gradient is not finite, before
  the run stops."""

  video: bool = True
  """Write a video of evaluation episodes."""

  sinks: tuple[str, ...] = ()
  """Where metrics go besides the run folder: tensorboard, wandb."""
