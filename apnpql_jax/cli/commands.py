"""The table of commands, in the order of the help."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from apnpql_jax.cli.collect import Collect, collect
from apnpql_jax.cli.compare import Compare, compare
from apnpql_jax.cli.completion import Completion, completion
from apnpql_jax.cli.convert import Convert, convert
from apnpql_jax.cli.diagnose import Diagnose, diagnose
from apnpql_jax.cli.doctor import Doctor, doctor
from apnpql_jax.cli.evaluate import Evaluate, evaluate
from apnpql_jax.cli.export import Export, export
from apnpql_jax.cli.list_names import List, list_names
from apnpql_jax.cli.new_task import NewTask, new_task
from apnpql_jax.cli.plot import Plot, plot
from apnpql_jax.cli.repeat import Repeat, repeat
from apnpql_jax.cli.robot import Robot, robot
from apnpql_jax.cli.sweep import Sweep, sweep
from apnpql_jax.cli.train import Train, train
from apnpql_jax.cli.transfer import Transfer, transfer
from apnpql_jax.cli.watch import Watch, watch

COMMANDS: dict[str, tuple[type[Any], Callable[[Any], dict[str, Any]]]] = {
  "train": (Train, train),
  "evaluate": (Evaluate, evaluate),
  "diagnose": (Diagnose, diagnose),
  "watch": (Watch, watch),
  "export": (Export, export),
  "transfer": (Transfer, transfer),
  "robot": (Robot, robot),
  "collect": (Collect, collect),
  "convert": (Convert, convert),
  "repeat": (Repeat, repeat),
  "sweep": (Sweep, sweep),
  "plot": (Plot, plot),
  "compare": (Compare, compare),
  "new-task": (NewTask, new_task),
  "list": (List, list_names),
  "doctor": (Doctor, doctor),
  "completion": (Completion, lambda args: completion(args, OPTIONS)),
}
"""Name -> class of the options, and the function that takes them."""

OPTIONS = {name: kind for name, (kind, _) in COMMANDS.items()}
"""Name -> class of the options."""
