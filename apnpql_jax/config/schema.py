"""Settings of a training run as frozen dataclasses.

The command line shows the docstrings of the fields as help. Older runs lack the fields
marked ``added``; they can still be resumed and evaluated. Importing this module imports
neither JAX nor MuJoCo, so that ``apnpql --help`` is fast.
"""

from __future__ import annotations

import dataclasses
import math

from apnpql_jax.config import codec
from apnpql_jax.config.ranges import RandomizationConfig


@dataclasses.dataclass(frozen=True)
class EnvConfig:
  """The environment."""

  task: str = "push_plate"
  """Task to solve; `apnpql list` shows all."""

  task_file: str = codec.added("")
  """Python file of the task if it is not installed. It is set from --task-file or the
  path of the preset, and the file is never executed because of it."""

  obs: str = "pixels"
  """Observations: pixels (two cameras) or state (points on the objects)."""

  backend: str = "auto"
  """Physics engine: mjx, native (C MuJoCo), or auto (native on CPU, mjx elsewhere)."""

  worlds: int = 32
  """Worlds simulated in parallel."""

  time_limit_s: float = 14.0
  """Length of an episode in seconds; a time-out truncates it."""

  control_period_s: float = 0.15
  """Time between actions in seconds."""

  bank_rows: int = 2048
  """Reset states in the bank of a task, which is built once and cached on disk."""

  global_size: tuple[int, int] = codec.added((72, 96))
  """Height and width of the global camera's image in pixels."""

  wrist_size: tuple[int, int] = codec.added((36, 64))
  """Height and width of the wrist camera's image in pixels."""

  shadows: bool = codec.added(False)
  """Draw the shadow of the hand on the table, a cue to the height of the hand."""

  static_targets: bool = codec.added(False)
  """Primitives lead straight to joint angles that stay fixed: at the object, where the
  object primitive comes to rest; at the goal, where the expert releases the object, or
  solves the task. Each start finds them by playing two episodes per reset state without
  randomization, which takes minutes. For ablations."""

  true_primitives: bool = codec.added(False)
  """Observations include the true primitives, and the prior takes them in place of the
  predicted ones: an oracle, for ablations."""

  randomize: bool = codec.added(False)
  """Randomize the world of every episode, within the ranges of `randomization`."""

  randomization: RandomizationConfig = codec.added(RandomizationConfig())
  """Ranges of domain randomization, in effect with `randomize`."""

  @property
  def episode_steps(self) -> int:
    """Number of actions in a full episode: whole control periods within the limit."""
    return int(math.floor(self.time_limit_s / self.control_period_s + 1e-6))


@dataclasses.dataclass(frozen=True)
class AgentConfig:
  """The learner. Defaults are the paper's values where it gives them."""

  algorithm: str = "ap_npql"
  """Policy-improvement scheme, a row of Table I; `apnpql list` shows all."""

  gamma: float = 0.99
  """Discount factor per control period."""

  n_step: int = 3
  """Rewards summed before the value target bootstraps."""

  learning_rate_e: float = 3e-4
  """Adam learning rate of the E-step (features, primitives, value, policy network)."""

  learning_rate_m: float = 3e-4
  """Adam learning rate of the M-step (parametric prior)."""

  learning_rate_alpha: float = 1e-4
  """Adam learning rate of the temperature alpha (dual of the KL limit)."""

  learning_rate_nu: float = 1e-4
  """Adam learning rate of the multiplier nu (dual of the entropy floor)."""

  decay_updates: int = codec.added(0)
  """Updates after which the learning rates of E-step and M-step have fallen to a tenth,
  along a cosine; 0: they are constant."""

  target_rate: float = 0.05
  """Step size of the moving average that makes the target network."""

  target_samples: int = 120
  """Candidate actions per state in the value target."""

  policy_samples: int = 100
  """Candidate actions per state when acting and in the alpha and M-step updates."""

  candidate_precision: str = codec.added("float32")
  """Precision of the products that value candidate actions: float32, or bfloat16, which
  is faster on CPUs with AVX-512 BF16. The value head is trained in float32."""

  hidden: tuple[int, ...] = (256, 256)
  """Widths of the hidden layers of each head."""

  num_atoms: int = 51
  """Atoms of the categorical value distribution."""

  v_min: float = 0.0
  """Lowest return of the value distribution."""

  v_max: float = 1.0
  """Highest return of the value distribution."""

  epsilon: float = 1.0
  """Limit of the KL divergence from policy to prior in nats; less than the log of the
  number of candidates if these are weighted. With a uniform prior and the reverse KL
  (sac) it bounds the entropy of the policy from below by 4.85 - epsilon."""

  temperature: str = "state"
  """How the KL limit is enforced: state (one alpha per state), shared (one alpha; the
  limit holds on average over states) or fixed (alpha is initial_alpha; no limit)."""

  regularizer: str = codec.renamed("row", formerly="regulariser")
  """What the policy stays close to: row (as in Table I) or uniform (no prior)."""

  policy_evaluation: str = "row"
  """Value loss: row (as in Table I), categorical, td0, retrace or clipped_double_q."""

  prior_mean: str = "primitives"
  """Means of the prior: primitives (predicted) or learned (by the M-step)."""

  primitive_gripper: bool = codec.added(True)
  """Whether a primitive has a gripper command; otherwise only the M-step learns when to
  close, which needs `gripper_offset`."""

  gripper_offset: bool = codec.added(False, before=True)
  """Whether the M-step adds to the logits of closing the gripper that the primitives
  predict; with learned means it always does."""

  diagonal_covariance: bool = False
  """Use diagonal covariances in prior and policy."""

  epsilon_nu: float = 0.0
  """Entropy floor of the prior in nats."""

  lambda_ap: float = 10.0
  """Weight of the behavior-cloning loss of the action primitives."""

  feature_dim: int = 256
  """Size of the shared feature vector phi."""

  max_grad_norm: float = 10.0
  """Global norm that each optimizer clips its gradients to."""

  patch_channels: int = 32
  """Channels of the first convolution (4x4 patches) of each camera."""

  conv_channels: int = 32
  """Channels of the second convolution of each camera."""

  residual_blocks: int = codec.added(0)
  """Residual blocks per camera, none in the paper; slow on a CPU."""

  lstm_instants: int = codec.added(0)
  """Instants that an LSTM reads, each with its images (Fig. 2); 0: no LSTM."""

  global_features: str = codec.added("map")
  """Features of the global camera: map, keypoints (learn from fewer scenes) or both."""

  wrist_features: str = codec.added("map")
  """Features of the wrist camera: map, keypoints or both."""

  conv_overlap: bool = True
  """Second convolution 3x3 with stride 2; otherwise 2x2 patches, faster but coarser."""

  standardize_images: bool = codec.added(False)
  """Shift and scale each color channel of each image to mean 0 and deviation 1."""

  image_shift: int = codec.added(0)
  """Augmentation: largest random image shift along each axis in pixels."""

  color_jitter: float = codec.added(0.0)
  """Augmentation: largest deviation from 1 of random factors on the color channels."""

  ap_delta: float = 0.1
  """Error in rad/s above which the loss of the action primitives is linear."""

  m_step_delay: int = 0
  """Updates before the M-step begins, so that the prior ignores early value errors."""

  min_std: float = 0.05
  """Lower bound of the standard deviation of each joint in the prior (rad/s)."""

  initial_std: float = 0.2
  """Initial standard deviation of each joint in the prior (rad/s)."""

  max_std: float = 0.3
  """Upper bound of the standard deviation of each joint in the prior (rad/s)."""

  policy_min_std: float = 0.01
  """Lower bound of each joint's standard deviation in the parametric policy (rad/s)."""

  policy_initial_std: float = 0.3
  """Initial standard deviation of each joint in the parametric policy (rad/s)."""

  policy_max_std: float = 1.0
  """Upper bound of each joint's standard deviation in the parametric policy (rad/s)."""

  policy_min_prob: float = 0.001
  """Lower bound of gripper probabilities in the parametric policy, also in ap_cem's,
  and, within a factor of policy_components - 1, of its component weights."""

  policy_components: int = codec.added(1)
  """Gaussian components of the parametric policy, one in the paper; their means start
  apart."""

  min_prob: float = 0.05
  """Lower bound of gripper probabilities in the prior and, within a factor of 2, of
  component weights."""

  initial_alpha: float = 0.1
  """Initial temperature in units of return; a softplus adds min_alpha."""

  min_alpha: float = 1e-3
  """Lower bound of the temperature in units of return; value differences below this are
  treated as noise."""

  alpha_floor: str = codec.added("softplus")
  """How alpha stays above min_alpha: softplus, which is added to it, or clip. Only with
  a clip can the limit raise the alpha of a state that has reached the floor."""

  initial_value: float = 0.05
  """Expected return before training; low because reward is sparse."""


@dataclasses.dataclass(frozen=True)
class ReplayConfig:
  """Agent replay and expert replay."""

  capacity: int = 51_200
  """Slots of the agent replay over all worlds; a slot is one instant of one world."""

  expert_steps: int = 6_400
  """Slots of the expert replay, filled by the scripted expert before training."""

  expert_share: float = 0.25
  """Fraction of each batch drawn from the expert replay."""

  batch_size: int = 64
  """Transitions per update from both replays together."""

  demonstrations: str = codec.added("")
  """File of demonstrations (docs/demonstrations.md) instead of the scripted expert."""

  allow_unsolved: bool = codec.added(False, before=True)
  """Whether to train on demonstrations even if no episode in them is solved."""

  expert_noise: float = 0.03
  """Standard deviation of the noise on the expert's joint velocities (rad/s); at 0.1
  the expert rarely grasps."""


@dataclasses.dataclass(frozen=True)
class TrainConfig:
  """Everything that determines a run, apart from the machine."""

  env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
  """The environment."""

  agent: AgentConfig = dataclasses.field(default_factory=AgentConfig)
  """The learner."""

  replay: ReplayConfig = dataclasses.field(default_factory=ReplayConfig)
  """Agent replay and expert replay."""

  seed: int = 0
  """Random seed of the run."""

  total_steps: int = 200_000
  """Environment steps to train for, summed over worlds."""

  rollout_length: int = 8
  """Control periods per world and iteration."""

  updates_per_iteration: int = 16
  """Learner updates per iteration."""

  eval_every: int = 20_000
  """Environment steps between evaluations."""

  eval_episodes: int = 64
  """Held-out episodes per evaluation."""

  eval_acting: str = codec.added("policy")
  """How evaluations choose an action: policy (draws), mean, prior or greedy."""

  checkpoint_every: int = 20_000
  """Environment steps between checkpoints."""

  keep_checkpoints: int = 2
  """Number of latest checkpoints to keep."""

  save_replay_every: int = 0
  """Environment steps between checkpoints that include the replay; 0: all do. A run
  resumed from a checkpoint without a replay uses an older one and is not
  bit-identical."""

  max_skipped_updates: int = 100
  """Stop the run after this many consecutive non-finite (skipped) updates."""

  video: bool = True
  """Write a video of the first episodes of the last evaluation."""

  sinks: tuple[str, ...] = ()
  """Additional outputs of the metrics: tensorboard, wandb."""

  wandb_project: str = codec.added("apnpql_jax")
  """Project of the run in Weights & Biases."""

  wandb_entity: str = codec.added("")
  """User or team that owns the project; empty: your default one."""

  wandb_id: str = codec.added("")
  """Id of the run in Weights & Biases; empty: drawn, and kept in the run folder."""
