"""The columns of Table I, one file each, and the candidates that they share."""
