"""Messages between devices in one update of a preset.

  python -m benchmarks.speed.messages --preset push_plate --devices 4
  python -m benchmarks.speed.messages --store    # and its table in docs/scaling.md

They are read from the program that XLA makes for that many CPU devices; nothing is run.
Sizes are those that each device holds afterwards: the whole gradients, its whole batch.
"""

import json
import math
import re
from typing import Any

import jax

from apnpql_jax import devices
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.envs.env import make_env
from apnpql_jax.runs import leaves
from apnpql_jax.training.iteration import make_sample
from apnpql_jax.training.placement import place
from apnpql_jax.training.state import TrainState, example_state
from benchmarks.common import command, settings, store, tables

DOC = store.ROOT / "docs" / "scaling.md"
_KINDS = "all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter"
_BYTES = {"pred": 1, "s8": 1, "u8": 1, "s32": 4, "u32": 4, "f32": 4}


def main() -> None:
  parser = command.parser(__doc__)
  parser.add_argument("--preset", default="push_plate")
  parser.add_argument("--devices", type=int, default=4)
  args = command.parse(parser)
  jax.config.update("jax_num_cpu_devices", args.devices)
  config = settings.preset(args.preset, quick=args.quick)
  header = {"preset": args.preset, "devices": args.devices}
  report = store.machine() | header | measure(config, args.devices)
  if args.store:
    store.store("messages", report)
    tables.put("messages", table(report), DOC)
  print(json.dumps(report, indent=None if args.json else 2))


def measure(config: TrainConfig, count: int) -> dict[str, int]:
  """Returns the bytes of an update's messages, and of what they consist of."""
  mesh = devices.make_mesh(count)
  env = make_env(config.env, mesh, lstm_instants=config.agent.lstm_instants)
  agent = make_agent(config.agent)
  state = example_state(config, env, agent)
  sample = make_sample(config, agent, mesh)

  def update(state: TrainState) -> Any:
    batch = sample(state.replay, state.expert_replay, state.key)
    return place(agent.update(state.learner, batch, state.key), mesh)

  batch = jax.eval_shape(sample, state.replay, state.expert_replay, state.key)
  sizes = list(map(size, messages(jax.jit(update).lower(state).compile())))
  return {
    "parameters_bytes": leaves.nbytes(state.learner.params),
    "batch_bytes": leaves.nbytes(batch),
    "replay_bytes_per_device": leaves.nbytes(state.replay),
    "messages": len(sizes),
    "messages_bytes": sum(sizes),
    "largest_message_bytes": max(sizes),
  }


def table(report: dict[str, Any]) -> str:
  """Returns the table of docs/scaling.md."""
  replay = "for comparison: the agent's replay, its part on each device"
  rows = (
    ("parameters, and so gradients", "parameters_bytes"),
    ("batch", "batch_bytes"),
    (f"sent, in {report['messages']} messages", "messages_bytes"),
    (replay, "replay_bytes_per_device"),
  )
  about = f"{report['preset']} on {report['devices']} devices, "
  about += f"jax {report['versions']['jax']}, commit {report['commit']}."
  cells = [(name, f"{report[key]:,}") for name, key in rows]
  return f"{about}\n\n{tables.table(('of one update', 'bytes'), cells)}"


def messages(program: Any) -> list[str]:
  """Returns what devices running a compiled program send, as XLA writes its types."""
  return re.findall(rf"= (.*) (?:{_KINDS})(?:-start)?\(", program.as_text())


def size(types: str) -> int:
  """Returns the bytes of the arrays in a text such as ``(f32[16,7]{1,0}, pred[])``."""
  return sum(
    _BYTES[kind] * math.prod(map(int, re.findall(r"\d+", shape)))
    for kind, shape in re.findall(r"\b([a-z]+\d*)\[([\d,]*)\]", types)
  )


if __name__ == "__main__":
  main()
