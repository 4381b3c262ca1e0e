"""Command lines: argument parsing, printing and exit codes around the other rooms."""
