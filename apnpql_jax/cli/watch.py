"""The command ``apnpql watch``."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from apnpql_jax.cli.inputs import checkpoint_step, run_config, task_env
from apnpql_jax.cli.options import Acting, AsTrained, File, Flag, OfRun
from apnpql_jax.cli.outputs import check_free
from apnpql_jax.console import print_line
from apnpql_jax.errors import ConfigError

if TYPE_CHECKING:
  from apnpql_jax.viewing.actors import Actor

SCRIPTED = ("expert", "random")
LOOPBACK = ("127.0.0.1", "localhost")


@dataclasses.dataclass(frozen=True)
class Watch(OfRun):
  """Shows episodes and what leads to each action: apnpql watch RUN|expert|random.

  apnpql watch runs/mine

  apnpql watch expert --task stack_box --video expert.mp4
  """

  what: tyro.conf.Positional[str] = ""
  """Run folder, which may still be training; or expert or random, with --task."""

  task: str = ""
  """Task of the expert or of random actions, or the path of its file; `apnpql list`
  shows all."""

  checkpoint: str = "newest"
  """Checkpoint: newest, best (highest success rate in training) or its step. The newest
  is replaced by newer ones while a run trains."""

  acting: Acting = None
  """How to choose an action: policy, mean, prior or greedy, see apnpql evaluate."""

  backend: AsTrained = None
  """Physics engine: auto, mjx or native."""

  seed: int = 0
  """Random seed of the episodes and actions."""

  host: str = "127.0.0.1"
  """Address to serve at; by default only this machine can connect."""

  port: int = 8080
  """Port to serve on; if it is taken, the next free one is used."""

  video: File = None
  """Write a video to this .mp4 or .gif file instead."""

  episodes: int = 1
  """Number of episodes in the video."""

  overwrite: Flag = False
  """Replace the video if it exists."""


def watch(args: Watch) -> dict[str, Any]:
  """Shows episodes in a browser until Ctrl-C, or writes a video of them."""
  if not args.what:
    raise ConfigError("watch needs a run folder, expert or random: apnpql watch RUN")
  scripted = args.what in SCRIPTED
  if scripted == (not args.task):
    raise ConfigError("--task goes with expert and random, and only with them")
  if not 0 < args.port < 65536:
    raise ConfigError(f"--port {args.port} must be from 1 to 65535")
  check_free(args.video, overwrite=args.overwrite)
  if not scripted:
    run_config(Path(args.what), args.task_file)

  from apnpql_jax.training.evaluate import check_count, check_video
  from apnpql_jax.viewing.player import Player

  check_count(args.episodes, args.seed)
  if args.video is not None:
    from apnpql_jax.viewing import watch_video

    path = check_video(args.video)
    player = Player(_actor(args), seed=args.seed, wide=watch_video.WIDE)
    written, solved = watch_video.record(player, path, episodes=args.episodes)
    return {"video": str(written), "episodes": args.episodes, "solved": solved}

  from apnpql_jax.viewing.live_view import LiveView, check_server
  from apnpql_jax.viewing.playback import Playback

  check_server(args.host)
  newest = args.checkpoint == "newest"
  playback = Playback(Player(_actor(args), seed=args.seed), follow=newest)
  with contextlib.closing(LiveView(playback, host=args.host, port=args.port)) as view:
    print_line(f"watch at {view.url}; Ctrl-C ends")
    if args.host not in LOOPBACK:
      print_line("everyone who can reach this machine can watch and press the buttons")
    playback.run(view)
  return {}


def _actor(args: Watch) -> Actor:
  """Builds the actor."""
  from apnpql_jax.viewing import actors

  if args.task:
    if args.acting is not None or args.checkpoint != "newest":
      raise ConfigError("--acting and --checkpoint need a run folder")
    env = task_env(args.task)
    backend = args.backend or env.backend
    return actors.scripted(args.what, dataclasses.replace(env, backend=backend))
  return actors.Trained(
    Path(args.what),
    backend=args.backend,
    step=checkpoint_step(args.what, args.checkpoint),
    acting=args.acting,
  )
