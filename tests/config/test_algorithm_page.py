"""docs/algorithm.md has the defaults and the values of the presets."""

from __future__ import annotations

import ast
import re
from typing import Any

import pytest

from apnpql_jax import testing
from apnpql_jax.config import codec, files
from apnpql_jax.config.schema import TrainConfig

PAGE = (testing.ROOT / "docs/algorithm.md").read_text("utf-8")
DEFAULT = dict(codec.flatten(TrainConfig()))
PRESET = dict(codec.flatten(files.load_preset("push_plate")))


def table(*header: str) -> list[list[str]]:
  """Returns the cells of the rows below a header that name settings."""
  text = PAGE.split(f"| {' | '.join(header)} |\n")[1].split("\n\n")[0]
  rows = [[x.strip() for x in line.split("|")[1:-1]] for line in text.splitlines()[1:]]
  return [row for row in rows if names(row[header.index("setting")])]


def names(cell: str) -> list[str]:
  """Returns the settings in a cell; the first one completes the names of the others."""
  found = re.findall(r"`([\w.]+)`", cell)
  if not found:
    return []
  stem, group = found[0].rpartition("_")[0], found[0].rpartition(".")[0]
  others = (f"{stem}{x}" if x[0] == "_" else f"{group}.{x}" for x in found[1:])
  return [found[0], *others]


def value(text: str, like: Any) -> Any:
  """Reads a value of the type of ``like``."""
  if isinstance(like, bool):
    return {"on": True, "off": False}[text]
  return text if isinstance(like, str) else type(like)(text.replace(",", ""))


LEARNER = table("paper", "value", "setting", "preset")
OTHERS = table("setting", "default", "preset", "evidence for the preset")


@pytest.mark.parametrize("row", LEARNER, ids=lambda row: row[0])
def test_settings_of_the_paper(row: list[str]):
  _, paper, setting, preset = row
  default = re.search(r"= (.+)", setting)
  for name in names(setting):
    assert DEFAULT[name] == ast.literal_eval(default[1] if default else paper)
    same = preset.startswith("same")
    found = DEFAULT[name] if same else value(preset.split()[0], DEFAULT[name])
    assert PRESET[name] == found, name


@pytest.mark.parametrize("row", OTHERS, ids=lambda row: row[0])
def test_settings_that_the_paper_does_not_give(row: list[str]):
  for known, cell in ((DEFAULT, row[1]), (PRESET, row[2])):
    found = cell.split(", ")
    wanted = names(row[0])
    assert len(found) in (1, len(wanted))
    for name, text in zip(wanted, found * (len(wanted) // len(found)), strict=True):
      assert known[name] == value(text, DEFAULT[name]), name


def test_every_setting_of_the_agent_that_the_preset_changes_is_there():
  named = {name for row in LEARNER for name in names(row[2])}
  named |= {name for row in OTHERS for name in names(row[0])}
  changed = {k for k in PRESET if k.startswith("agent.") and PRESET[k] != DEFAULT[k]}
  assert changed <= named


def test_agents_of_the_presets_differ_where_the_page_says_so():
  text = PAGE.split("The presets of the other tasks use its agent")[1].split("\n\n")[0]
  others, own = (set(re.findall(r"`(\w+)`", x)) for x in text.split("sim_to_real"))
  first = files.load_preset("push_plate")
  for name in set(files.preset_names()) - {"push_plate"}:
    changed = files.config_diff(first, files.load_preset(name))
    agent = {key.removeprefix("agent.") for key in changed if key.startswith("agent.")}
    assert agent == others | (own if name == "sim_to_real" else set())
