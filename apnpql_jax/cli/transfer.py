"""The command ``apnpql transfer``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro

from apnpql_jax.cli.inputs import checkpoint_step, existing_run, task_env
from apnpql_jax.cli.options import Acting, File, Flag, OfRun, default_hint
from apnpql_jax.cli.outputs import check_free
from apnpql_jax.errors import ConfigError

EXPERT = "expert"


@dataclasses.dataclass(frozen=True)
class Transfer(OfRun):
  """Plays a policy in another simulator: apnpql transfer RUN [options].

  The scripted expert sees no images. Where it solves less than 95 %, a condition is no
  evidence about a policy.

  apnpql transfer runs/mine --renderer opengl --looks unseen

  apnpql transfer expert --task stack_box --physics mjx
  """

  run: tyro.conf.Positional[str] = ""
  """Run folder, or expert."""

  task: str = ""
  """Task of the expert, or the path of its file; `apnpql list` shows all."""

  physics: str = "native"
  """Engine: mjx, native (C MuJoCo) or bullet (PyBullet, driven as a real arm is)."""

  renderer: str = "rays"
  """What draws the images: rays (as in training), opengl (MuJoCo's renderer) or tiny
  (PyBullet's TinyRenderer)."""

  looks: str = "trained"
  """trained: worlds that domain randomization draws; plain: no randomization; unseen:
  textures, lights, shadows, clutter and noise that it cannot draw."""

  without: Annotated[tuple[str, ...], default_hint("(default: none)")] = ()
  """Parts that unseen looks lack, to find out which one matters: surfaces, lights,
  shadows, clutter or camera."""

  latency_ms: Annotated[int | None, default_hint("(default: 30)")] = None
  """With bullet: time from the virtual arm to the servos: 0, 30 or 60 ms."""

  admittance: Flag = False
  """With bullet: whether the virtual arm yields to the wrench at the tool."""

  checkpoint: str = "newest"
  """Checkpoint: newest, best (highest success rate in training) or its step."""

  acting: Acting = None
  """How to choose an action, see `apnpql evaluate --help`."""

  episodes: int = 200
  """Number of held-out episodes."""

  seed: int = 0
  """Random seed of the episodes and of the policy."""

  video: File = None
  """Also write a video of the first success and the first failure to this .mp4 or .gif
  file."""

  overwrite: Flag = False
  """Replace the video if it exists."""


def transfer(args: Transfer) -> dict[str, Any]:
  """Plays the episodes under one condition and returns the result."""
  if not args.run:
    raise ConfigError(
      "transfer needs a run or expert: apnpql transfer RUN, or apnpql transfer expert "
      "--task TASK"
    )
  expert = args.run == EXPERT and not Path(EXPERT, "config.json").exists()
  if expert != bool(args.task):
    raise ConfigError("--task names the task of the expert; runs have their own")
  if expert and (args.acting is not None or args.checkpoint != "newest"):
    raise ConfigError("--acting and --checkpoint need a run folder")
  check_free(args.video, overwrite=args.overwrite)
  env_config = task_env(args.task) if expert else None
  if env_config is None:
    existing_run(args.run, "transfer", args.task_file)

  from apnpql_jax.transfer import evaluation  # Imports JAX.
  from apnpql_jax.transfer.condition import Condition

  names = [field.name for field in dataclasses.fields(Condition)]
  condition = Condition(**{name: getattr(args, name) for name in names})
  options: dict[str, Any] = {
    "episodes": args.episodes,
    "seed": args.seed,
    "video": args.video,
  }
  if env_config is not None:
    return evaluation.evaluate_expert(env_config, condition, **options)
  step = checkpoint_step(args.run, args.checkpoint)
  return evaluation.evaluate_run(
    args.run, condition, step=step, acting=args.acting, **options
  )
