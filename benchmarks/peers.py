"""This project beside others on the same machine in the same run: ratios.

  python benchmarks/peers.py --quick
  python benchmarks/peers.py --store

Each peer is set up as its users would, see ``PEERS``, in processes of its own, and so
is this project. The two are timed in turns, round by round; a ratio is ours over
theirs of one round, and the median over rounds is reported with the lowest and the
highest. Peers that are not installed (``pip install -e '.[peers]'``) or do not answer
in time are left out with a line that says so. ``--json`` prints one JSON object and
nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
import dataclasses
import json
import os
import statistics
import subprocess
import sys
from typing import Any

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)
import sides
import tables

from apnpql_jax import runtime
from apnpql_jax.config.files import preset_names
from apnpql_jax.tasks import task_names

RATES = {
  "cameras": "control steps/s with both cameras",
  "physics": "control steps/s, physics only",
  "updates": "updates/s",
}


@dataclasses.dataclass(frozen=True)
class Peer:
  """What is compared with what."""

  label: str
  """Name and set-up, for the table."""

  script: str
  """The peer's side."""

  rates: tuple[str, ...]
  """Keys of ``RATES``."""

  ours: dict[str, Any]
  """Settings of our side, see ``peer_ours.py``."""

  settings: dict[str, Any] = dataclasses.field(default_factory=dict)
  """Settings of the peer's side beside those of the command line."""

  draws: bool = False
  """It needs a graphics library for MuJoCo."""


_WORLDS = {"side": "worlds", "backend": "auto", "stock": False, "periods": 4}
# Little of it: on a CPU, stock MJX needs seconds for a control period of a few worlds.
_MJX = _WORLDS | {"backend": "mjx", "periods": 1, "worlds": 16}

PEERS = {
  "pybullet": Peer(
    "PyBullet with TinyRenderer, the paper's set-up: free-running processes, velocity "
    "motors, 1/240 s",
    "peer_pybullet.py",
    ("cameras", "physics"),
    _WORLDS,
  ),
  "mujoco": Peer(
    "MuJoCo and its renderer: free-running processes, our control law in Python",
    "peer_mujoco.py",
    ("cameras", "physics"),
    _WORLDS,
    {"gymnasium": False},
    draws=True,
  ),
  "gymnasium": Peer(
    "the same worlds in Gymnasium's AsyncVectorEnv",
    "peer_mujoco.py",
    ("cameras", "physics"),
    _WORLDS,
    {"gymnasium": True},
    draws=True,
  ),
  "mjx": Peer(
    "mujoco.mjx as it is installed, with the settings of our scene, against our MJX "
    f"engine; {_MJX['worlds']} worlds",
    "peer_ours.py",
    ("physics",),
    _MJX,
    _MJX | {"stock": True},
  ),
  "torch": Peer(
    "the same learner in plain PyTorch: eager mode, Adam, library distributions",
    "peer_torch.py",
    ("updates",),
    {"side": "learner", "algorithm": "ap_npql"},
  ),
  "brax": Peer(
    "Brax's SAC with its vision networks, one jitted update, against our row sac with "
    "maps of both cameras, as Brax has them; both draw one action",
    "peer_brax.py",
    ("updates",),
    # One draw of the arm, summed over both gripper commands.
    {"side": "learner", "algorithm": "sac", "candidates": 2, "features": "map"},
  ),
}


def main(argv: Sequence[str] | None = None) -> None:
  """Command line; see the module's docstring."""
  args = _arguments(argv)
  sizes = {
    name: getattr(args, name)
    for name in ("task", "preset", "processes", "worlds", "batch", "candidates")
  }
  report: dict[str, Any] = {
    "benchmark": "peers",
    **tables.machine(),
    **sizes,
    "rounds": args.rounds,
    "results": [],
  }
  for name in args.peers:
    for result in compare(name, sizes, args):
      report["results"].append(result)
      if not args.json:
        print(result, flush=True)
      if args.store:
        tables.store("peers", report)
  if args.json:
    print(json.dumps(report))


def compare(
  name: str, sizes: dict[str, Any], args: argparse.Namespace
) -> Iterator[dict[str, Any]]:
  """Ratios of one peer, or a line that says why there are none."""
  peer = PEERS[name]
  env = {"XLA_FLAGS": runtime.fusions_flag(*runtime.KEPT_FUSIONS, "REDUCE")}
  if peer.draws:
    env["MUJOCO_GL"] = graphics()
  settings = sizes | peer.settings
  try:
    with sides.Side(peer.script, settings, env=env, limit_s=args.limit) as theirs:
      with sides.Side("peer_ours.py", sizes | peer.ours, limit_s=args.limit) as ours:
        about = {k: v for k, v in theirs.about.items() if k != "ready"}
        for rate in peer.rates:
          found = {"peer": peer.label, "rate": RATES[rate], "about": about}
          try:
            yield found | ratio(ours, theirs, rate, args)
          except sides.SideFailed as error:
            yield found | {"missing": str(error)}
  except sides.SideFailed as error:
    yield {"peer": peer.label, "missing": str(error)}


def ratio(
  ours: sides.Side, theirs: sides.Side, name: str, args: argparse.Namespace
) -> dict[str, Any]:
  """Rates of both in turns, after one of each that does not count."""
  rounds = []
  for _ in range(1 + args.rounds):
    rounds.append([side.rate(name, args.seconds) for side in (ours, theirs)])
  mine, others = zip(*rounds[1:], strict=True)
  ratios = [one / other for one, other in zip(mine, others, strict=True)]
  return {
    "ratio": statistics.median(ratios),
    "ratio_low": min(ratios),
    "ratio_high": max(ratios),
    "ours_per_s": mine,
    "theirs_per_s": others,
  }


def graphics() -> str:
  """The graphics library that MuJoCo's users would take: a GPU's, else Mesa's."""
  if "MUJOCO_GL" in os.environ:
    return os.environ["MUJOCO_GL"]
  for name in ("egl", "osmesa"):
    code = "import mujoco; mujoco.GLContext(8, 8).make_current()"
    env = os.environ | {"MUJOCO_GL": name}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True)
    if not done.returncode:
      return name
  return "disable"


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
  parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
  parser.add_argument("--json", action="store_true", help="print one JSON object")
  parser.add_argument("--quick", action="store_true", help="tiny, to see that it runs")
  parser.add_argument("--store", action="store_true", help="keep the JSON in results")
  parser.add_argument("--peers", nargs="+", choices=PEERS, default=list(PEERS))
  parser.add_argument("--task", choices=task_names(), default="push_plate")
  parser.add_argument("--preset", choices=preset_names(), default="push_plate")
  parser.add_argument("--processes", type=int, default=10, help="the paper has 10")
  parser.add_argument("--worlds", type=int, default=64, help="of ours at once")
  parser.add_argument("--batch", type=int, default=64)
  parser.add_argument("--candidates", type=int, default=120)
  parser.add_argument("--rounds", type=int, default=5)
  parser.add_argument("--seconds", type=float, default=4.0, help="of work per figure")
  parser.add_argument("--limit", type=float, default=900.0, help="s for an answer")
  args = parser.parse_args(argv)
  if args.quick and args.store:
    parser.error("--quick figures mean nothing; nothing is stored")
  if args.quick:
    args.processes, args.worlds, args.batch, args.candidates = 2, 4, 8, 8
    args.rounds, args.seconds = 1, 0.2
  return args


if __name__ == "__main__":
  main()
