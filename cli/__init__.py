"""The command line: options, tables, one file per command."""
