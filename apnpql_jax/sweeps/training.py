"""Training of a sweep from its manifest to its summary."""

from __future__ import annotations

from pathlib import Path

from apnpql_jax.console import print_line, reporting
from apnpql_jax.errors import FAILED, INTERRUPTED, RunStopped
from apnpql_jax.reports import groups, reading, tables
from apnpql_jax.runs.run_folder import CONFIG_FILE
from apnpql_jax.runs.signals import Signals
from apnpql_jax.sweeps.display import SweepDisplay
from apnpql_jax.sweeps.launcher import Launcher
from apnpql_jax.sweeps.manifest import DONE, Manifest
from apnpql_jax.sweeps.runner import Runner


def train(manifest: Manifest, launcher: Launcher) -> None:
  """Trains all runs that are not done, and shows a summary.

  At SIGINT, SIGTERM or SIGHUP, the runs save and end; see ``Runner.run``. Call
  it in the main thread.

  Raises:
    FileError: Another process trains this sweep.
    RunStopped: A signal stopped the sweep, or some runs did not finish.
  """
  folder = shown(manifest.folder)
  hint = f"to continue: apnpql sweep --resume {folder}"
  total = len(manifest.runs)
  print_line(f"sweep folder {folder}; {total} runs")
  with Signals("interrupted") as signals, SweepDisplay(manifest) as display:
    signals.finish_first(
      "stopping the runs, which save first",
      f"stopped at once; runs save by themselves; {hint}",
    )
    Runner(manifest, launcher, display.report).run(signals.caught, display.show)
    with reporting("summarize the sweep"):
      _summarize(manifest, display)
  done = sum(entry.state == DONE for entry in manifest.runs)
  if signals.caught:
    code = INTERRUPTED + signals.caught[0]
    raise RunStopped(f"stopped; {done} of {total} runs are done; {hint}", code)
  if done < total:
    raise RunStopped(f"{total - done} of {total} runs did not finish; {hint}", FAILED)


def shown(folder: Path) -> Path:
  """Returns a folder as a user in this one would write it."""
  here = Path.cwd()
  return folder.relative_to(here) if folder.is_relative_to(here) else folder


def _summarize(manifest: Manifest, display: SweepDisplay) -> None:
  """Shows the groups of the runs so far, and how to see more."""
  folders = map(manifest.run_dir, manifest.runs)
  begun = [folder for folder in folders if (folder / CONFIG_FILE).is_file()]
  runs = reading.find(begun) if begun else []
  if any(run.evaluations for run in runs):
    display.table(tables.brief(groups.group(runs)))
    folder = shown(manifest.folder)
    print_line(f"report: apnpql compare {folder} --html report.html")
