"""The control-oriented model: one equation group a file."""
