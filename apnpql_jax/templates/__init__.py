"""Files that `apnpql new-task` copies: a complete task to change."""
