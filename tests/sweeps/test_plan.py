"""Plans of sweeps, and their manifests."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from run_files import make_run

from apnpql_jax.cli.sweep import (
  check_begun,
  check_plan,
  config_of,
  launch_of,
  parse_sweep,
  sweep,
)
from apnpql_jax.errors import ConfigError, FileError
from apnpql_jax.runs import run_folder
from apnpql_jax.sweeps.launcher import Launch
from apnpql_jax.sweeps.manifest import (
  DONE,
  FAILED,
  MANIFEST_FILE,
  Entry,
  Manifest,
  find_equal,
  load_manifest,
  open_folder,
)
from apnpql_jax.sweeps.plan import make_plan


def test_a_plan_has_every_combination_and_its_settings():
  grid = ["agent.epsilon=0.5,1", "agent.hidden=16 16,32", "env.randomize=true,false"]
  plan = make_plan(["push_plate"], grid, seeds=2, options=["--obs", "state"])
  assert len(plan) == len({run.name for run in plan}) == 16
  assert plan[0].name == "push_plate-epsilon_0.5-hidden_16_16-randomize_true-seed_0"
  found = {
    (x.agent.epsilon, x.agent.hidden, x.env.randomize, x.seed, x.env.obs)
    for x in (config_of(run.argv) for run in plan)
  }
  assert found == {
    (epsilon, hidden, randomize, seed, "state")
    for epsilon in (0.5, 1.0)
    for hidden in ((16, 16), (32,))
    for randomize in (True, False)
    for seed in (0, 1)
  }


def test_seeds_can_be_chosen_and_presets_are_an_axis():
  plan = make_plan(["push_plate", "stack_box"], ["seed=3,7", "video=false"])
  found = [(x.env.task, x.seed, x.video) for x in (config_of(r.argv) for r in plan)]
  tasks = ("push_plate", "stack_box")
  assert found == [(task, seed, False) for seed in (3, 7) for task in tasks]


@pytest.mark.parametrize(
  ("grid", "seeds", "words"),
  [
    (["agent.epsilon"], 1, "not like agent.epsilon=0.5,1,2"),
    (["agent.epsilon="], 1, "not like"),
    (["=1"], 1, "not like"),
    (["agent.epsilon=1,,2"], 1, "not like"),
    (["agent.epsilon=1", "agent.epsilon=2"], 1, "agent.epsilon twice"),
    (["agent.epsilon=1,1"], 1, "epsilon_1-seed_0 twice"),
    (["video=perhaps"], 1, "neither true nor false"),
    (["seed=1"], 2, "either --seeds or --grid seed"),
    ([], 0, "--seeds 0 must be at least 1"),
  ],
)
def test_a_plan_that_cannot_be_meant_is_refused(grid, seeds, words):
  with pytest.raises(ConfigError, match=words):
    make_plan(["push_plate"], grid, seeds=seeds)


@pytest.mark.parametrize(
  ("grid", "options", "words"),
  [
    ("agent.epsilon=1,2", "--agent.epsilon 3", "give agent.epsilon by --grid"),
    ("agent.algorithm=sac,ap_sac", "--algorithm ap_npql", "give agent.algorithm by"),
    ("algorithm=sac,ap_sac", "--agent.algorithm ap_npql", "give agent.algorithm by"),
    ("env.obs=state,pixels", "--obs=state", "give env.obs by"),
    ("env.backend=mjx,native", "--backend native", "give env.backend by"),
    ("env.randomize=true", "--env.no-randomize", "give env.randomize by"),
    ("video=true,false", "--no_video", "give video by"),
    ("agent.n-step=1,2", "--agent.n_step 3", "give agent.n_step by"),
    ("seed=1,2", "--seed 3", "give seed by"),
  ],
)
def test_what_varies_is_not_given_for_all_runs_too(grid, options, words):
  with pytest.raises(ConfigError, match=words):
    make_plan(["push_plate"], [grid], options=options.split())
  with pytest.raises(ConfigError, match=f"{words.split()[1]} twice"):
    make_plan(["push_plate"], [grid, f"{words.split()[1]}=1"])


def test_two_runs_that_are_the_same_are_refused():
  with pytest.raises(ConfigError, match=r"epsilon_1-.* and .*_1\.0-.* are the same"):
    check_plan(make_plan(["push_plate"], ["agent.epsilon=1,1.0"]))
  check_plan(make_plan(["push_plate"], ["init_from=runs/a,runs/b"]))


def test_a_sweep_finds_its_files_from_another_folder(tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  (tmp_path / "task.py").touch()
  grid = ["replay.demonstrations=mine.npz,my demos.npz"]
  line = "--init-from runs/a:20 --task_file=./task.py --env.obs=state"
  plan = make_plan(["push_plate"], grid, options=line.split())
  elsewhere = make_plan(["push_plate"], ["init_from=runs/b:best"])
  monkeypatch.chdir("/")
  check_plan(plan)
  found = [config_of(run.argv).replay.demonstrations for run in plan]
  assert found == [str(tmp_path / name) for name in ("mine.npz", "my demos.npz")]
  start = ["--init-from", f"{tmp_path}/runs/a:20", f"--task_file={tmp_path}/task.py"]
  assert all(run.argv[1:4] == start for run in plan)
  assert elsewhere[0].argv[1:3] == ["--init-from", f"{tmp_path}/runs/b:best"]
  (none,) = make_plan(["push_plate"], [], options=["--replay.demonstrations", ""])
  assert config_of(none.argv).replay.demonstrations == ""


def test_options_that_the_sweep_does_not_have_are_those_of_train():
  line = (
    "push_plate --obs state --grid agent.n-step=2,3 --agent.hidden 16 16 --seeds 2 "
    "--jobs 4 --agent.epsilon-nu -14 --no-video --grid agent.gamma=0.9 --json"
  )
  args = parse_sweep(line.split())
  assert args.presets == ("push_plate",) and args.json
  assert (args.seeds, args.jobs) == (2, 4)
  assert args.grid == ("agent.n-step=2,3", "agent.gamma=0.9")
  train = "--obs state --agent.hidden 16 16 --agent.epsilon-nu -14 --no-video"
  assert args.train == tuple(train.split())


PLAN = make_plan(["push_plate"], ["agent.epsilon=0.5,1"])
SLURM = Launch("slurm", {"timeout_min": 240, "slurm_partition": "gpu"}, 3)


def stored(folder: Path) -> Manifest:
  """Writes the manifest of ``PLAN`` to a new folder."""
  made = open_folder(folder, PLAN)
  folder.mkdir(exist_ok=True)
  made.save()
  return made


def test_a_manifest_is_read_as_it_was_written(tmp_path):
  made = stored(tmp_path / "sweep")
  made.runs[1].state, made.runs[1].line = FAILED, "apnpql: no"
  made.launch = SLURM
  made.save()
  assert load_manifest(tmp_path / "sweep") == made
  assert [(x.name, x.argv) for x in made.runs] == PLAN


@pytest.mark.parametrize(
  ("line", "expected"),
  [
    ("", SLURM),
    ("--launcher slurm", SLURM),
    (
      "--slurm timeout_min=60 --slurm cpus_per_task=8 --jobs 2",
      Launch("slurm", {**SLURM.slurm, "timeout_min": 60, "cpus_per_task": 8}, 2),
    ),
    ("--launcher local", Launch()),
    ("--launcher slurm-local --slurm mem_gb=4", Launch("slurm-local", {"mem_gb": 4})),
  ],
)
def test_a_sweep_is_resumed_as_it_was_started_unless_told_otherwise(line, expected):
  args = parse_sweep(["--resume", "runs/mine", *line.split()])
  assert launch_of(args, SLURM) == expected


def test_a_sweep_of_a_cluster_is_not_resumed_on_this_machine(tmp_path, monkeypatch):
  """Its jobs may still run; this machine has no Slurm."""
  monkeypatch.setenv("PATH", str(tmp_path))
  made = stored(tmp_path / "sweep")
  made.launch, made.runs[0].job = Launch("slurm"), "123"
  made.save()
  with pytest.raises(ConfigError, match="--launcher slurm needs"):
    sweep(parse_sweep(["--resume", str(made.folder)]))
  assert load_manifest(made.folder) == made


def test_earlier_manifests_are_of_this_machine(tmp_path):
  stored(tmp_path)
  path = tmp_path / MANIFEST_FILE
  data = json.loads(path.read_text())
  del data["launch"]
  path.write_text(json.dumps(data))
  assert load_manifest(tmp_path).launch == Launch()


def test_what_is_done_is_read_from_the_run_folders(tmp_path):
  sweep = Manifest(tmp_path, [Entry(f"run-{i}", []) for i in range(3)])
  make_run(tmp_path / "run-0", [0.5])
  make_run(tmp_path / "run-1", [0.5], finished=False)
  sweep.runs[1].state = DONE  # Its folder was replaced.
  sweep.runs[2].state = FAILED
  sweep.refresh()
  assert [entry.state for entry in sweep.runs] == ["done", "waiting", "waiting"]
  begun, new = (sweep.work(entry).command() for entry in sweep.runs[1:])
  assert begun[-2:] == ["--resume", str(tmp_path / "run-1")]
  assert new[-2:] == ["--run", str(tmp_path / "run-2")]


def test_the_same_plan_finds_its_sweep_and_a_larger_one_can_be_added(tmp_path):
  stored(tmp_path / "sweep")
  (tmp_path / "other").mkdir()
  (tmp_path / "other" / MANIFEST_FILE).write_text("{")
  assert find_equal(tmp_path, PLAN) == tmp_path / "sweep"
  more = make_plan(["push_plate"], ["agent.epsilon=0.5,1"], seeds=2)
  assert find_equal(tmp_path, more) is None
  grown = open_folder(tmp_path / "sweep", more)
  assert {entry.name for entry in grown.runs} == {run.name for run in more}


def test_a_run_with_other_options_is_not_taken_for_the_same(tmp_path):
  stored(tmp_path / "sweep")
  other = make_plan(["push_plate"], ["agent.epsilon=0.5,1"], options=["--obs", "state"])
  with pytest.raises(ConfigError, match="with other options: apnpql train push_plate"):
    open_folder(tmp_path / "sweep", other)


def test_a_preset_that_has_changed_is_noticed(tmp_path):
  def planned(name: str, change: str) -> Manifest:
    preset = tmp_path / name
    preset.write_text(
      "import dataclasses\n"
      "from apnpql_jax import load_preset\n"
      f"CONFIG = dataclasses.replace(load_preset('push_plate'), {change})\n"
    )
    (run,) = make_plan([str(preset)], [])
    return Manifest(tmp_path, [Entry("run", run.argv)])

  begun = planned("a.py", "total_steps=1000")
  check_begun(begun)  # Nothing has begun.
  run_folder.create(tmp_path / "run", config_of(begun.runs[0].argv))
  check_begun(begun)
  check_begun(planned("b.py", "total_steps=1000, checkpoint_every=7"))
  cures = f"total_steps.* sweep --resume {tmp_path}; or .*--out, or remove the run"
  with pytest.raises(ConfigError, match=cures):
    check_begun(planned("c.py", "total_steps=2000"))


def test_a_folder_with_other_files_is_refused(tmp_path):
  (tmp_path / "notes.txt").write_text("mine")
  with pytest.raises(ConfigError, match="holds something else"):
    open_folder(tmp_path, PLAN)


@pytest.mark.parametrize(
  "change",
  [
    lambda data: data.update(format=2),
    lambda data: data.pop("runs"),
    lambda data: data["runs"][0].update(name="../../elsewhere"),
    lambda data: data["runs"][0].update(name=".."),
    lambda data: data["runs"][0].update(argv=[1]),
    lambda data: data["runs"][0].update(unknown=1),
    lambda data: data.update(runs=[3]),
    lambda data: data.update(launch=3),
    lambda data: data["launch"].update(launcher="elsewhere"),
    lambda data: data["launch"].update(slurm={"timeout_min": [1]}),
    lambda data: data["launch"].update(slurm=[1]),
    lambda data: data["launch"].update(jobs=0),
    lambda data: data["launch"].update(jobs="2"),
  ],
)
def test_a_foreign_manifest_is_refused_in_one_line(change, tmp_path: Path):
  stored(tmp_path)
  path = tmp_path / MANIFEST_FILE
  data = json.loads(path.read_text())
  change(data)
  path.write_text(json.dumps(data))
  with pytest.raises(FileError, match="sweep.json cannot be read"):
    load_manifest(tmp_path)
