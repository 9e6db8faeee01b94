"""Transfer of runs to other physics, renderers and looks: a table.

  python experiments/results/transfer_table.py runs/mine runs/other
  python experiments/results/transfer_table.py runs/mine --cells bullet/tiny/plain \
      bullet/tiny/plain/60/admittance
  python experiments/results/transfer_table.py expert:stack_box

A cell names a condition: physics/renderer/looks and, with Bullet, the latency in ms and
"admittance". Looks such as unseen-shadows are unseen ones without a part. `apnpql
transfer` plays every cell of every run in a process of its own, and the result is
stored as <folder>/<run>-<cell>.json. The same command again plays only what is missing.
It refuses a stored result of another seed, checkpoint, scene or setting. Then it writes
two tables of all results in the folder: table.md has a row per result, and
by_training.md a row per cell, with the seeds of each training together. Runs are
distinguished by the names of their folders, which end with a hyphen and the seed.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import subprocess
import sys
from typing import Any

from transfer_results import by_training, read, table

from apnpql_jax.atomic import replacing
from apnpql_jax.cli.inputs import task_env
from apnpql_jax.errors import ConfigError, FileError, UserError
from apnpql_jax.runs import checkpoint_reader, run_folder
from apnpql_jax.transfer import identity
from apnpql_jax.transfer.condition import Condition

OUT = Path(__file__).resolve().parent / "transfer"

EXPERT = "expert:"

ADMITTANCE = "admittance"

CELLS = [
  "native/rays/plain",
  "native/rays/trained",
  "native/opengl/trained",
  "native/opengl/unseen",
  "bullet/rays/plain",
  *(f"bullet/tiny/unseen/{latency}" for latency in (0, 30, 60)),
  *(f"bullet/tiny/unseen/{latency}/{ADMITTANCE}" for latency in (0, 30, 60)),
]
"""Cells of a policy, from the world of the scene file on; others can be named."""

EXPERT_CELLS = ["native/rays/plain", "bullet/rays/plain"]
"""Cells of the expert, which sees no images."""


def condition_of(text: str) -> Condition:
  """Returns the condition of a cell such as bullet/tiny/unseen/60/admittance.

  Raises:
    ConfigError: There is no such condition, or a package is missing.
  """
  names, more = text.split("/")[:3], text.split("/")[3:]
  admittance = more[-1:] == [ADMITTANCE]
  latency = more[:-1] if admittance else more
  if len(names) < 3 or len(latency) > 1 or not all(x.isdecimal() for x in latency):
    shape = f"physics/renderer/looks[/latency in ms][/{ADMITTANCE}]"
    raise ConfigError(f"cell {text!r} must have the form {shape}")
  latency_ms = int(latency[0]) if latency else None
  looks, *without = names[2].split("-")
  condition = Condition(*names[:2], looks, tuple(without), latency_ms, admittance)
  condition.check()
  return condition


def name_of(condition: Condition) -> str:
  """Returns the part of a file's name that stands for a condition."""
  about = condition.about()
  parts = [about[name] for name in ("physics", "renderer", "looks")]
  parts += about.get("without", ())
  if "latency_ms" in about:
    parts += [str(about["latency_ms"]), *[ADMITTANCE] * condition.admittance]
  return "-".join(parts)


def label_of(run: str) -> str:
  """Returns what the table calls a run."""
  return "expert" if run.startswith(EXPERT) else Path(run).absolute().name


def path_of(out: Path, run: str, condition: Condition) -> Path:
  """Returns the file of a result."""
  name = run.replace(":", "-") if run.startswith(EXPERT) else label_of(run)
  return out / f"{name}-{name_of(condition)}.json"


def options_of(run: str, condition: Condition) -> list[str]:
  """Returns the arguments of `apnpql transfer`."""
  options = [run]
  if run.startswith(EXPERT):
    options = ["expert", "--task", run.removeprefix(EXPERT)]
  about = condition.about()
  for name in ("physics", "renderer", "looks", "latency_ms"):
    if name in about:
      options += [f"--{name.replace('_', '-')}", str(about[name])]
  if condition.without:
    options += ["--without", *condition.without]
  return [*options, *["--admittance"] * condition.admittance]


def identity_of(
  run: str, condition: Condition, episodes: int, seed: int
) -> dict[str, Any]:
  """Returns the identity that the result of a cell must have.

  Raises:
    UserError: There is no such task or run, or it has no checkpoint.
  """
  if run.startswith(EXPERT):
    config = task_env(run.removeprefix(EXPERT))
    return identity.of_expert(config, condition, episodes=episodes, seed=seed)
  folder = run_folder.open_run(Path(run))
  step = checkpoint_reader.restore(folder.path, None, {}, config=folder.config).step
  options: dict[str, Any] = {"acting": None, "episodes": episodes, "seed": seed}
  return identity.of_run(folder.path, folder.config, step, condition, **options)


def check(path: Path, wanted: dict[str, Any]) -> None:
  """Checks that a stored result has the wanted identity.

  Raises:
    FileError: It has another one, or it is damaged.
  """
  found = read(path)
  differing = [
    f"{name} {found.get(name, 'unknown')} instead of {value}"
    for name, value in wanted.items()
    if found.get(name) != value
  ]
  if differing:
    cure = "remove it to play it again, or choose another --out"
    raise FileError(f"{path} has {', '.join(differing)}; {cure}")


def play(
  path: Path, run: str, condition: Condition, wanted: dict[str, Any], *, video: bool
) -> None:
  """Plays episodes under a condition and stores the result.

  Args:
    path: The file of the result.
    run: A run folder, or expert:TASK.
    condition: The condition.
    wanted: The identity of the result.
    video: Whether to film the first success and the first failure, next to ``path``.

  Raises:
    SystemExit: The command failed; it has printed why.
  """
  command = [sys.executable, "-m", "apnpql_jax", "transfer"]
  command += options_of(run, condition)
  command += ["--episodes", str(wanted["episodes"]), "--seed", str(wanted["seed"])]
  path.parent.mkdir(parents=True, exist_ok=True)
  if video:
    command += ["--video", str(path.with_suffix(".mp4")), "--overwrite"]
  done = subprocess.run([*command, "--json"], stdout=subprocess.PIPE, check=False)
  if done.returncode:
    sys.exit(done.returncode)
  found = json.loads(done.stdout)
  if found.get("video"):
    found["video"] = Path(found["video"]).name  # The folder is that of this machine.
  with replacing(path) as part:
    part.write_text(json.dumps({"run": label_of(run), **found}, indent=1) + "\n")
  print(f"{path.stem}: {found['successes']} of {found['episodes']}", flush=True)


def main() -> None:
  parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
  parser.add_argument("runs", nargs="*", help="run folders, or expert:TASK")
  parser.add_argument("--cells", nargs="+", help="default: those of the table")
  parser.add_argument("--episodes", type=int, default=200)
  parser.add_argument("--seed", type=int, default=0)
  parser.add_argument("--out", type=Path, default=OUT, help="folder of the results")
  parser.add_argument("--video", action="store_true", help="also film each cell")
  args = parser.parse_args()
  try:
    cells = {
      path_of(args.out, run, condition): (run, condition)
      for run in args.runs
      for condition in map(condition_of, args.cells or cells_of(run))
    }
    # First: a cell takes minutes.
    wanted = {
      path: identity_of(*chosen, args.episodes, args.seed)
      for path, chosen in cells.items()
    }
    for path in filter(Path.exists, wanted):
      check(path, wanted[path])
    for path in wanted:
      if not path.exists():
        play(path, *cells[path], wanted[path], video=args.video)
    found = [read(path) for path in sorted(args.out.glob("*.json"))]
  except UserError as error:
    sys.exit(str(error))
  if found:
    (args.out / "by_training.md").write_text(by_training(found))
    (args.out / "table.md").write_text(table(found))
    print(by_training(found), table(found), sep="\n")


def cells_of(run: str) -> list[str]:
  """Returns the cells of a run that names none."""
  return EXPERT_CELLS if run.startswith(EXPERT) else CELLS


if __name__ == "__main__":
  main()
