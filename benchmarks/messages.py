"""What devices send to each other in one update of a preset.

  python benchmarks/messages.py --preset push_plate --devices 4
  python benchmarks/messages.py --store     # keeps it, and its table in docs/scaling.md

Read from the program that XLA makes for that many CPU devices; nothing is run. Bytes
are those of what each device holds afterwards: the whole gradients, its whole batch.
``--json`` prints one JSON object and nothing else.
"""

from __future__ import annotations

import argparse
import json
import math
import re
from typing import Any

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)
import jax
import tables

from apnpql_jax import devices
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.files import load_preset
from apnpql_jax.envs.env import make_env
from apnpql_jax.runs import leaves
from apnpql_jax.training.iteration import make_sample
from apnpql_jax.training.placement import place
from apnpql_jax.training.state import TrainState, example_state

_KINDS = "all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter"
_BYTES = {"pred": 1, "s8": 1, "u8": 1, "s32": 4, "u32": 4, "f32": 4}


def main() -> None:
  """Command line; see the module's docstring."""
  parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
  parser.add_argument("--json", action="store_true", help="print one JSON object")
  parser.add_argument("--preset", default="push_plate")
  parser.add_argument("--devices", type=int, default=4)
  parser.add_argument("--store", action="store_true", help="keep it, and its table")
  args = parser.parse_args()
  jax.config.update("jax_num_cpu_devices", args.devices)
  report = {"preset": args.preset, "devices": args.devices, **measure(args)}
  if args.store:
    report = tables.machine() | report
    tables.store("messages", report)
    tables.put("messages", table(report), tables.ROOT / "docs" / "scaling.md")
  if args.json:
    print(json.dumps(report))
  else:
    print("\n".join(f"{name:<28} {value}" for name, value in report.items()))


def measure(args: argparse.Namespace) -> dict[str, int]:
  """Bytes of what is sent, and of what it is made of."""
  config, mesh = load_preset(args.preset), devices.make_mesh(args.devices)
  env = make_env(config.env, mesh, instants=config.agent.lstm_instants)
  agent = make_agent(config.agent)
  state = example_state(config, env, agent)
  sample = make_sample(config, agent, mesh)

  def update(state: TrainState) -> Any:
    batch = sample(state.replay, state.expert_replay, state.key)
    return place(agent.update(state.learner, batch, state.key), mesh)

  batch = jax.eval_shape(sample, state.replay, state.expert_replay, state.key)
  sent = messages(jax.jit(update).lower(state).compile())
  return {
    "parameters_bytes": leaves.nbytes(state.learner.params),
    "batch_bytes": leaves.nbytes(batch),
    "replay_bytes_per_device": leaves.nbytes(state.replay),
    "messages": len(sent),
    "messages_bytes": sum(map(size, sent)),
    "largest_message_bytes": max(map(size, sent)),
  }


def table(report: dict[str, Any]) -> str:
  """What docs/scaling.md says of a report."""
  sent = f"sent, in {report['messages']} messages"
  replay = "for comparison: the agent's replay, its part on each device"
  rows = [
    ("parameters, and so gradients", report["parameters_bytes"]),
    ("batch", report["batch_bytes"]),
    (sent, report["messages_bytes"]),
    (replay, report["replay_bytes_per_device"]),
  ]
  about = f"{report['preset']} on {report['devices']} devices, "
  about += f"jax {report['versions']['jax']}, commit {report['commit']}."
  cells = [(name, f"{size:,}") for name, size in rows]
  return f"{about}\n\n{tables.table(('of one update', 'bytes'), cells)}"


def messages(program: Any) -> list[str]:
  """What devices running a compiled program send, as XLA writes its types."""
  return re.findall(rf"= (.*) (?:{_KINDS})(?:-start)?\(", program.as_text())


def size(types: str) -> int:
  """Bytes of the arrays in a text such as ``(f32[16,7]{1,0}, pred[])``."""
  arrays = re.findall(r"\b([a-z]+\d*)\[([\d,]*)\]", types)
  return sum(
    _BYTES[kind] * math.prod(map(int, re.findall(r"\d+", shape)))
    for kind, shape in arrays
  )


if __name__ == "__main__":
  main()
