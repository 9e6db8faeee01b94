"""Tasks, found through a registry."""

from apnpql_jax.tasks.build import make_task  # noqa: F401
from apnpql_jax.tasks.task import Task, registered_by, task_names  # noqa: F401
