"""Files that are written whole or not at all."""

from __future__ import annotations

import pytest

from apnpql_jax.atomic import replacing


def test_a_file_appears_at_the_end(tmp_path):
  path = tmp_path / "a.txt"
  with replacing(path) as part:
    part.write_text("new")
    assert part.suffix == path.suffix and not path.exists()
  assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


def test_a_link_leads_to_the_new_file(tmp_path):
  (tmp_path / "there").mkdir()
  path, link = tmp_path / "there" / "a.txt", tmp_path / "link.txt"
  path.write_text("old")
  link.symlink_to(path)
  with replacing(link) as part:
    part.write_text("new")
  assert link.is_symlink() and path.read_text() == "new"


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
  path = tmp_path / "a.txt"
  path.write_text("old")
  with pytest.raises(KeyboardInterrupt), replacing(path) as part:
    part.write_text("half")
    raise KeyboardInterrupt
  assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
