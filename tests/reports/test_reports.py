"""Runs read from folders, grouped, summarized and drawn."""

from __future__ import annotations

import base64
import dataclasses
from html.parser import HTMLParser
import json
from pathlib import Path
import re
import subprocess
import sys

import imageio.v3 as iio
import numpy as np
import pytest
from run_files import EPISODES, make_run
from scipy import stats

from apnpql_jax.atomic import replacing
from apnpql_jax.errors import FileError, UserError
from apnpql_jax.reports import figure, groups, page, reading, statistics, tables
from apnpql_jax.runs import metrics
from apnpql_jax.runs.success import wilson_interval


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
  """Makes three seeds of two settings, on two tasks."""
  for task in ("push_plate", "stack_box"):
    for epsilon, best in ((0.5, 0.9), (1.0, 0.6)):
      for seed in range(3):
        rates = [0.1 * seed, 0.5 * best, best]
        folder = tmp_path / f"{task}-epsilon_{epsilon}-seed_{seed}"
        agent = {"epsilon": epsilon}
        make_run(
          folder, rates, seed=seed, task=task, agent=agent, minutes=1 + 0.1 * seed
        )
  return tmp_path


def test_a_folder_of_runs_counts_as_its_runs_and_each_once(sweep):
  runs = reading.find([sweep, sweep / "push_plate-epsilon_0.5-seed_0"])
  assert len(runs) == 12
  (run,) = reading.find([sweep / "push_plate-epsilon_0.5-seed_2"])
  assert run.rates == [0.2, 0.45, 0.9] and run.steps == [1000, 2000, 3000]
  assert run.minutes == pytest.approx([1.2, 2.4, 3.6])
  assert run.episodes == 3 * [EPISODES] and run.finished


@pytest.mark.parametrize(
  ("name", "content", "words"),
  [
    ("config.json", "{", "config.json"),
    ("evaluation.json", "[1]", "evaluation.json is not a JSON object"),
    ("versions.json", "{", "versions.json cannot be read"),
    ("versions.json", '{"git": "abc"}', "versions.json is not what a run writes"),
    ("versions.json", '{"git": {"commit": null}}', "versions.json is not"),
    ("metrics.jsonl", "x eval/success_rate\n", None),
    ("metrics.jsonl", '"eval/success_rate"\n', "metrics.jsonl, line 1"),
    ("metrics.jsonl", '{"step": 1, "eval/success_rate": "x"}\n', "jsonl, line 1"),
  ],
)
def test_what_cannot_be_read_is_named_and_costs_only_itself(
  name, content, words, tmp_path, capfd
):
  make_run(tmp_path / "good", [0.5])
  bad = make_run(tmp_path / "bad", [0.5])
  (bad / name).write_text(content)
  if words is None:  # Other lines than evaluations are not even parsed.
    assert reading.read(bad).evaluations == []
    return
  with pytest.raises(UserError, match=words):
    reading.find([bad])
  assert [run.name for run in reading.find([tmp_path])] == ["good"]
  assert words in capfd.readouterr().err


def test_a_folder_without_runs_is_refused(tmp_path):
  with pytest.raises(FileError, match="not a run folder"):
    reading.find([tmp_path])


def test_runs_are_grouped_by_all_but_the_seed_and_labeled_by_what_differs(sweep):
  found = groups.group(reading.find([sweep]))
  assert [(group.task, group.label) for group in found] == [
    ("push_plate", "epsilon 0.5"),
    ("push_plate", "epsilon 1"),
    ("stack_box", "epsilon 0.5"),
    ("stack_box", "epsilon 1"),
  ]
  assert all([run.config.seed for run in group.runs] == [0, 1, 2] for group in found)


def labels(tmp_path: Path, *agents: dict) -> list[str]:
  for index, agent in enumerate(agents):
    make_run(tmp_path / f"trial-{index}", [0.5], agent=agent)
  return [group.label for group in groups.group(reading.find([tmp_path]))]


def test_labels_name_the_algorithm_by_itself(tmp_path):
  agents = {"algorithm": "sac", "epsilon": 2.0}, {"algorithm": "ap_npql"}
  assert labels(tmp_path, *agents) == ["sac, epsilon 2", "ap_npql, epsilon 1"]


def test_runs_with_many_differences_are_labeled_by_their_folders(tmp_path):
  many = {"epsilon": 2.0, "n_step": 4, "hidden": (8, 8), "gamma": 0.9}
  assert labels(tmp_path, {}, many) == ["trial", "trial-1"]


def test_settings_that_do_not_affect_learning_make_no_group(tmp_path):
  make_run(tmp_path / "a", [0.5], checkpoint_every=10, video=False)
  make_run(tmp_path / "b", [0.5], seed=1)
  assert [len(group.runs) for group in groups.group(reading.find([tmp_path]))] == [2]


def test_a_repeated_seed_is_no_second_one(tmp_path):
  for name, seed in (("a", 0), ("b", 0), ("c", 1)):
    make_run(tmp_path / name, [0.5], seed=seed)
  found = groups.group(reading.find([tmp_path]))
  assert [(group.label, len(group.runs)) for group in found] == [("a", 2), ("b", 1)]


def test_steps_set_apart_runs_that_differ_in_nothing_else(tmp_path):
  make_run(tmp_path / "a", [0.5])
  make_run(tmp_path / "b", [0.5, 0.6])
  found = groups.group(reading.find([tmp_path]))
  assert [group.label for group in found] == ["total steps 1000", "total steps 2000"]


def test_an_interval_is_that_of_scipy_over_seeds():
  rates = np.array([[0.2, 0.5], [0.4, 0.5], [0.9, 0.5]])
  low, high = statistics.interval(rates, np.array([150.0, 150.0]))
  expected = stats.t.interval(0.95, 2, rates[:, 0].mean(), stats.sem(rates[:, 0]))
  assert low[0] == pytest.approx(max(0.0, expected[0]))
  assert high[0] == pytest.approx(min(1.0, expected[1]))
  # Equal seeds are no certainty: their episodes limit what is known.
  assert (low[1], high[1]) == pytest.approx(wilson_interval(75, 150))


def test_an_interval_of_one_seed_is_that_of_its_episodes(tmp_path):
  run = reading.read(make_run(tmp_path / "a", [0.5, 0.8]))
  curve = statistics.curve([run], "steps")
  assert list(curve.x) == [1000, 2000] and list(curve.mean) == [0.5, 0.8]
  assert (curve.low[1], curve.high[1]) == pytest.approx(wilson_interval(40, EPISODES))
  assert statistics.last([run]) == pytest.approx((0.8, *wilson_interval(40, EPISODES)))


def test_curves_are_interpolated_where_all_seeds_have_been(tmp_path):
  slow = reading.read(make_run(tmp_path / "a", [0.0, 0.4, 0.8], minutes=2.0))
  fast = reading.read(make_run(tmp_path / "b", [0.2, 0.4, 1.0], minutes=1.0))
  curve = statistics.curve([slow, fast], "minutes", band="range")
  assert list(curve.x) == [2.0, 3.0]
  assert list(curve.mean) == pytest.approx([(0.0 + 0.4) / 2, (0.2 + 1.0) / 2])
  assert list(curve.low) == pytest.approx([0.0, 0.2])
  assert list(curve.high) == pytest.approx([0.4, 1.0])


def test_the_evaluation_after_training_counts_instead_of_the_last_one(tmp_path):
  folder = make_run(tmp_path / "a", [0.5])
  final = {"success_rate": 0.75, "episodes": 200, "successes": 150}
  (folder / "evaluation.json").write_text(json.dumps(final))
  run = reading.read(folder)
  assert statistics.last([run]).mean == 0.75 and tables.solved([run]) == "150 of 200"


def test_an_evaluation_that_has_not_ended_does_not_count(tmp_path):
  """The shell has made its file, which is empty until it ends."""
  folder = make_run(tmp_path / "a", [0.5])
  (folder / "evaluation.json").touch()
  assert tables.solved([reading.read(folder)]) == "25 of 50"


def test_a_video_that_is_being_written_is_not_the_newest(tmp_path):
  (run,) = reading.find([make_run(tmp_path / "a", [0.5])])
  assert run.folder is not None
  (run.folder / "videos").mkdir()
  whole = run.folder / "videos" / "step_00003000.mp4"
  for path in (whole, whole.with_stem("step_00001000")):
    path.touch()
  with replacing(whole) as part:
    part.touch()
    assert page.newest_video(run) == whole


def test_an_evaluation_counts_if_all_runs_have_one_that_is_not_older(tmp_path, capfd):
  one, other = (make_run(tmp_path / x, [0.5, 0.6], seed=i) for i, x in enumerate("ab"))
  final = {"success_rate": 0.75, "episodes": 200, "checkpoint_step": 2000}
  (one / "evaluation.json").write_text(json.dumps(final))
  assert tables.solved(reading.find([tmp_path])) == "30 of 50, 30 of 50"
  (other / "evaluation.json").write_text(json.dumps(final))
  assert tables.solved(reading.find([tmp_path])) == "150 of 200, 150 of 200"
  (other / "evaluation.json").write_text(json.dumps(final | {"checkpoint_step": 1000}))
  assert tables.solved(reading.find([tmp_path])) == "30 of 50, 30 of 50"
  assert "from step 1,000, before the last evaluation" in capfd.readouterr().err
  (other / "evaluation.json").write_text(json.dumps({"acting": {}}))
  with pytest.raises(FileError, match="not what `apnpql evaluate --json` prints"):
    reading.read(other)


def test_tables_have_the_figures_of_the_runs(sweep):
  found = groups.group(reading.find([sweep]))
  head, first, second, *_ = tables.of_groups(found)
  row = dict(zip(head, first, strict=True))
  assert row["by seed"] == "45 of 50, 45 of 50, 45 of 50"
  assert row["steps to 80 %"] == "3,000, 3,000, 3,000"
  assert row["min to 80 %"] == "3.0, 3.3, 3.6"
  low, high = wilson_interval(135, 150)
  assert row["success"] == f"90.0 % ({100 * low:.0f} to {100 * high:.0f})"
  assert dict(zip(head, second, strict=True))["steps to 80 %"].startswith("> 3,000")
  text = tables.compare(found)
  assert "| agent.epsilon | 0.5 | 1 | 0.5 | 1 |" in text and "abcdef0" in text
  assert len(tables.of_runs(found)) == 13


def test_unfinished_runs_are_in_the_tables_and_do_not_stop_them(tmp_path):
  make_run(tmp_path / "a", [])
  make_run(tmp_path / "b", [0.5], finished=False)
  text = tables.compare(groups.group(reading.find([tmp_path])))
  assert "no evaluation yet" in text and "25 of 50" in text


def test_a_cell_cannot_break_a_table():
  assert tables.markdown([["a"], ["x|y"]]).splitlines()[-1] == "| x\\|y |"


@pytest.mark.parametrize("suffix", figure.SUFFIXES)
def test_a_figure_has_a_panel_for_each_task_and_axis(sweep, suffix):
  path = sweep / f"curves{suffix}"
  figure.save(groups.group(reading.find([sweep])), path)
  start = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}[suffix]
  assert path.read_bytes().startswith(start)
  if suffix == ".svg":
    text = path.read_text()
    assert len(re.findall(r'id="axes_\d+"', text)) == 4


def test_a_legend_of_long_titles_is_inside(sweep, tmp_path, monkeypatch):
  made, new = [], figure._figure
  monkeypatch.setattr(
    figure, "_figure", lambda *size: made.append(new(*size)) or made[0]
  )
  found = groups.group(reading.find([sweep]))
  figure.save(
    [x._replace(label=14 * "long " + x.label) for x in found], tmp_path / "x.png"
  )
  (legend,) = made[0].legends
  inside = legend.get_window_extent()
  assert inside.x0 >= 0 and inside.x1 <= made[0].bbox.width


def test_curve_shows_where_the_success_rate_is(tmp_path: Path):
  path = tmp_path / "curve.png"
  train_only: list[metrics.Row] = [{"step": 1, "loss": 2.0}]
  figure.plot_curve(train_only, path)
  assert not path.exists()

  def drawn(rates: list[float]) -> np.ndarray:
    rows: list[metrics.Row] = [
      {"step": i, "time/wall_s": 60.0 * i, metrics.SUCCESS: r, metrics.EPISODES: 200}
      for i, r in enumerate(rates)
    ]
    figure.plot_curve([*train_only, *rows], path, title="push_plate")
    return iio.imread(path)[..., :3].astype(int)

  high, low = drawn([0.9, 0.9, 0.9]), drawn([0.1, 0.1, 0.1])
  assert high.shape == low.shape and high.shape[0] > 200
  # Blue ink, the curve and its band, lies in the upper half or in the lower one.
  heights = []
  for image in (high, low):
    ink = (image[..., 2] - image[..., 0]) > 60
    left, right = np.split(ink, [ink.shape[1] // 2], axis=1)
    assert left.any() and right.any()
    heights.append(np.nonzero(ink)[0].mean() / ink.shape[0])
  assert heights[0] < 0.35 and heights[1] > 0.6
  assert [*tmp_path.iterdir()] == [path]


def test_a_title_has_one_color_in_all_panels(sweep):
  found = groups.group(reading.find([sweep]))
  colors = figure.colors_of(found)
  assert list(colors) == ["epsilon 0.5", "epsilon 1"] and len(set(colors.values())) == 2


class Resources(HTMLParser):
  """Collector of everything that a page would load or link to."""

  def __init__(self) -> None:
    super().__init__()
    self.sources: list[str] = []
    self.links: list[str] = []

  def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
    for name, value in attrs:
      if name in ("src", "poster", "data", "srcset") or (tag, name) == ("link", "href"):
        self.sources.append(value or "")
      elif (tag, name) == ("a", "href"):
        self.links.append(value or "")


def test_a_page_needs_no_other_file_and_links_videos_that_are_too_large(
  sweep, monkeypatch
):
  small, large = (sweep / f"push_plate-epsilon_{x}-seed_0" for x in ("0.5", "1.0"))
  for folder, size in ((small, 10), (large, 1000)):
    (folder / "videos").mkdir()
    (folder / "videos" / "step_00003000.mp4").write_bytes(size * b"v")
  monkeypatch.setattr(page, "MAX_VIDEO_BYTES", 100)
  found = groups.group(reading.find([sweep]))
  path = sweep / "out" / "report.html"
  path.parent.mkdir()
  page.write(found, path)
  text = path.read_text()
  parser = Resources()
  parser.feed(text)
  data = base64.b64encode(10 * b"v").decode()
  assert parser.sources == [f"data:video/mp4;base64,{data}"]
  assert parser.links == [f"../{large.name}/videos/step_00003000.mp4"]
  assert (path.parent / parser.links[0]).is_file()
  assert "@import" not in text and not re.search(r"url\((?!#)", text)
  assert text.count("<svg") == 4 and "agent.lambda_ap" in text


def test_names_in_a_page_are_text(tmp_path):
  make_run(tmp_path / "a", [0.5])
  (run,) = reading.find([tmp_path])
  other = dataclasses.replace(run, name="<img src=x>")
  page.write([groups.Group("<b>", "<i>", [other])], tmp_path / "report.html")
  text = (tmp_path / "report.html").read_text()
  assert "<b>" not in text and "<img" not in text and "<i>" not in text
  assert "&lt;i&gt;" in text


def test_reading_and_drawing_import_neither_jax_nor_mujoco(sweep):
  code = (
    "import sys; from apnpql_jax.cli.main import main;"
    f"assert main(['compare', {str(sweep)!r}, '--html', 'r.html']) == 0;"
    f"assert main(['plot', {str(sweep)!r}]) == 0;"
    "heavy = {'jax', 'mujoco', 'flax'} & set(sys.modules);"
    "sys.exit(str(heavy) if heavy else 0)"
  )
  root = Path(__file__).resolve().parents[2]
  done = subprocess.run(
    [sys.executable, "-c", code],
    cwd=sweep,
    env={"PYTHONPATH": str(root), "PATH": "", "HOME": str(sweep)},
    capture_output=True,
    text=True,
  )
  assert done.returncode == 0, done.stderr
  assert (sweep / "curves.png").is_file() and (sweep / "r.html").is_file()
