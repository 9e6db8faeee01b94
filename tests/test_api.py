"""The public API: its names, and what importing the package alone imports."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
import re
import subprocess
import sys

import pytest

import apnpql_jax

ROOT = Path(__file__).resolve().parents[1]


def declared() -> dict[str, str]:
  """Returns name -> module of the imports that type checkers see."""
  tree = ast.parse(Path(apnpql_jax.__file__).read_text())
  imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
  return {
    alias.name: node.module
    for node in imports
    if node.module and node.module.startswith("apnpql_jax.")
    for alias in node.names
  }


@pytest.mark.parametrize(("name", "module"), declared().items())
def test_name_is_that_of_its_module(name, module):
  value = getattr(apnpql_jax, name)
  assert value is getattr(importlib.import_module(module), name)


def test_dir_lists_every_name_and_type_checkers_see_the_same():
  lazy = {name for names in apnpql_jax._MODULES.values() for name in names}
  assert len(lazy) > 15
  assert declared().keys() == lazy
  assert lazy <= set(dir(apnpql_jax))


def test_the_reference_lists_every_name_with_its_module():
  page = (ROOT / "docs" / "reference.md").read_text()
  links = re.findall(r"\[`(\w+)`\]\(\.\./apnpql_jax/([\w/]+)\.py#(\w+)\)", page)
  listed = {name: path.replace("/", ".") for name, path, _ in links}
  assert listed == apnpql_jax._HOME
  assert all(name == anchor for name, _, anchor in links)


def test_unknown_name_is_an_attribute_error():
  with pytest.raises(AttributeError, match="no attribute 'nothing'"):
    apnpql_jax.nothing  # noqa: B018


@pytest.mark.parametrize(
  ("first", "heavy"), [("pass", False), ("apnpql_jax.make_env", True)]
)
def test_import_alone_imports_neither_jax_nor_mujoco(first, heavy):
  code = f"import sys, apnpql_jax; {first}; print(*sys.modules)"
  done = subprocess.run(
    [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
  )
  imported = {"jax", "mujoco", "numpy"} & set(done.stdout.split())
  assert imported == ({"jax", "mujoco", "numpy"} if heavy else set())
