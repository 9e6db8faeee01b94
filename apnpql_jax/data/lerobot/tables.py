"""Tables as LeRobot stores them in parquet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import json
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
  import pyarrow as pa


def of_columns(columns: Mapping[str, np.ndarray]) -> pa.Table:
  """Returns a table of columns [n, k]; those of one number hold no lists."""
  import pyarrow as pa

  arrays = {}
  for name, values in columns.items():
    flat, width = pa.array(values.ravel()), values.shape[1]
    lists = pa.FixedSizeListArray.from_arrays
    arrays[name] = flat if width == 1 else lists(flat, width)
  return pa.table(arrays)


def of_row(row: Mapping[str, Any]) -> pa.Table:
  """Returns a table of one row."""
  import pyarrow as pa

  return pa.Table.from_pydict({name: [value] for name, value in row.items()})


def of_tasks(tasks: Sequence[str]) -> pa.Table:
  """Returns the table of tasks, with their texts as the index of pandas."""
  import pyarrow as pa

  kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
  columns = [
    {
      "name": name,
      "field_name": name,
      "pandas_type": pandas,
      "numpy_type": numpy,
      "metadata": None,
    }
    for name, (pandas, numpy) in kinds.items()
  ]
  names = {
    "name": None,
    "field_name": None,
    "pandas_type": "unicode",
    "numpy_type": "object",
    "metadata": {"encoding": "UTF-8"},
  }
  about = {
    "index_columns": ["task"],
    "column_indexes": [names],
    "columns": columns,
    "creator": {"library": "pyarrow", "version": pa.__version__},
    "pandas_version": "2.2.0",
  }
  table = pa.table(
    {
      "task_index": pa.array(range(len(tasks)), pa.int64()),
      "task": pa.array(tasks, pa.string()),
    }
  )
  return table.replace_schema_metadata({"pandas": json.dumps(about)})
