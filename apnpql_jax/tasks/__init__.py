"""Tasks, found through a registry."""

from apnpql_jax.tasks.task import make_task as make_task
from apnpql_jax.tasks.task import Task as Task
from apnpql_jax.tasks.task import task_names as task_names
