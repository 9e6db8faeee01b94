"""Documents: files, modules and tests that they name exist, and lists are complete."""

from __future__ import annotations

from pathlib import Path
import re
import shlex
from string import Template

import pytest

from apnpql_jax.cli.sweep import check_plan, config_of, parse_sweep
from apnpql_jax.doctor.software import EXTRAS
from apnpql_jax.errors import ConfigError
from apnpql_jax.sweeps.plan import make_plan

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted(
  path
  for pattern in ("*.md", "benchmarks/*.md", "docs/**/*.md", "experiments/**/*.md")
  for path in ROOT.glob(pattern)
)

FOLDERS = "apnpql_jax|benchmarks|docs|experiments|mjcf|tests"
PATH = re.compile(rf"(?<![\w./-])((?:{FOLDERS})/[\w./-]*\w|(?:\w+/)+\w+\.py)\b")
"""A path from the root of the repository, or a script's from the package or docs."""


def missing(text: str) -> set[str]:
  """Returns the paths and the modules of commands in ``text`` that do not exist."""
  paths = set(PATH.findall(text))
  modules = re.findall(r"python -m (benchmarks\.[\w.]*\w)", text)
  paths |= {name.replace(".", "/") + ".py" for name in modules}
  roots = [ROOT, ROOT / "apnpql_jax", ROOT / "docs"]
  return {path for path in paths if not any((root / path).exists() for root in roots)}


@pytest.mark.parametrize(
  ("text", "expected"),
  [
    ("see docs/none.md.", "docs/none.md"),
    ("`tests/none/test_none.py`", "tests/none/test_none.py"),
    ("    python benchmarks/none.py --quick", "benchmarks/none.py"),
    ("python -m benchmarks.speed.none.", "benchmarks/speed/none.py"),
    ("`agents/none.py: f`", "agents/none.py"),
  ],
)
def test_every_form_of_a_missing_path_is_found(text, expected):
  assert missing(text) == {expected}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_files_and_commands_that_a_document_names_exist(document):
  # The guide to adding a task names the files to make.
  assert {x for x in missing(document.read_text()) if "touch_ball" not in x} == set()


def test_tests_that_documents_name_exist():
  files = {p.stem: p.read_text() for p in Path(__file__).parent.rglob("test_*.py")}
  known = files.keys() | set(re.findall(r"def (test_\w+)\(", "".join(files.values())))
  for document in DOCUMENTS:
    named = set(re.findall(r"`(?:tests/[\w/]*)?(test_\w+)", document.read_text()))
    assert named <= known, document


def test_the_index_of_decisions_has_each_decision_with_its_date():
  folder = ROOT / "docs" / "decisions"
  index = (folder / "index.md").read_text()
  for topic in sorted({*folder.glob("*.md")} - {folder / "index.md"}):
    entries = re.findall(rf"^- (\S+) \[(.+)\]\({topic.name}#", index, re.M)
    decisions = re.findall(r"^## (.+)\n\n([\d-]*)", topic.read_text(), re.M)
    assert entries == [(date, heading) for heading, date in decisions], topic


def test_the_table_of_benchmarks_has_each_module_that_is_run():
  folder = ROOT / "benchmarks"
  scripts = {
    f"{path.parent.name}.{path.stem}"
    for path in folder.glob("*/*.py")
    if "__main__" in path.read_text()
  }
  rows = re.findall(r"^\| (`.+?) \|", (folder / "README.md").read_text(), re.M)
  named = re.findall(r"`([\w.]+)`", " ".join(rows))
  # A comparison starts the processes of its sides itself.
  assert sorted(named) == sorted(scripts - {"peers.sides"})


def test_the_table_of_extras_is_that_of_the_doctor():
  """``tests/doctor/test_doctor.py`` compares that with pyproject.toml."""
  text = (ROOT / "docs" / "command_line.md").read_text()
  table = text.partition("## Extras")[2].partition("##")[0]
  rows = re.findall(r"^\| `(\w+)` \| (.+?)(?: \(.+\))? \|$", table, re.M)
  assert {extra: gives.replace("`", "") for extra, gives in rows} == EXTRAS


def trainings(text: str) -> list[str]:
  """Returns the `apnpql train` and `apnpql sweep` of the code blocks in ``text``."""
  text = text.replace("\\\n", " ")
  variables = dict(re.findall(r"^ +(\w+)=\"?([^\"\n]+)\"?$", text, re.M))
  lines = re.findall(r"^ {4,}.*?\bapnpql ((?:train|sweep) .*)", text, re.M)
  return [Template(line).safe_substitute(variables, seed="0") for line in lines]


def check_training(line: str) -> None:
  """Raises ``ConfigError`` if the settings of a command are refused."""
  command, *words = shlex.split(line, comments=True)
  if command == "train":
    # A resume takes options on top of the settings of its run.
    config_of(["push_plate", *words[2:]] if words[0] == "--resume" else words)
  else:
    args = parse_sweep(words)
    plan = make_plan(args.presets, args.grid, seeds=args.seeds, options=args.train)
    check_plan(plan)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_trainings_that_a_document_shows_are_accepted(document):
  for line in trainings(document.read_text()):
    if "touch_ball" not in line:
      check_training(line)


@pytest.mark.parametrize(
  "text",
  [
    "    apnpql train push_plate --env.worlds 1024 --devices 0   # many",
    "    srun .venv/bin/apnpql train push_plate \\\n      --replay.expert-steps 100",
    "    half='--agent.epsilon 0'\n    apnpql train push_plate --run a $half",
    "    apnpql train --resume runs/mine --agent.nothing 1",
    "    apnpql sweep push_plate --grid agent.epsilon=1,1.0",
  ],
)
def test_trainings_that_are_refused_are_found(text):
  (line,) = trainings(text.replace("'", '"'))
  with pytest.raises(ConfigError):
    check_training(line)
