"""Readers get whole records at once, whatever becomes of the writer."""

from __future__ import annotations

from multiprocessing import get_context
import os
import subprocess
import sys
import time
from typing import Any

import pytest

from apnpql_jax import testing
from apnpql_jax.robot.blackboard import Blackboard, Record, text

FIELDS: Any = [("number", "i8"), ("reason", "S8")]
FLOOD = {"block": [("number", "i8"), ("values", "i8", 500)]}


def flood(name: str) -> None:
  """Writes as fast as it can."""
  board, number = Blackboard(name, FLOOD), 0
  while True:
    number += 1
    board["block"].write({"number": number, "values": number})


def test_a_reader_never_sees_half_a_record():
  with Blackboard(records=FLOOD) as board:
    process = get_context("spawn").Process(target=flood, args=(board.name,))
    process.start()
    numbers, end = [], time.monotonic() + 120
    while len(set(numbers)) < 300:
      found = board["block"].read()
      assert (found["values"] == found["number"]).all()
      numbers.append(int(found["number"]))
      assert time.monotonic() < end
      time.sleep(1e-4)  # Lets the writer on, on a machine with one core.
    process.kill()
    process.join()
    assert numbers == sorted(numbers)


def pair() -> tuple[bytearray, Record, Record]:
  """Returns memory with its writer and a reader."""
  buffer = bytearray(Record.size(FIELDS))
  writer, reader = (Record(memoryview(buffer), FIELDS) for _ in range(2))
  return buffer, writer, reader


def test_a_writer_that_dies_in_a_write_neither_delays_readers_nor_spoils_their_copy():
  buffer, writer, reader = pair()
  writer.write({"number": 7})
  assert reader.read()["number"] == 7
  buffer[0] += 1  # What the writer does first.
  buffer[16:24] = b"12345678"
  times = []
  for _ in range(20):
    begin = time.perf_counter()
    assert reader.read()["number"] == 7
    times.append(time.perf_counter() - begin)
  assert min(times) < 1e-3  # A reader that waits would take longer each time.
  assert Record(memoryview(buffer), FIELDS).read()["number"] == 0  # It saw nothing.


def test_text_is_shown_whatever_its_bytes():
  buffer, writer, reader = pair()
  writer.write({"reason": "a\u00e9"})
  assert text(reader.read()["reason"]) == "a\u00e9"
  assert text(b"\xff\xc3") == "\ufffd\ufffd"


def test_text_is_written_whatever_its_characters():
  _, writer, reader = pair()
  writer.write({"reason": "a\udcff"})  # From the name of a file that is not UTF-8.
  assert text(reader.read()["reason"]) == "a?"


@pytest.mark.parametrize("before", range(4))
def test_long_text_is_cut_between_characters_and_shows_it(before):
  with Blackboard() as board:
    board["policy"].write({"error": before * "a" + 150 * "\u00e9"})
    found = bytes(board["policy"].read()["error"]).decode()
    assert found == before * "a" + (197 - before) // 2 * "\u00e9" + "\u2026"
    board["policy"].write({"error": 100 * "\u00e9"})
    assert text(board["policy"].read()["error"]) == 100 * "\u00e9"
    board["devices"].write({"arm": 4096 * "a"})
    assert text(board["devices"].read()["arm"]) == 4096 * "a"


ORDERS = {
  "never": "",
  "twice": "board.close(); board.close()",
  "the opened one last": "board.close(); print(again['state'].read()['time'])",
  "the record is kept": "record = board['state']; board.close()",
  "a record outlives it": "record = board['state']; del board",
  "in a with statement that fails": "with board: raise SystemExit(0)",
}


@pytest.mark.parametrize("order", ORDERS)
def test_boards_end_without_a_word_in_any_order(order):
  code = (
    "from apnpql_jax.robot.blackboard import Blackboard\n"
    "board = Blackboard()\n"
    "again = Blackboard(board.name)\n"
    "board['state'].write({'time': 1.0})\n"
    f"{ORDERS[order]}\n"
  )
  environment = {**os.environ, "PYTHONPATH": str(testing.ROOT)}
  done = subprocess.run(
    [sys.executable, "-c", code], capture_output=True, env=environment, timeout=120
  )
  assert (done.returncode, done.stderr) == (0, b"")
