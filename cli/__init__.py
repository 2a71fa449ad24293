"""The command line: options, tables and exit codes, one file per command."""
