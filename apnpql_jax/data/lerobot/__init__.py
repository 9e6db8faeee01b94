"""Datasets in the format of LeRobot, version 3: parquet, MP4 and JSON.

Written from the format's description, without lerobot or torch. No module here imports
JAX, except ``conversion``.
"""

from apnpql_jax.data.lerobot.layout import (
  ACTION,
  ENVIRONMENT,
  IMAGES,
  STATE,
  SUCCESS,
  TIMES,
  check_available,
  is_dataset,
)
from apnpql_jax.data.lerobot.reader import Dataset, Episode, read
from apnpql_jax.data.lerobot.writer import Writer

__all__ = [
  "ACTION",
  "ENVIRONMENT",
  "IMAGES",
  "STATE",
  "SUCCESS",
  "TIMES",
  "Dataset",
  "Episode",
  "Writer",
  "check_available",
  "is_dataset",
  "read",
]
