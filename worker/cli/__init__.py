"""The command line `rodif`: one module a command, each with `add_parser` and `run`."""
