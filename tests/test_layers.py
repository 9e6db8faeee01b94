"""The order of the rooms, read from import statements; nothing is executed."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "apnpql_jax"
NAME = PACKAGE.name

STAIR = (
  "errors types atomic colors console runtime dists config devices sim render tasks "
  "templates randomization primitives envs gym agents data runs reports sweeps "
  "training viewing deploy robot transfer testing doctor cli __main__"
).split()
"""Rooms from the bottom up: each imports only from itself and from earlier ones."""

APART = {
  "agents": {"sim", "render", "tasks", "primitives", "randomization", "envs"},
  "data": {"agents", "render", "randomization", "envs"},
  "reports": {"agents", "sim", "render", "tasks", "envs", "data"},
  "sweeps": {"agents", "sim", "render", "tasks", "envs", "data"},
  "runs": {"agents", "sim", "render", "tasks", "envs", "data"},
  "render": {"sim", "tasks"},
}
"""Rooms that must not reach others although those come earlier."""

Graph = dict[str, set[str]]


def imports(source: str, module: str, is_package: bool) -> set[str]:
  """Returns the dotted names inside the package that ``source`` imports anywhere."""
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


def modules() -> Graph:
  """Returns module -> modules of the package that it imports, without the API."""
  paths = {}
  for path in PACKAGE.rglob("*.py"):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    is_package = parts[-1] == "__init__"
    paths[".".join(parts[:-1] if is_package else parts)] = (path, is_package)
  graph = {
    name: imports(path.read_text(encoding="utf-8"), name, is_package) & paths.keys()
    for name, (path, is_package) in paths.items()
  }
  # Importing a module imports the packages around it, which is no dependency.
  return {
    name: {known for known in graph[name] if not name.startswith(f"{known}.")} - {name}
    for name in graph.keys() - {NAME}
  }


def room(module: str) -> str:
  """Returns the first name below the package: that of ``apnpql_jax.sim.arm`` is sim."""
  return module.split(".")[1]


def reached(start: str, graph: Graph) -> set[str]:
  """Returns the modules that ``start`` imports, directly or through others."""
  seen: set[str] = set()
  todo = [start]
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
    ("if TYPE_CHECKING:\n  from ..env import reset", "apnpql_jax.env"),
  ],
)
def test_every_kind_of_import_is_found(statement, expected):
  assert expected in imports(statement, "apnpql_jax.agents.learner", False)


def test_every_room_has_its_step():
  assert {room(module) for module in modules()} == set(STAIR)


def test_imports_lead_down_the_stair():
  steps: dict[str, int] = {name: index for index, name in enumerate(STAIR)}
  upward = [
    f"{module} imports {known}"
    for module, imported in modules().items()
    for known in imported
    if steps[room(known)] > steps[room(module)]
  ]
  assert not upward


def test_no_module_reaches_itself():
  graph = modules()
  assert not [module for module in graph if module in reached(module, graph)]


@pytest.mark.parametrize("name", sorted(APART))
def test_rooms_that_must_not_meet_do_not(name):
  graph = modules()
  members = [module for module in graph if room(module) == name]
  broken = [
    f"{module} reaches {other}"
    for module in members
    for other in reached(module, graph)
    if room(other) in APART[name]
  ]
  assert members and not broken


def test_distributions_import_nothing_else_of_the_package():
  graph = modules()
  members = [module for module in graph if room(module) == "dists"]
  outside = {x for m in members for x in graph[m] if room(x) != "dists"}
  assert members and not outside
