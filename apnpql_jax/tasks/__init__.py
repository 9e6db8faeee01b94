"""Tasks, found through a registry."""

from apnpql_jax.tasks.task import (
  Task as Task,
  make_task as make_task,
  task_names as task_names,
)
