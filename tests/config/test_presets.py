"""Lookup of presets and scenes by name, in a checkout and in a wheel."""

from __future__ import annotations

from pathlib import Path

import pytest

from apnpql_jax.config import files
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import ConfigError


@pytest.fixture
def package(tmp_path: Path, monkeypatch) -> Path:
  """Creates an empty package folder; as in a checkout, its folders are next to it."""
  folder = tmp_path / "apnpql_jax"
  folder.mkdir()
  monkeypatch.setattr(files, "_PACKAGE", folder)
  return folder


def write(folder: Path, name: str, text: str) -> None:
  folder.mkdir(exist_ok=True)
  (folder / name).write_text(text)


def test_names_are_plain_words_and_sorted(package):
  folder = package.parent / "experiments"
  for name in "b.py a_2.py _private.py __init__.py Big.py c-d.py 2b.py".split():
    write(folder, name, "raise RuntimeError('listing must not run this')")
  write(folder, "notes.txt", "")
  assert files.preset_names() == ["a_2", "b"]


def test_installed_folder_is_preferred(package):
  write(package.parent / "experiments", "outside.py", "")
  write(package / "experiments", "inside.py", "")
  assert files.preset_names() == ["inside"]


def test_preset_is_loaded(package):
  text = "from apnpql_jax import TrainConfig\nCONFIG = TrainConfig(seed=7)"
  write(package.parent / "experiments", "seven.py", text)
  assert files.load_preset("seven") == TrainConfig(seed=7)


@pytest.mark.parametrize(
  ("text", "message"),
  [
    ("", "CONFIG = TrainConfig"),
    ("CONFIG = {}", "CONFIG = TrainConfig"),
    ("from apnpql_jax import EnvConfig\nEnvConfig(tusk='x')", "tusk"),
    ("CONFIG = (", "SyntaxError"),
  ],
)
def test_invalid_preset_is_rejected(package, text, message):
  write(package.parent / "experiments", "broken.py", text)
  with pytest.raises(ConfigError, match=r"'broken'|broken\.py:\d") as error:
    files.load_preset("broken")
  assert message in str(error.value)


def test_unknown_scene_lists_the_known_ones(package):
  write(package.parent / "mjcf", "kitchen.xml", "")
  assert files.mjcf_path("kitchen") == package.parent / "mjcf" / "kitchen.xml"
  with pytest.raises(ConfigError, match="'cellar'; choose from kitchen"):
    files.mjcf_path("cellar")
