"""Benchmarks: methods x sequences x budgets x seeds under one protocol, resumable, with intervals and verdicts.

`spec` says what to compare and `spec_file` reads it, `method` says what a method is, `matrix` knows which cells are
finished, `worker` trains and scores one cell, `execute` runs workers, `statistics` and `results` compare, `tables`,
`figures` and `report` write the results. `tool_training` trains and scores the network that finds tools.
"""
