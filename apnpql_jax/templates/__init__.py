"""Files that commands copy: a task to change, and a script that uses an export."""
