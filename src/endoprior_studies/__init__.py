"""Benchmarks: methods x sequences x budgets x seeds under one protocol, resumable, with intervals and verdicts.

`spec` reads what to compare, `method` says what a method is, `matrix` knows which cells are finished, `worker` trains
and scores one cell, `execute` runs workers, `statistics` and `results` compare, `tables`, `plots`, `image_grids` and
`report` write the results.
"""
