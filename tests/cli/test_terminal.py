"""Habits of the command line in terminals, pipes and shells."""

from __future__ import annotations

import os
from pathlib import Path
import re
import subprocess
import sys

import pytest
from terminals import read_all, terminal

from apnpql_jax.cli import commands, main, text
from apnpql_jax.cli.completion import SHELLS

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = sorted(commands.COMMANDS)
ENV = os.environ | {"PYTHONPATH": str(ROOT), "TERM": "xterm-256color"}


def on_terminal(*args: str, columns: int, **env: str) -> str:
  """Returns what a command prints on a terminal of this width."""
  controller, end = terminal(columns)
  process = subprocess.Popen(
    [sys.executable, "-m", "apnpql_jax", *args],
    stdout=end,
    stderr=end,
    env={k: x for k, x in (ENV | env).items() if k != "COLUMNS"},
  )
  os.close(end)
  shown = read_all(controller)
  assert process.wait() == 0
  return shown


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_each_command_has_two_examples(command, capsys):
  with pytest.raises(SystemExit) as stop:
    main.main([command, "--help"])
  shown = capsys.readouterr().out
  examples = re.findall(rf"^(?:source <\()?apnpql {command}\b.*$", shown, re.M)
  assert stop.value.code == 0 and len(examples) >= 2, shown[:500]


@pytest.mark.parametrize("args", ["--help", "list", "evaluate --help"])
def test_lines_fit_forty_columns(args):
  """The terminal itself wraps sentences above the boxes of options."""
  shown = re.sub(r"\x1b\[[0-9;]*m", "", on_terminal(*args.split(), columns=40))
  lines = [x for x in shown.splitlines() if "│" in x or args != "evaluate --help"]
  assert len(lines) > 5 and max(map(len, lines)) <= 40


def test_no_color_is_respected():
  assert "\x1b[" in on_terminal("evaluate", "--help", columns=80)
  assert "\x1b[" not in on_terminal("evaluate", "--help", columns=80, NO_COLOR="1")


@pytest.mark.parametrize("args", ["train --help", "--help", "list", "completion bash"])
def test_a_reader_that_has_enough_is_no_error(args):
  command = f"{sys.executable} -m apnpql_jax {args} | true; exit ${{PIPESTATUS[0]}}"
  done = subprocess.run(
    ["bash", "-c", command], env=ENV, capture_output=True, text=True
  )
  assert (done.returncode, done.stderr) == (0, "")


def test_names_and_values_are_wrapped_in_two_columns(monkeypatch):
  monkeypatch.setattr(text, "width", lambda: 24)
  assert text.rows([("a", "one two three four"), ("long", "x")]) == [
    "a     one two three four"[:24].rstrip(),
    "long  x",
  ]
  assert text.rows([("a", "one two three four five")]) == [
    "a  one two three four",
    "   five",
  ]
  rows = text.rows([("a name that is long", "one two")])
  assert rows == ["a name that is long", "    one two"]


COMPLETE = """
source "$1"
COMP_WORDS=("${@:2}"); COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
"$(complete -p apnpql | sed 's/.*-F \\([^ ]*\\).*/\\1/')"
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.mark.parametrize(
  ("words", "expected"),
  [
    ("do", ["doctor"]),
    ("train push_plate --agent.eps", ["--agent.epsilon", "--agent.epsilon-nu"]),
    ("sweep --launcher sl", ["slurm", "slurm-local"]),
  ],
)
def test_bash_completes_commands_and_options(words, expected, tmp_path, capsys):
  assert main.main(["completion", "bash"]) == 0
  script = tmp_path / "a script"
  script.write_text(capsys.readouterr().out)
  assert subprocess.run(["bash", "-n", str(script)]).returncode == 0
  done = subprocess.run(
    ["bash", "-c", COMPLETE, "bash", str(script), "apnpql", *words.split()],
    capture_output=True,
    text=True,
  )
  # Bash sorts what it shows; the script's order changes from one process to the next.
  assert sorted(done.stdout.split()) == expected, done.stderr


@pytest.mark.parametrize("shell", SHELLS)
def test_each_shell_has_a_script_with_all_commands(shell, capsys):
  assert main.main(["completion", shell]) == 0
  shown = capsys.readouterr().out
  assert all(command in shown for command in COMMANDS)


def test_a_shell_without_a_script_is_named(capsys):
  assert main.main(["completion", "fish"]) == 2
  assert "choose from bash, zsh" in capsys.readouterr().err


@pytest.mark.parametrize("args", ["train push_plate --help", "sweep --help"])
def test_the_help_of_a_command_imports_nothing_slow(args):
  code = (
    "import sys; from apnpql_jax.cli.main import main\n"
    f"try: main({args.split()})\n"
    "except SystemExit: pass\n"
    "print({'jax', 'mujoco', 'numpy', 'matplotlib', 'rich'} & set(sys.modules))"
  )
  done = subprocess.run(
    [sys.executable, "-c", code], env=ENV, capture_output=True, text=True
  )
  assert done.stdout.splitlines()[-1] == "set()", done.stderr
