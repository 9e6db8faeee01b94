"""Tasks, found through a registry."""

from apnpql_jax.tasks.task import Task, make_task, task_names  # noqa: F401
