"""The columns of Table I; one file each, and their shared candidates."""
