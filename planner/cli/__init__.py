"""The command line: a file per command, the grammar, the console."""
