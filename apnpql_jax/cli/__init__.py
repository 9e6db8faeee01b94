"""Command line: options, commands and their output."""
