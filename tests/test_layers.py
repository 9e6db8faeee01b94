"""Which module may know which: read from the import statements, nothing is run."""

from __future__ import annotations

import ast
from pathlib import Path
import re

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "apnpql_jax"
NAME = PACKAGE.name

LOOP = {
  "rollout",
  "iteration",
  "evaluate",
  "demonstrations",
  "faults",
  "recording",
  "recordings",
  "reporter",
  "train",
  "cli",
  "commands",
  "options",
  "resuming",
  "__main__",
}
"""Modules that see both the world and the agent, or start those that do."""

WORLD = {"sim", "render", "primitives", "tasks", "env", "env_state"}
FORBIDDEN = {
  "sim": LOOP | {"render", "primitives", "tasks", "env", "agents", "replay", "dists"},
  "render": LOOP | {"primitives", "tasks", "env", "agents", "replay", "dists"},
  "primitives": LOOP | {"env", "agents", "replay", "dists"},
  "tasks": LOOP | {"env", "agents", "replay", "dists"},
  "env": LOOP | {"agents", "replay", "dists"},
  "env_state": LOOP | {"env", "agents", "replay", "dists"},
  "agents": LOOP | WORLD | {"replay"},
  "replay": LOOP | WORLD | {"agents", "dists"},
}


def imports(source: str, module: str, is_package: bool) -> set[str]:
  """Dotted names inside the package that ``source`` imports, at any depth."""
  found = set()
  for node in ast.walk(ast.parse(source)):
    if isinstance(node, ast.Import):
      found |= {alias.name for alias in node.names}
    elif isinstance(node, ast.ImportFrom):
      parts = module.split(".")
      parts = parts[: len(parts) - node.level + is_package] if node.level else []
      base = ".".join([*parts, *filter(None, [node.module])])
      found |= {base} | {f"{base}.{alias.name}" for alias in node.names}
  return {name for name in found if name.split(".")[0] == NAME}


def modules() -> dict[str, set[str]]:
  """Module -> modules of the package that it imports directly."""
  paths = {}
  for path in PACKAGE.rglob("*.py"):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    is_package = parts[-1] == "__init__"
    paths[".".join(parts[:-1] if is_package else parts)] = (path, is_package)
  return {
    name: imports(path.read_text(encoding="utf-8"), name, is_package) & paths.keys()
    for name, (path, is_package) in paths.items()
  }


def layer(module: str) -> str:
  """The first name below the package: ``apnpql_jax.sim.scene`` is in ``sim``."""
  return (module.split(".") + [""])[1]


def reached(start: str, graph: dict[str, set[str]]) -> set[str]:
  """Modules that ``start`` imports, directly or through others."""
  seen, todo = set(), [start]
  while todo:
    for name in graph[todo.pop()] - seen - {NAME}:
      seen.add(name)
      todo.append(name)
  return seen


@pytest.mark.parametrize(
  ("statement", "expected"),
  [
    ("import apnpql_jax.sim.scene", "apnpql_jax.sim.scene"),
    ("from apnpql_jax.sim import scene as s", "apnpql_jax.sim.scene"),
    ("from ..sim import scene", "apnpql_jax.sim.scene"),
    ("def f():\n  from apnpql_jax import env", "apnpql_jax.env"),
    ("if x:\n  from ..env import reset", "apnpql_jax.env"),
  ],
)
def test_every_way_to_import_is_seen(statement, expected):
  assert expected in imports(statement, "apnpql_jax.agents.learner", False)


@pytest.mark.parametrize("name", sorted(FORBIDDEN))
def test_layer_knows_only_what_it_may(name):
  graph = modules()
  members = [module for module in graph if layer(module) == name]
  assert members, f"no module in {name}: mend this test with the layout"
  broken = [
    f"{module} reaches {other}"
    for module in members
    for other in reached(module, graph)
    if layer(other) in FORBIDDEN[name]
  ]
  assert not broken


def test_distributions_know_nobody():
  graph = modules()
  members = [module for module in graph if layer(module) == "dists"]
  assert members
  outside = {x for m in members for x in graph[m] if layer(x) != "dists"} - {NAME}
  assert not outside


def test_only_the_loop_sees_both_sides():
  graph = modules()
  assert {"apnpql_jax.rollout", "apnpql_jax.evaluate", "apnpql_jax.train"} <= set(graph)
  both = [
    module
    for module in graph
    if layer(module) not in LOOP
    and {"agents"} & {layer(x) for x in reached(module, graph)}
    and WORLD & {layer(x) for x in reached(module, graph)}
  ]
  assert not both


def test_only_the_entry_point_knows_the_command_line():
  graph = modules()
  knowing = {m for m, known in graph.items() if f"{NAME}.cli" in known}
  assert knowing == {f"{NAME}.__main__"}


def test_tests_that_documents_name_exist():
  files = {path.stem: path.read_text() for path in Path(__file__).parent.glob("*.py")}
  known = files.keys() | set(re.findall(r"def (test_\w+)\(", "".join(files.values())))
  for document in PACKAGE.parent.glob("docs/*.md"):
    assert set(re.findall(r"`(test_\w+)", document.read_text())) <= known, document
