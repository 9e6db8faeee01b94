"""The command line as users see it: real processes, their output and exit codes."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
import re
import subprocess
import sys

import pytest

from apnpql_jax.cli.main import _plain, main
from apnpql_jax.config import files
from apnpql_jax.config.checks import BACKENDS
from apnpql_jax.config.files import config_to_json
from apnpql_jax.config.schema import TrainConfig

ROOT = Path(__file__).resolve().parents[2]


def apnpql(*args: str, cwd: Path) -> subprocess.CompletedProcess[str]:
  """Runs the command in ``cwd``, as from a shell."""
  return subprocess.run(
    [sys.executable, "-m", "apnpql_jax", *args],
    cwd=cwd,
    env=dict(os.environ, PYTHONPATH=str(ROOT)),
    stdin=subprocess.DEVNULL,
    capture_output=True,
    text=True,
    timeout=120,
    check=False,
  )


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
  """Creates a run folder that holds only its configuration."""
  folder = tmp_path / "runs" / "old"
  folder.mkdir(parents=True)
  config = files.load_preset("push_plate")
  (folder / "config.json").write_text(config_to_json(config))
  return folder


def snapshot(folder: Path) -> dict[str, bytes | None]:
  """Returns every path under ``folder`` with its content; None for folders."""
  return {
    str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
    for path in sorted(folder.rglob("*"))
  }


BAD_INPUT = [
  ("", ["train", "evaluate", "collect", "list"]),
  ("learn", ["'learn'", "train", "evaluate", "collect", "list"]),
  ("train", ["push_plate"]),
  ("train nope", ["'nope'", "push_plate"]),
  ("train ../experiments/push_plate", ["push_plate"]),
  ("train push_plate extra", ["extra"]),
  ("train push_plate --epsilonn 1", ["--epsilonn", "apnpql train --help"]),
  ("train push_plate --agent.epsilo 1", ["--agent.epsilo", "--agent.epsilon"]),
  ("train push_plate --seed", ["--seed"]),
  ("train push_plate --seed x", ["--seed", "'x'"]),
  ("train push_plate --backend bullet", ["'bullet'", *BACKENDS]),
  ("train push_plate --env.backend bullet", ["'bullet'", *BACKENDS]),
  ("train push_plate --obs depth", ["'depth'", "pixels", "state"]),
  ("train push_plate --env.task juggle", ["'juggle'", "push_plate"]),
  ("train push_plate --algorithm ppo", ["'ppo'", "ap_npql"]),
  ("train push_plate --agent.epsilon 3.5", ["agent.epsilon", "log(30) = 3.401"]),
  ("train push_plate --agent.gamma nan", ["agent.gamma", "finite"]),
  ("train push_plate --replay.capacity 1000", ["replay.capacity", "1024"]),
  ("train push_plate --replay.capacity 2147483392", ["GiB", "replay.capacity"]),
  ("train push_plate --replay.expert-share 0.3", ["expert_share=0.296875"]),
  ("train push_plate --run runs/old", ["--resume", "--overwrite", "--run"]),
  ("train push_plate --run .", ["not a run", "--run"]),
  ("train push_plate --run . --overwrite", ["not a run", "--run"]),
  ("train push_plate --run runs/old/config.json", ["not a folder"]),
  ("train push_plate --run runs/old/config.json/x", ["cannot write", "config.json"]),
  (f"train push_plate --run {256 * 'x'}", ["File name too long"]),
  ("train push_plate --run /proc/run", ["cannot write to '/proc'"]),
  ("train push_plate --run runs/old --overwrite --env.task juggle", ["push_plate"]),
  ("train push_plate --resume runs/old --seed 9", ["seed 0 -> 9"]),
  ("train --resume runs/old --agent.gamma 0.9", ["agent.gamma 0.99 -> 0.9"]),
  ("train --resume runs/old --run runs/new", ["--resume", "--run"]),
  ("train stack_box --resume runs/old --seed 9", ["settings: seed 0 -> 9; resume it"]),
  ("train push_plate --init-from runs/new:3", ["'runs/new' is not a run", "runs/old"]),
  ("train push_plate --agent.hidden 8,8", ["--agent.hidden", "by spaces"]),
  ("train --resume runs/new", ["runs/new", "runs/old"]),
  ("evaluate", ["RUN"]),
  ("evaluate runs", ["not a run folder", "runs/old"]),
  ("evaluate runs/old --episodes 0", ["episodes=0"]),
  ("evaluate runs/old --seed -1", ["seed=-1"]),
  ("evaluate runs/old --checkpoint last", ["'last'", "newest", "best"]),
  ("evaluate runs/old --checkpoint best", ["no checkpoint", "the newest or a step"]),
  ("evaluate runs/old --checkpoint ²", ["'²'", "newest", "best"]),
  (f"evaluate runs/old --checkpoint {5000 * '9'}", ["newest", "best"]),
  ("evaluate runs/old", ["no checkpoint"]),
  ("convert", ["REC", "TASK", "OUT.npz"]),
  ("convert none.npz juggle out.npz", ["'juggle'", "push_plate"]),
  ("convert none.npz push_plate out.npz", ["cannot read none.npz"]),
  ("repeat", ["RUN/faults/step_<n>.npz"]),
  ("repeat runs/faults/step_1.npz", ["not a run folder", "runs/old"]),
  ("repeat runs/old/faults/step_1.npz", ["cannot read", "step_1.npz: No such file"]),
  ("evaluate runs/old --backend bullet", ["'bullet'", *BACKENDS]),
  ("evaluate runs/old --acting best", ["'best'", "policy, mean, prior, greedy"]),
  ("export", ["RUN", "apnpql export RUN"]),
  ("export runs/old", ["folder", "apnpql export RUN FOLDER"]),
  ("export runs/old runs", ["not an exported policy"]),
  ("export runs/old new --acting best", ["'best'", "policy, mean, prior, greedy"]),
  ("export runs/old new --checkpoint last", ["'last'", "newest", "best"]),
  ("export runs/old new", ["no checkpoint"]),
  ("transfer", ["RUN", "expert"]),
  ("transfer runs", ["not a run folder", "runs/old"]),
  ("transfer expert", ["--task"]),
  ("transfer runs/old --task push_plate", ["--task", "runs have their own"]),
  ("transfer expert --task push_plate --acting mean", ["need a run folder"]),
  ("transfer expert --task push_plate --checkpoint best", ["need a run folder"]),
  ("robot check --log logs", ["--log is for robot run"]),
  ("robot run --print-board board.pdf", ["--print-board is for robot calibrate"]),
  ("transfer expert --task juggle", ["'juggle'", "push_plate"]),
  ("transfer runs/old --physics moon", ["'moon'", "mjx, native"]),
  ("transfer runs/old --renderer paint", ["'paint'", "rays, opengl"]),
  ("transfer runs/old --looks unseen", ["unseen", "--renderer opengl"]),
  ("transfer runs/old --no-admittance", ["--no-admittance", "transfer --help"]),
  ("transfer runs/old", ["no checkpoint"]),
  ("evaluate runs/broken", ["config.json", "'env'", "missing"]),
  ("collect", ["push_plate"]),
  ("collect juggle", ["'juggle'", "push_plate"]),
  ("collect push_plate --backend bullet", ["'bullet'", *BACKENDS]),
  ("collect push_plate --noise -1", ["noise=-1.0"]),
  ("collect push_plate --noise nan", ["noise=nan"]),
  ("collect push_plate --episodes many", ["--episodes", "'many'"]),
  ("collect push_plate --video runs", ["video", ".mp4", ".gif"]),
  ("collect push_plate --save runs", ["runs is a folder"]),
  ("collect push_plate --append", ["--append", "need --save"]),
  ("collect push_plate --save none/x.npz", ["none/x.npz is a folder or its parent"]),
  ("collect push_plate --save /proc/x.npz", ["cannot write to '/proc'"]),
  ("collect push_plate --video runs/old/config.json/x.mp4", ["cannot write", "Not a"]),
  ("collect push_plate --video /proc/x/y.mp4", ["cannot write to '/proc/x'"]),
  (f"collect push_plate --video {256 * 'x'}.mp4", ["File name too long"]),
  ("collect push_plate --video \udcff.mp4", ["udcff.mp4' is not UTF-8"]),
  ("evaluate runs/old --video x.avi", ["video", ".mp4", ".gif"]),
  ("list tasks", ["tasks"]),
  ("sweep", ["push_plate"]),
  ("sweep nope", ["'nope'", "push_plate"]),
  ("sweep --no-video push_plate", ["before the options of train"]),
  ("sweep push_plate --grid agent.epsilon", ["not like agent.epsilon=0.5,1,2"]),
  ("sweep push_plate --grid agent.epsilo=1", ["epsilo_1-seed_0", "--agent.epsilon"]),
  ("sweep push_plate --grid agent.gamma=0.9,2", ["gamma_2-seed_0", "agent.gamma=2.0"]),
  ("sweep push_plate --agent.gamma nan", ["agent.gamma", "finite"]),
  ("sweep push_plate --seeds x", ["--seeds", "'x'"]),
  ("sweep push_plate --jobs 0", ["--jobs 0"]),
  ("sweep push_plate --run runs/new", ["leave out --run"]),
  ("sweep push_plate --out runs/old", ["runs/old", "something else", "--out"]),
  ("sweep push_plate --resume runs/old", ["--resume names the sweep itself"]),
  ("sweep push_plate --seed 5", ["seed by --grid seed=... alone"]),
  ("sweep push_plate --seed=5", ["seed by --grid seed=... alone"]),
  (
    "sweep push_plate --grid agent.n-step=2 --agent.n-step 3",
    ["agent.n_step by --grid agent.n_step=... alone"],
  ),
  ("sweep push_plate --sinks nope", ["push_plate-seed_0", "metric sink 'nope'"]),
  ("sweep --resume runs/old --seeds 2", ["--resume names the sweep itself"]),
  ("sweep --resume runs/old", ["not the folder of a sweep", "sweep.json"]),
  ("sweep push_plate --slurm timeout_min=5", ["--launcher slurm"]),
  ("sweep push_plate --launcher slurm --slurm x", ["--slurm 'x'", "timeout_min=240"]),
  ("sweep push_plate --launcher sge", ["'sge'", "slurm-local"]),
  ("plot", ["plot RUN"]),
  ("plot runs/none", ["not a run folder", "runs/old"]),
  ("plot runs/old", ["no run has an evaluation yet"]),
  ("plot runs/old --out x.gif", ["x.gif", ".png, .svg, .pdf"]),
  ("plot runs/old --out none/x.png", ["none/x.png is a folder or its parent"]),
  ("plot runs/old --x days", ["'days'", "minutes"]),
  ("compare", ["compare RUN"]),
  ("compare runs/broken", ["config.json", "'env'", "missing"]),
  ("compare runs/old --html x.md", ["x.md", ".html"]),
  ("compare runs/old --out /proc/x.md", ["cannot write to '/proc'"]),
]


@pytest.mark.parametrize(("line", "words"), BAD_INPUT, ids=[x for x, _ in BAD_INPUT])
def test_bad_input_ends_with_one_clear_line(
  line, words, run_dir, tmp_path, monkeypatch, capfd
):
  broken = tmp_path / "runs" / "broken"
  broken.mkdir()
  (broken / "config.json").write_text("{}")
  before = snapshot(tmp_path)
  monkeypatch.chdir(tmp_path)
  assert main(line.split()) == 2
  (error,) = capfd.readouterr().err.splitlines()
  for word in words:
    assert word in error
  assert snapshot(tmp_path) == before


@pytest.mark.parametrize("line", ["", "train push_plate --seed x", "evaluate runs"])
def test_a_process_with_bad_input_prints_the_same_line(
  line, tmp_path, monkeypatch, capfd
):
  """Imports in a new process print nothing of their own."""
  done = apnpql(*line.split(), cwd=tmp_path)
  monkeypatch.chdir(tmp_path)
  assert (done.returncode, done.stderr) == (main(line.split()), capfd.readouterr().err)


ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.mark.parametrize(
  ("line", "settings", "words"),
  [
    (
      "train push_plate --agent.epsilo 1",
      ASCII,
      "Unrecognized options: --agent.epsilo, 1; perhaps you meant --agent.epsilon FLOAT"
      " (see apnpql train --help)",
    ),
    ("train push_plate --run été", ASCII, "is not UTF-8, or the locale is not"),
    ("evaluate été", ASCII, "'\\udcc3\\udca9t\\udcc3\\udca9' is not a run folder"),
    ("list", {"JAX_ENABLE_X64": "1"}, "JAX_ENABLE_X64=1 is not supported"),
    ("train push_plate", {"JAX_PLATFORMS": "moon"}, "no device for JAX_PLATFORMS=moon"),
    ("convert a push_plate b", {"JAX_PLATFORMS": "moon"}, "JAX_PLATFORMS=moon"),
    ("collect push_plate", {"JAX_PLATFORMS": "cuda"}, "JAX_PLATFORMS=cuda"),
  ],
)
def test_an_environment_that_cannot_work_ends_with_one_line(
  line, settings, words, tmp_path, monkeypatch
):
  for name, value in settings.items():
    monkeypatch.setenv(name, value)
  done = apnpql(*line.split(), cwd=tmp_path)
  (error,) = done.stderr.splitlines()
  assert done.returncode == 2 and words in error
  assert not any(path.is_file() for path in tmp_path.rglob("*"))


def test_existing_files_are_replaced_only_if_asked(run_dir, tmp_path, capsys):
  """Checked before anything is computed; a recording may be its own output."""
  for name in ("file.npz", "file.mp4"):
    (tmp_path / name).write_text("precious")
  demos, video = str(tmp_path / "file.npz"), str(tmp_path / "file.mp4")
  before = snapshot(tmp_path)
  for command in (
    ["convert", demos, "push_plate", demos],
    ["collect", "push_plate", "--save", demos],
    ["collect", "push_plate", "--video", video],
    ["evaluate", str(run_dir), "--video", video],
  ):
    assert main(command) == 2
    assert "exists; replace it with --overwrite" in capsys.readouterr().err
  assert snapshot(tmp_path) == before
  assert main(["convert", demos, "push_plate", demos, "--overwrite"]) == 2
  assert "not an .npz archive" in capsys.readouterr().err
  assert snapshot(tmp_path) == before


def test_a_run_older_than_a_setting_keeps_its_behavior(run_dir, tmp_path):
  data = json.loads((run_dir / "config.json").read_text())
  del data["agent"]["residual_blocks"]
  (run_dir / "config.json").write_text(json.dumps(data))
  for command in ("evaluate runs/old", "train --resume runs/old --seed 9"):
    done = apnpql(*command.split(), cwd=tmp_path)
    assert done.returncode == 2
    warning, error = done.stderr.splitlines()
    assert warning.endswith("which keep their old behavior: agent.residual_blocks 0")
    assert "no checkpoint" in error or "seed 0 -> 9" in error


def test_bad_input_with_json_leaves_standard_output_empty(tmp_path):
  done = apnpql("collect", "juggle", "--json", cwd=tmp_path)
  assert (done.returncode, done.stdout) == (2, "")


def test_list_prints_one_json_object_and_nothing_else(tmp_path):
  done = apnpql("list", "--json", cwd=tmp_path)
  assert done.returncode == 0, done.stderr
  names = json.loads(done.stdout)
  assert done.stdout.count("\n") == 1
  assert list(names) == ["tasks", "presets", "algorithms", "backends"]
  assert "push_plate" in names["tasks"]
  assert "push_plate" in names["presets"]
  assert "ap_npql" in names["algorithms"]
  assert names["backends"] == list(BACKENDS)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only on Linux")
@pytest.mark.parametrize("command", ["--version", "list --json"])
@pytest.mark.parametrize(
  "streams", [">/dev/full", "2>/dev/full", ">&-", ">&- 2>&- <&-"]
)
def test_output_that_cannot_be_written_changes_no_exit_code(command, streams, tmp_path):
  command = f"{sys.executable} -m apnpql_jax {command} {streams}"
  done = subprocess.run(
    ["sh", "-c", command],
    cwd=tmp_path,
    env=dict(os.environ, PYTHONPATH=str(ROOT)),
    capture_output=True,
    text=True,
  )
  assert done.returncode == 0 and not any(tmp_path.iterdir())
  expected = "cannot print the result: [Errno 28] No space left on device\n"
  assert done.stderr == (expected if streams == ">/dev/full" else "")


def test_list_prints_the_same_names_as_text(tmp_path):
  done = apnpql("list", cwd=tmp_path)
  assert done.returncode == 0
  for word in ("tasks", "push_plate", "ap_npql", *BACKENDS):
    assert word in done.stdout


def test_help_names_every_command_and_every_setting(tmp_path):
  done = apnpql("--help", cwd=tmp_path)
  assert done.returncode == 0
  for word in ("train", "evaluate", "collect", "list"):
    assert word in done.stdout
  done = apnpql("train", "--help", cwd=tmp_path)
  assert done.returncode == 0
  config = TrainConfig()
  for prefix, part in (("", config), ("env.", config.env), ("agent.", config.agent)):
    for field in dataclasses.fields(part):
      if not dataclasses.is_dataclass(getattr(part, field.name)):
        assert f"--{prefix}{field.name.replace('_', '-')}" in done.stdout


def test_help_of_a_preset_shows_its_settings(tmp_path):
  done = apnpql("train", "push_plate", "--help", cwd=tmp_path)
  shown = re.sub(r"[\s│]+", " ", done.stdout)
  preset = files.load_preset("push_plate")
  assert preset.total_steps != TrainConfig().total_steps
  assert f"(default: {preset.total_steps})" in shown


def test_help_imports_neither_jax_nor_mujoco(tmp_path):
  code = (
    "import sys; from apnpql_jax.cli.main import main; assert main(['--help']) == 0;"
    "heavy = {'jax', 'mujoco', 'flax', 'numpy', 'matplotlib'} & set(sys.modules);"
    "sys.exit(str(heavy) if heavy else 0)"
  )
  env = dict(os.environ, PYTHONPATH=str(ROOT))
  done = subprocess.run(
    [sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True
  )
  assert done.returncode == 0, done.stderr


def test_version(tmp_path):
  done = apnpql("--version", cwd=tmp_path)
  assert done.returncode == 0
  assert done.stdout.strip() == __import__("apnpql_jax").__version__


def test_results_are_converted_to_plain_json():
  import jax.numpy as jnp
  import numpy as np

  value = {
    "rate": np.float32(0.5),
    "n": np.int64(3),
    "ci95": (jnp.float32(0.25), float("nan")),
    "run": Path("runs/a"),
    "flag": np.bool_(True),
    "none": None,
  }
  assert json.loads(json.dumps(_plain(value), allow_nan=False)) == {
    "rate": 0.5,
    "n": 3,
    "ci95": [0.25, None],
    "run": "runs/a",
    "flag": True,
    "none": None,
  }
