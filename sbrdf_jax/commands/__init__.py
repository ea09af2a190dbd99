"""One file a verb of the command line: its arguments in, its exit code out."""
