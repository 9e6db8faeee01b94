"""Ratios of this project's speed to that of other libraries on the same machine.

  python -m benchmarks.peers.compare --store

Each peer is set up as its users would, see ``PEERS``, in processes of its own. So is
this project. Both are timed in turns, round by round. A ratio is ours over theirs of
one round; the report has the median over the rounds with the lowest and the highest.
Peers that are not installed (``.venv/bin/pip install -e '.[peers]'``) or do not answer
in time are reported as missing.
"""

import argparse
from collections.abc import Iterator, Sequence
import os
from pathlib import Path
import subprocess
import sys
import tempfile
from typing import Any, NamedTuple

from apnpql_jax import runtime
from apnpql_jax.config.files import preset_names
from apnpql_jax.tasks import task_names
from benchmarks.common import command, timing
from benchmarks.peers import sides, worlds

Result = dict[str, Any]
RATES = {
  "cameras": "control steps/s with both cameras",
  "physics": "control steps/s, physics only",
  "updates": "updates/s",
}
SIZES = ("task", "preset", "processes", "worlds", "batch", "candidates")
"""Flags that both sides get as settings."""


class Peer(NamedTuple):
  """The two sides of a comparison."""

  label: str  # name and set-up, for the table
  module: str  # the peer's side
  rates: tuple[str, ...]  # keys of ``RATES``
  ours: Result  # settings of our side in addition to the flags, see ``ours.py``
  settings: Result  # settings of the peer's side in addition to the flags
  one_each: bool = False  # whether each of its worlds is a process of its own


_STEPS = ("cameras", "physics")
_WORLDS = {"side": "worlds", "backend": "auto", "stock": False, "periods": 4}
# Small, because stock MJX takes seconds for a control period of a few worlds on a CPU.
_MJX = _WORLDS | {"backend": "mjx", "periods": 1, "worlds": 16}
_LEARNER = {"side": "learner", "precision": "float32"}
_BFLOAT16 = _LEARNER | {"precision": "bfloat16"}

PEERS = {
  "pybullet": Peer(
    "PyBullet with TinyRenderer, the paper's set-up: free-running processes, velocity "
    "motors, 1/240 s",
    *("pybullet_worlds", _STEPS, _WORLDS, {}, True),
  ),
  "mujoco": Peer(
    "MuJoCo and its renderer: free-running processes, our control law in Python",
    *("mujoco_worlds", _STEPS, _WORLDS, {"gymnasium": False}, True),
  ),
  "gymnasium": Peer(
    "the same worlds in Gymnasium's AsyncVectorEnv",
    *("mujoco_worlds", _STEPS, _WORLDS, {"gymnasium": True}),
  ),
  "mjx": Peer(
    "mujoco.mjx as it is installed, with the settings of our scene, against our MJX "
    f"engine; {_MJX['worlds']} worlds",
    *("ours", ("physics",), _MJX, _MJX | {"stock": True}),
  ),
  "torch": Peer(
    "the same learner in plain PyTorch: eager mode, Adam, library distributions",
    *("torch_learner", ("updates",), _LEARNER, {"compiled": False}),
  ),
  "torch_bfloat16": Peer(
    "the same, with our candidates in bfloat16, as in the presets",
    *("torch_learner", ("updates",), _BFLOAT16, {"compiled": False}),
  ),
  "torch_compiled": Peer(
    "the same in float32, PyTorch under torch.compile",
    *("torch_learner", ("updates",), _LEARNER, {"compiled": True}),
  ),
}


def main(argv: Sequence[str] | None = None) -> None:
  parser = command.parser(__doc__)
  flag = parser.add_argument
  flag("--peers", nargs="+", choices=PEERS, default=list(PEERS))
  flag("--task", choices=task_names(), default="push_plate")
  flag("--preset", choices=preset_names(), default="push_plate")
  flag("--processes", type=int, default=10, help="the paper has 10")
  flag("--worlds", type=int, default=64, help="of ours at once")
  flag("--batch", type=int, default=64)
  flag("--candidates", type=int, default=120)
  flag("--rounds", type=int, default=5)
  flag("--seconds", type=float, default=4.0, help="of work per figure")
  flag("--limit", type=float, default=900.0, help="s for an answer")
  args = command.parse(parser, argv)
  if args.quick:
    args.processes, args.worlds, args.batch, args.candidates = 2, 4, 8, 8
    args.rounds, args.seconds = 1, 0.2
  sizes = {name: getattr(args, name) for name in SIZES}
  with tempfile.TemporaryDirectory() as folder:
    worlds.export(args.task, None, Path(folder))
    settings = sizes | {"folder": folder}
    results = (found for name in args.peers for found in compare(name, settings, args))
    command.publish("peers", args, results, **sizes, rounds=args.rounds)


def compare(name: str, settings: Result, args: argparse.Namespace) -> Iterator[Result]:
  """Yields the ratios of one peer, or why there are none."""
  peer, limit_s = PEERS[name], args.limit
  # XLA's own default for sums; ``runtime`` changes it for us.
  env = {"XLA_FLAGS": runtime.fusions_flag(*runtime.KEPT_FUSIONS, "REDUCE")}
  if peer.module == "mujoco_worlds":
    env["MUJOCO_GL"] = graphics()
  count = args.processes if peer.one_each else 1
  their, our = settings | peer.settings, settings | peer.ours
  try:
    with (
      sides.Side(peer.module, their, count=count, limit_s=limit_s, **env) as theirs,
      sides.Side("ours", our, limit_s=limit_s) as ours,
    ):
      for rate in peer.rates:
        found = {"peer": peer.label, "rate": RATES[rate], "about": theirs.about}
        try:
          yield found | ratio((ours, theirs), rate, args)
        except sides.SideFailed as error:
          yield found | {"missing": str(error)}
  except sides.SideFailed as error:
    yield {"peer": peer.label, "missing": str(error)}


def ratio(both: Sequence[sides.Side], name: str, args: argparse.Namespace) -> Result:
  """Measures both in turns, after one round that does not count."""
  rounds = range(1 + args.rounds)
  rates = [[side.rate(name, args.seconds) for side in both] for _ in rounds][1:]
  found = timing.spread("ratio", [ours / theirs for ours, theirs in rates])
  ours_per_s, theirs_per_s = zip(*rates, strict=True)
  return {**found, "ours_per_s": ours_per_s, "theirs_per_s": theirs_per_s}


def graphics() -> str:
  """Returns the graphics library that MuJoCo's users would take: EGL, else Mesa's."""
  if "MUJOCO_GL" in os.environ:
    return os.environ["MUJOCO_GL"]
  for name in ("egl", "osmesa"):
    code = "import mujoco; mujoco.GLContext(8, 8).make_current()"
    env = os.environ | {"MUJOCO_GL": name}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True)
    if not done.returncode:
      return name
  return "disable"


if __name__ == "__main__":
  main()
