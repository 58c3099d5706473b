"""The command line: one file for each command, and the table that lists them."""
