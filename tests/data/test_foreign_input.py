"""What other people made is data: it is refused in one line, or it is right."""

from __future__ import annotations

import json
from pathlib import Path
import zipfile

from hypothesis import HealthCheck, example, given, settings, strategies as st
import numpy as np
import pytest

import apnpql_jax
from apnpql_jax.config.codec import flatten
from apnpql_jax.config.files import config_from_json, config_to_json
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.data import npz
from apnpql_jax.errors import UserError
from apnpql_jax.runs import run_folder

NUMBERS = st.one_of(
  st.integers(), st.floats(), st.sampled_from([0, -1, 1, 2**31, 2**63, 10**400])
)
JSON = st.recursive(
  st.one_of(st.none(), st.booleans(), NUMBERS, st.text()),
  lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
  max_leaves=8,
)
FIELDS = [name for name, _ in flatten(TrainConfig())] + ["env", "agent", "replay"]
IN_TMP = settings(
  max_examples=200,
  deadline=None,
  suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def _one_line(error: pytest.ExceptionInfo[BaseException]) -> bool:
  return "\n" not in str(error.value) and len(str(error.value)) < 2000


@settings(max_examples=300, deadline=None)
@given(st.text() | JSON.map(lambda data: json.dumps(data, default=str)))
def test_random_text_is_not_a_configuration(text: str):
  with pytest.raises(UserError) as error:
    config_from_json(text)
  assert _one_line(error)


@settings(max_examples=500, deadline=None)
@example({"env": {}, "env.randomization.color": 0})
@given(st.dictionaries(st.sampled_from(FIELDS), JSON | NUMBERS, min_size=1, max_size=3))
def test_settings_are_refused_or_read_exactly(changes: dict[str, object]):
  data = json.loads(config_to_json(TrainConfig()))
  for name, value in changes.items():
    *path, last = name.split(".")
    inside = data
    for part in path:
      inside = inside.get(part) if isinstance(inside, dict) else None
    if isinstance(inside, dict):
      inside[last] = value
  try:
    config = config_from_json(json.dumps(data))
  except UserError as error:
    assert "\n" not in str(error)
    return
  assert config_from_json(config_to_json(config)) == config
  assert json.loads(config_to_json(config)) == data


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> bytes:
  path = tmp_path_factory.mktemp("npz") / "a.npz"
  np.savez_compressed(path, a=np.arange(12.0).reshape(3, 4), b=np.int32(5))
  return path.read_bytes()


@IN_TMP
@given(edits=st.lists(st.tuples(st.integers(0), st.integers(0, 255)), max_size=4))
def test_a_damaged_archive_is_refused_or_right(archive, tmp_path: Path, edits):
  data = bytearray(archive)
  for position, value in edits:
    data[position % len(data)] = value
  (tmp_path / "a.npz").write_bytes(data)
  try:
    arrays = npz.read(tmp_path / "a.npz", limit=10_000)
  except UserError as error:
    assert "\n" not in str(error)
    return
  assert sum(array.nbytes for array in arrays.values()) <= 10_000
  assert not any(array.dtype.hasobject for array in arrays.values())


@IN_TMP
@given(st.binary(max_size=300))
def test_random_bytes_are_not_an_archive(tmp_path: Path, data: bytes):
  (tmp_path / "a.npz").write_bytes(data)
  with pytest.raises(UserError) as error:
    npz.read(tmp_path / "a.npz", limit=10_000)
  assert _one_line(error)


def test_nothing_in_an_archive_is_executed(tmp_path: Path):
  class Trap:
    def __reduce__(self):
      return (Path.touch, (tmp_path / "executed",))

  np.savez(tmp_path / "a.npz", a=np.array([Trap()], dtype=object))
  with pytest.raises(UserError, match="not a plain array"):
    npz.read(tmp_path / "a.npz", limit=10_000)
  assert not (tmp_path / "executed").exists()


def test_a_header_that_asks_for_too_much_takes_no_memory(tmp_path: Path):
  np.savez(tmp_path / "a.npz", a=np.zeros(4))
  with zipfile.ZipFile(tmp_path / "a.npz") as file:
    data = file.read("a.npy")
  # The same file with a header of 2^40 numbers; padding keeps its length.
  header = data.replace(b"(4,), }            ", b"(1099511627776,), }")
  assert header != data
  with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
    file.writestr("a.npy", header)
  with pytest.raises(UserError, match="8796093022208 bytes, more than 10000"):
    npz.read(tmp_path / "a.npz", limit=10_000)


def test_links_must_not_lead_out_of_a_run_folder(tmp_path: Path):
  outside = tmp_path / "thesis"
  outside.mkdir()
  run = run_folder.create(tmp_path / "run", TrainConfig()).path
  (run / "inside").symlink_to(run / "config.json")
  (run / "wandb").mkdir()
  (run / "wandb" / "debug-core.log").symlink_to(outside / "log")  # As wandb does.
  run_folder.open_run(run)
  (run / "checkpoints").symlink_to(outside)
  with pytest.raises(UserError, match="checkpoints is a link that leads out"):
    run_folder.open_run(run)
  (run / "checkpoints").unlink()
  (run / "wandb").rename(run / "videos")
  with pytest.raises(UserError, match="debug-core.log is a link that leads out"):
    run_folder.open_run(run)


def test_a_configuration_of_gigabytes_is_not_read(tmp_path: Path):
  run = run_folder.create(tmp_path / "run", TrainConfig()).path
  with (run / "config.json").open("r+b") as file:
    file.truncate(8 << 30)  # Sparse: it takes no room on the disk.
  with pytest.raises(UserError, match="more than 1048576 bytes"):
    run_folder.load_run_config(run)


def test_no_module_can_execute_the_content_of_a_file():
  """No module imports pickle or what builds on it, and every NumPy call disables it."""
  package = Path(apnpql_jax.__file__).parent
  words = ("import pickle", "import dill", "import shelve", "import joblib", "marshal")
  for path in package.rglob("*.py"):
    text = path.read_text(encoding="utf-8")
    assert not any(word in text for word in words), path
    assert "allow_pickle=True" not in text and "eval(" not in text.replace("_eval(", "")
    assert text.count("np.load(") == text.count("allow_pickle=False") or (
      path.name == "npz.py"
    ), path
